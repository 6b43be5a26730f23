//! `GET /api/stats`: figures of a vehicle's images.

use std::sync::Arc;

use axum::Json;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use crate::web::state::Page;
use crate::web::stats::VehicleStats;

#[derive(Debug, Deserialize)]
pub(in crate::web) struct StatsQuery {
    /// Name of the vehicle; default: the first one.
    vehicle: Option<String>,
}

pub(in crate::web) async fn get(
    State(page): State<Arc<Page>>,
    question: Result<Query<StatsQuery>, QueryRejection>,
) -> Response {
    let vehicle = match question {
        Ok(Query(StatsQuery { vehicle: Some(name) })) => page.rooms.flights.vehicle(&name),
        Ok(Query(StatsQuery { vehicle: None })) => Ok(&page.rooms.flights.vehicles[0]),
        Err(rejection) => return rejection.into_response(),
    };
    match vehicle {
        Ok(vehicle) => Json(VehicleStats::of(&page.rooms, vehicle)).into_response(),
        // The part after the semicolon is advice for runtimes.
        Err(why) => {
            let why = why.split(';').next().unwrap_or_default().to_owned();
            (StatusCode::NOT_FOUND, why).into_response()
        }
    }
}
