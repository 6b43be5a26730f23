//! `GET /api/stats`: where the images of a vehicle get their age, what became of them, and how its
//! connection fares. `vizflyt stats` and the page show it.

use std::sync::Arc;

use axum::Json;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::Page;
use crate::stats::VehicleStats;

#[derive(Debug, Deserialize)]
pub(super) struct Question {
    /// Name; the first one without.
    vehicle: Option<String>,
}

/// Answers with the figures of a vehicle.
pub(super) async fn get(
    State(page): State<Arc<Page>>,
    question: Result<Query<Question>, QueryRejection>,
) -> Response {
    let vehicle = match question {
        Ok(Query(Question { vehicle: Some(name) })) => page.hub.vehicle(&name).map(Arc::clone),
        Ok(Query(Question { vehicle: None })) => Ok(page.hub.vehicles[0].clone()),
        Err(rejection) => return rejection.into_response(),
    };
    match vehicle {
        Ok(vehicle) => Json(VehicleStats::of(&page.hub, &vehicle)).into_response(),
        // What follows the semicolon is for a runtime.
        Err(why) => {
            let why = why.split(';').next().unwrap_or_default().to_owned();
            (StatusCode::NOT_FOUND, why).into_response()
        }
    }
}
