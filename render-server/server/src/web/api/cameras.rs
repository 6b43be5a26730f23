//! The cameras over HTTP: readable by all viewers of the page, changed only by this server's page.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use vizflyt_arena::config::CameraConfig;
use vizflyt_protocol::messages::EventKind;

use crate::render::cameras::{Cameras, ChangeError};
use crate::web::http::refuse;
use crate::web::state::{Page, vehicle};
use crate::web::{messages, origin};

pub(in crate::web) async fn list(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
) -> Response {
    let vehicle = match vehicle(&page, &name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let set = page.rooms.rendering.cameras[vehicle.index].newest();
    Json(set.configs.iter().map(messages::camera_keys).collect::<Vec<_>>()).into_response()
}

/// Replaces a camera.
pub(in crate::web) async fn put(
    State(page): State<Arc<Page>>,
    Path((vehicle, name)): Path<(String, String)>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &vehicle, &headers, body, |cameras, json| cameras.put(&name, json))
}

/// Changes a camera.
pub(in crate::web) async fn patch(
    State(page): State<Arc<Page>>,
    Path((vehicle, name)): Path<(String, String)>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &vehicle, &headers, body, |cameras, json| cameras.patch(&name, json))
}

fn change(
    page: &Page,
    name: &str,
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
    apply: impl FnOnce(&Cameras, &[u8]) -> Result<CameraConfig, ChangeError>,
) -> Response {
    if let Err(refusal) = origin::check(headers) {
        return refuse(&refusal);
    }
    let vehicle = match vehicle(page, name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let body = match body {
        Ok(body) => body,
        Err(rejection) => return rejection.into_response(),
    };
    let cameras = &page.rooms.rendering.cameras[vehicle.index];
    let before = cameras.newest();
    match apply(cameras, &body) {
        Ok(camera) => {
            // Unchanged settings are not an event.
            if !Arc::ptr_eq(&before, &cameras.newest()) {
                vehicle.publish(EventKind::Note, &describe(&camera));
            }
            Json(messages::camera_keys(&camera)).into_response()
        }
        Err(error @ ChangeError::Unknown { .. }) => {
            (StatusCode::NOT_FOUND, error.to_string()).into_response()
        }
        Err(error) => (StatusCode::BAD_REQUEST, error.to_string()).into_response(),
    }
}

/// Returns a one-line description of the camera, for the page and the flight log.
fn describe(camera: &CameraConfig) -> String {
    let k = camera.intrinsics();
    let lens = match k.distortion.to_wire().0 {
        0 => "",
        1 => ", Brown-Conrady",
        _ => ", Kannala-Brandt",
    };
    let rate = camera.rate_hz.map_or_else(String::new, |hz| format!(", {hz} Hz at most"));
    let imaging = camera.imaging.as_ref();
    let imaging = imaging.map_or_else(String::new, |imaging| format!(", {}", imaging.describe()));
    format!(
        "camera {} is now {}x{} px, fx {:.1}, fy {:.1}{lens}, near {} m, at {} tilted {} deg{rate}{imaging}",
        camera.name,
        k.width_px,
        k.height_px,
        k.fx_px,
        k.fy_px,
        camera.near_m,
        camera.position_m,
        camera.tilt_deg
    )
}
