//! `/ws`: one page watches a vehicle.

use std::sync::Arc;

use axum::Extension;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{Query, State, WebSocketUpgrade};
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use crate::web::access::Shown;
use crate::web::http::refuse;
use crate::web::listener::ConnectionPlace;
use crate::web::state::{Page, vehicle};
use crate::web::{origin, viewer};

#[derive(Debug, Deserialize)]
pub(in crate::web) struct Watched {
    vehicle: Option<String>,
}

/// `GET /ws`.
pub(in crate::web) async fn watch(
    State(page): State<Arc<Page>>,
    Query(watched): Query<Watched>,
    Extension(shown): Extension<Shown>,
    place: Option<Extension<ConnectionPlace>>,
    headers: HeaderMap,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let named = watched.vehicle.map(|name| vehicle(&page, &name).cloned());
    let vehicle = match named.unwrap_or_else(|| Ok(page.rooms.flights.vehicles[0].clone())) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    match upgrade {
        // Viewers send nothing: limit messages of hostile ones.
        Ok(upgrade) => upgrade.max_message_size(1024).on_upgrade(async move |socket| {
            // Marks the connection as serving, so that its slot stays taken.
            if let Some(Extension(place)) = &place {
                place.serve(Some(&shown.viewer));
            }
            viewer::run(page, vehicle, shown, socket).await;
        }),
        Err(rejection) => rejection.into_response(),
    }
}
