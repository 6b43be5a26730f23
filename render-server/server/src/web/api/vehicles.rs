//! The vehicles over HTTP: list, stop buttons, start, landing and reset.

use std::sync::Arc;

use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Serialize;
use vizflyt_protocol::messages::FlightPhase;

use crate::flights::vehicle::VehicleFlight;
use crate::web::access::Viewer;
use crate::web::http::refuse;
use crate::web::origin;
use crate::web::state::{Page, vehicle};

/// A vehicle in the list.
#[derive(Debug, Serialize)]
pub(in crate::web) struct VehicleLine {
    name: String,
    phase: FlightPhase,
    /// Program of the connected runtime.
    runtime: Option<String>,
    cameras: Vec<String>,
}

impl VehicleLine {
    pub(in crate::web) fn of(page: &Page, vehicle: &VehicleFlight) -> Self {
        let cameras = page.rooms.rendering.cameras[vehicle.index].newest();
        Self {
            name: vehicle.name.to_string(),
            phase: vehicle.phase(),
            runtime: vehicle.runtime().map(|runtime| runtime.program.to_string()),
            cameras: cameras.configs.iter().map(|camera| camera.name.clone()).collect(),
        }
    }
}

/// Lists all vehicles that the viewer may see.
pub(in crate::web) async fn list(
    State(page): State<Arc<Page>>,
    Extension(viewer): Extension<Viewer>,
) -> Response {
    let seen = page.rooms.flights.vehicles.iter().filter(|vehicle| viewer.may_see(&vehicle.name));
    Json(seen.map(|vehicle| VehicleLine::of(&page, vehicle)).collect::<Vec<_>>()).into_response()
}

pub(in crate::web) async fn stop_all(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    press(&page.rooms.flights.vehicles)
}

pub(in crate::web) async fn stop(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
    headers: HeaderMap,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    match vehicle(&page, &name) {
        Ok(vehicle) => press(std::slice::from_ref(vehicle)),
        Err(none) => *none,
    }
}

/// Permits a vehicle to take off.
pub(in crate::web) async fn start(
    page: State<Arc<Page>>,
    name: Path<String>,
    headers: HeaderMap,
) -> Response {
    let start = |page: &Page, vehicle: &VehicleFlight| {
        page.lab.may_start(&page.rooms.flights, &vehicle.name)?;
        vehicle.start(BY)
    };
    order(&page, &name, &headers, start, "it takes off")
}

/// Ends a flight with a normal landing.
pub(in crate::web) async fn land(
    page: State<Arc<Page>>,
    name: Path<String>,
    headers: HeaderMap,
) -> Response {
    order(&page, &name, &headers, |_, vehicle| vehicle.land(BY), "it brakes and lands")
}

/// Resets a vehicle's run.
pub(in crate::web) async fn reset(
    page: State<Arc<Page>>,
    name: Path<String>,
    headers: HeaderMap,
) -> Response {
    let reset = |page: &Page, vehicle: &VehicleFlight| {
        vehicle.reset(BY)?;
        page.rooms.streaming.vehicles[vehicle.index].begin_flight();
        Ok(())
    };
    order(&page, &name, &headers, reset, "the run is reset")
}

fn order(
    page: &Page,
    name: &str,
    headers: &HeaderMap,
    give: impl FnOnce(&Page, &VehicleFlight) -> Result<(), String>,
    done: &'static str,
) -> Response {
    if let Err(refusal) = origin::check(headers) {
        return refuse(&refusal);
    }
    match vehicle(page, name) {
        Ok(vehicle) => match give(page, vehicle) {
            Ok(()) => (StatusCode::ACCEPTED, done).into_response(),
            Err(why) => (StatusCode::CONFLICT, why).into_response(),
        },
        Err(none) => *none,
    }
}

/// Presses the button of each vehicle, even without a runtime: one that reconnects during its flight receives the stop.
fn press(vehicles: &[Arc<VehicleFlight>]) -> Response {
    let (obey, absent): (Vec<_>, Vec<_>) =
        vehicles.iter().partition(|vehicle| vehicle.emergency_stop(BY));
    let names = |vehicles: &[&Arc<VehicleFlight>]| {
        vehicles.iter().map(|vehicle| vehicle.name.as_str()).collect::<Vec<_>>().join(", ")
    };
    let status = if obey.is_empty() { StatusCode::CONFLICT } else { StatusCode::ACCEPTED };
    let text = match (&*obey, &*absent) {
        ([_], []) => "the runtime lands the vehicle".to_owned(),
        (obey, []) => format!("the runtimes land {}", names(obey)),
        ([], _) => "no runtime is connected that could land the vehicle".to_owned(),
        (obey, absent) => {
            format!("the runtimes land {}; no runtime flies {}", names(obey), names(absent))
        }
    };
    (status, text).into_response()
}

/// Name of the page in events.
const BY: &str = "the page";

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
    let line = |runtime| VehicleLine {
        name: "vizflyt".to_owned(),
        phase: FlightPhase::Flying,
        runtime,
        cameras: vec!["front".to_owned()],
    };
    vec![serde_json::json!(line(Some("vizflyt".to_owned()))), serde_json::json!(line(None))]
}
