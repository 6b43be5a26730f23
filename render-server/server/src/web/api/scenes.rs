//! Changing the scene on the page: `GET /api/scenes` lists the available scenes, `PUT /api/scene` selects one.
//! Instructor only ([`super::routes`]), and only while no vehicle flies.
//!
//! A scene is selected by its name in that list: no request contains a path.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use crate::web::http::ordered;
use crate::web::state::Page;

/// The scenes that can be selected.
#[derive(Debug, Serialize)]
struct SceneList {
    /// Current scene; `None` if it is not in the list.
    now: Option<String>,
    scenes: Vec<String>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneRequest {
    name: String,
}

pub(in crate::web) async fn list(State(page): State<Arc<Page>>) -> Response {
    let scenes = page.scenes.clone();
    // Blocking: reads a folder.
    let found = tokio::task::spawn_blocking(move || SceneList {
        now: scenes.current(),
        scenes: scenes.list().into_iter().map(|(name, _)| name).collect(),
    });
    match found.await {
        Ok(list) => Json(list).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

pub(in crate::web) async fn change(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let SceneRequest { name } = match ordered(&headers, body) {
        Ok(wish) => wish,
        Err(refusal) => return *refusal,
    };
    if let Some(flying) = page.rooms.flights.vehicles.iter().find(|vehicle| vehicle.under_way()) {
        let text = format!("'{}' flies; land it first", flying.name);
        return (StatusCode::CONFLICT, text).into_response();
    }
    let scenes = page.scenes.clone();
    let chosen = name.clone();
    // Blocking: reads a folder and the arena.
    let chosen = tokio::task::spawn_blocking(move || scenes.choose(&chosen)).await;
    match chosen {
        Ok(Ok(())) => {
            page.rooms.flights.note(&format!("the scene is changed to '{name}' on the page"));
            // The server stops serving, and restarts with the selected scene.
            page.rooms.stop.set();
            (StatusCode::ACCEPTED, "the scene changes; the page comes back by itself")
                .into_response()
        }
        Ok(Err(why)) => (StatusCode::CONFLICT, why).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
    let scenes = vec!["room".to_owned()];
    [Some("room".to_owned()), None]
        .map(|now| serde_json::json!(SceneList { now, scenes: scenes.clone() }))
        .into()
}
