//! Images and geometry of the scene: top view, solid cells, the twin's splats, and images of the twin.

use std::sync::Arc;

use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use tokio::task::spawn_blocking;

use crate::web::http::picture;
use crate::web::state::Page;
use crate::web::twin_picture::{NO_THREAD, PictureRequest};

/// `GET /api/map`.
pub(in crate::web) async fn map(State(page): State<Arc<Page>>) -> Response {
    picture("image/jpeg", page.top_view.jpeg.clone())
}

/// `GET /api/shell`.
pub(in crate::web) async fn shell(State(page): State<Arc<Page>>) -> Response {
    picture("application/octet-stream", page.top_view.shell.clone())
}

/// `GET /api/splats/N`.
pub(in crate::web) async fn splats(
    State(page): State<Arc<Page>>,
    Path(index): Path<usize>,
) -> Response {
    let parts = page.twin.clone();
    match spawn_blocking(move || parts.get(index)).await {
        Ok(Some(bytes)) => picture("application/octet-stream", bytes),
        _ => (StatusCode::NOT_FOUND, format!("the twin has {} parts", page.twin.len()))
            .into_response(),
    }
}

/// `GET /api/twin`.
pub(in crate::web) async fn draw(
    State(page): State<Arc<Page>>,
    request: Result<Query<PictureRequest>, QueryRejection>,
) -> Response {
    let camera = request.map_err(|rejection| rejection.body_text());
    let camera = camera.and_then(|Query(request)| {
        let camera = request.camera().map_err(|error| error.to_string());
        Ok((camera?, request.cut))
    });
    let (camera, cut) = match camera {
        Ok(camera) => camera,
        Err(error) => return (StatusCode::BAD_REQUEST, error).into_response(),
    };
    let drawn = match page.twin_pictures.ask(camera, cut) {
        Ok(drawn) => drawn.await,
        Err(error) => return (StatusCode::SERVICE_UNAVAILABLE, error).into_response(),
    };
    match drawn {
        Ok(Ok(jpeg)) => picture("image/jpeg", jpeg.into()),
        Ok(Err(error)) => (StatusCode::INTERNAL_SERVER_ERROR, error).into_response(),
        Err(_) => (StatusCode::SERVICE_UNAVAILABLE, NO_THREAD).into_response(),
    }
}
