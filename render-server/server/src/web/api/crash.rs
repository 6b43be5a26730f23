//! The crash card over HTTP, for viewers that may see the vehicle.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use crate::web::http::picture;
use crate::web::state::{Page, vehicle};

/// `GET /api/vehicles/V/crash`: the newest card.
pub(in crate::web) async fn show(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
) -> Response {
    let vehicle = match vehicle(&page, &name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let card = vehicle.crash.borrow().clone();
    let Some(card) = card else {
        let text = format!("no flight of '{name}' has failed since the server started");
        return (StatusCode::NOT_FOUND, text).into_response();
    };
    Json(&*card).into_response()
}

/// Kind of a crash card's image.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(in crate::web) enum CrashPicture {
    Colour,
    Depth,
}

/// `GET /api/vehicles/V/crash/ID/CAMERA/KIND/N`: an image of the newest card.
pub(in crate::web) async fn image(
    State(page): State<Arc<Page>>,
    Path((name, id, camera, kind, number)): Path<(String, u64, usize, CrashPicture, usize)>,
) -> Response {
    let vehicle = match vehicle(&page, &name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let card = vehicle.crash.borrow().clone();
    let card = card.filter(|card| card.id == id);
    let preview = card.as_ref().and_then(|card| card.image(camera, number));
    match preview.map(|preview| (preview, kind)) {
        Some((preview, CrashPicture::Colour)) => jpeg(&preview.colour),
        Some((preview, CrashPicture::Depth)) => jpeg(&preview.depth),
        None => {
            (StatusCode::NOT_FOUND, "image not found, or a newer flight has failed").into_response()
        }
    }
}

fn jpeg(bytes: &[u8]) -> Response {
    picture("image/jpeg", Bytes::copy_from_slice(bytes))
}
