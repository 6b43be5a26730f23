//! Light and weather on the page: `GET /api/environment` returns the current environment and all named ones, `PUT
//! /api/environment` changes it, also in flight. Instructor only ([`super::routes`]).

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::{Map, Value};
use vizflyt_arena::config::EnvironmentConfig;

use crate::web::http::ordered;
use crate::web::state::Page;

/// Current environment, and the named ones.
#[derive(Debug, Serialize)]
struct EnvironmentStatus {
    /// Name of the current environment, if it has one.
    name: Option<&'static str>,
    #[serde(flatten)]
    now: EnvironmentConfig,
    names: Vec<&'static str>,
}

pub(in crate::web) async fn get(State(page): State<Arc<Page>>) -> Response {
    Json(status(&page.rooms.rendering.environment.now())).into_response()
}

/// Changes the environment: `{"name": "night"}`, or the keys of `[environment]`.
pub(in crate::web) async fn change(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let request = match ordered::<Map<String, Value>>(&headers, body) {
        Ok(request) => request,
        Err(refusal) => return *refusal,
    };
    let environment = match parse(request) {
        Ok(environment) => environment,
        Err(why) => return (StatusCode::BAD_REQUEST, why).into_response(),
    };
    match page.rooms.rendering.environment.change(environment) {
        Ok(true) => {
            let name = environment.name().unwrap_or("the page's own");
            page.rooms.flights.note(&format!("light and weather are changed to: {name}"));
        }
        // Unchanged settings are not an event.
        Ok(false) => {}
        Err(error) => return (StatusCode::BAD_REQUEST, error.to_string()).into_response(),
    }
    Json(status(&environment)).into_response()
}

fn parse(request: Map<String, Value>) -> Result<EnvironmentConfig, String> {
    let Some(name) = request.get("name").filter(|_| request.len() == 1) else {
        return serde_json::from_value(Value::Object(request)).map_err(|error| error.to_string());
    };
    let named = name.as_str().and_then(EnvironmentConfig::named);
    named.ok_or_else(|| {
        let names =
            EnvironmentConfig::NAMED.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
        format!("no environment is called {name}; there are {names}")
    })
}

fn status(now: &EnvironmentConfig) -> EnvironmentStatus {
    let names = EnvironmentConfig::NAMED.iter().map(|(name, _)| *name).collect();
    EnvironmentStatus { name: now.name(), now: *now, names }
}

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
    use glam::DVec3;
    use vizflyt_arena::config::{
        CloudConfig, FlickerConfig, LampsConfig, OwnLightConfig, RainConfig, SnowConfig, SunConfig,
    };
    let positions_m = Some(vec![DVec3::ONE].try_into().expect("one lamp"));
    let own = EnvironmentConfig {
        fog_visibility_m: 7.5,
        exposure_ms: 2.5,
        depth_loss: true,
        cloud: Some(CloudConfig {
            layer_m: Some([0.0, 1.5]),
            center_m: Some(DVec3::ONE),
            radius_m: Some(2.5),
            ..CloudConfig::USUAL
        }),
        rain: Some(RainConfig::USUAL),
        snow: Some(SnowConfig::USUAL),
        sun: Some(SunConfig::USUAL),
        lamps: Some(LampsConfig { positions_m, ..LampsConfig::USUAL }),
        own_light: Some(OwnLightConfig::USUAL),
        flicker: Some(FlickerConfig::USUAL),
        ..EnvironmentConfig::default()
    };
    [EnvironmentConfig::default(), own].map(|now| serde_json::json!(status(&now))).into()
}
