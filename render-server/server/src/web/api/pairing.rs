//! Pairing on the page: `GET /api/pairing` returns its status, `POST` opens one, `DELETE` closes it. Instructor only
//! ([`super::access`]).

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::Grant;

use crate::authorization::parse_grant;
use crate::web::http::refuse;
use crate::web::origin;
use crate::web::state::Page;

/// Status of pairing.
#[derive(Debug, Serialize)]
struct PairingStatus {
    /// The open pairing.
    open: Option<Open>,
    /// Result of the newest attempt.
    news: String,
    /// Port to which the other computer connects.
    port: u16,
}

#[derive(Debug, Serialize)]
struct Open {
    code: String,
    /// `instructor`, or the names of vehicles.
    right: String,
    left_s: f64,
    tries_left: u32,
}

/// The right to grant: `instructor` or `team:VEHICLE[,VEHICLE...]`, as for `--pair`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OpenRequest {
    right: String,
}

pub(in crate::web) async fn standing(State(page): State<Arc<Page>>) -> Response {
    respond(&page)
}

pub(in crate::web) async fn open(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let request = serde_json::from_slice::<OpenRequest>(&body).map_err(|error| error.to_string());
    let grant = match request.and_then(|request| parse_grant(&request.right)) {
        Ok(grant) => grant,
        Err(error) => return (StatusCode::BAD_REQUEST, error).into_response(),
    };
    if let Grant::Team { vehicles } = &grant
        && let Some(Err(unknown)) =
            vehicles.iter().map(|v| page.rooms.flights.vehicle(v)).find(Result::is_err)
    {
        return (StatusCode::BAD_REQUEST, unknown).into_response();
    }
    match page.authorizer.open_pairing(grant) {
        Ok(_) => respond(&page),
        Err(error) => (StatusCode::CONFLICT, error).into_response(),
    }
}

pub(in crate::web) async fn shut(State(page): State<Arc<Page>>, headers: HeaderMap) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    page.authorizer.shut_pairing();
    respond(&page)
}

fn respond(page: &Page) -> Response {
    let open = page.authorizer.pairing().map(|window| Open {
        code: window.code.to_string(),
        right: match &window.grant {
            Grant::Instructor => "instructor".to_owned(),
            Grant::Team { vehicles } => {
                let names: Vec<_> = vehicles.iter().map(ToString::to_string).collect();
                names.join(", ")
            }
        },
        left_s: window.left.as_secs_f64(),
        tries_left: window.tries_left,
    });
    let mut response = Json(PairingStatus {
        open,
        news: page.authorizer.newest_pairing_news(),
        port: page.quic_port,
    })
    .into_response();
    let no_store = axum::http::HeaderValue::from_static("no-store");
    response.headers_mut().insert(axum::http::header::CACHE_CONTROL, no_store);
    response
}

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
    let open = Open {
        code: "123 456".to_owned(),
        right: "instructor".to_owned(),
        left_s: 60.0,
        tries_left: 3,
    };
    let standing =
        |open| serde_json::json!(PairingStatus { open, news: String::new(), port: 4433 });
    vec![standing(Some(open)), standing(None)]
}
