//! The page: static files from the binary, one WebSocket per viewer, and the stop button.
//!
//! ```text
//! GET /            the page (no framework, nothing fetched from elsewhere)
//! GET /ws?vehicle=V   WebSocket: JSON text (arena, trail, events, state at 20 Hz) and binary
//!                  previews (camera, kind, JPEG) at 15 Hz at most, newest wins; of the first
//!                  vehicle, if none is named
//! GET /api/map     the top view: a JPEG drawn at the start
//! GET /api/stats   ages by stage, images skipped and why, JSON; ?vehicle=NAME
//! POST /api/estop  EmergencyStop to the runtimes of all vehicles
//! GET /api/vehicles                   the vehicles, JSON; below, V is the name of one
//! POST /api/vehicles/V/estop          EmergencyStop to its runtime
//! GET /api/vehicles/V/cameras         its cameras of this moment, JSON
//! PUT /api/vehicles/V/cameras/NAME    a whole camera, by the keys of `[[cameras]]`; from the next
//!                                     tick on
//! PATCH /api/vehicles/V/cameras/NAME  as PUT, but only what is given changes
//! ```
//! Whoever is not on this computer needs a key, for everything but the page's own files ([`access`]):
//! ```text
//! GET /enter?key=K     exchanges a key for a cookie
//! GET, POST, DELETE /api/pairing   the open pairing, its code; the instructor's ([`pairing`])
//! ```
//! A viewer that reads slowly gets fewer pictures and states, never old ones, and holds up
//! nobody. Only pages of the same origin may watch or stop ([`origin`]).

mod access;
mod cameras;
mod messages;
pub(crate) mod origin;
mod pairing;
mod stats;
mod vehicles;
mod viewer;

pub use access::PageKeys;

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::{Context, Result};
use axum::Router;
use axum::extract::{DefaultBodyLimit, Query, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post, put};
use serde::Deserialize;
use tokio::net::TcpListener;
use tracing::warn;
use vizflyt_arena::config::StageConfig;
use vizflyt_protocol::time::ServerTime;

use crate::door::Door;
use crate::hub::Hub;
use crate::map::Map;
use crate::vehicle::Vehicle;

/// What the page's handlers share.
#[derive(Debug)]
pub(crate) struct Page {
    pub(crate) hub: Arc<Hub>,
    pub(crate) map: Map,
    /// The course's gates, for the top view.
    pub(crate) stages: Vec<StageConfig>,
    /// When the server started; differs from start to start, so that a page notices a new server.
    pub(crate) boot: ServerTime,
    pub(crate) rates: messages::Rates,
    /// Who may see and do what.
    keys: PageKeys,
    /// Who may connect, and pairing.
    door: Arc<Door>,
    /// Where runtimes connect.
    quic_port: u16,
}

/// Binds the page's address.
pub async fn bind(address: SocketAddr) -> Result<TcpListener> {
    let listener = TcpListener::bind(address).await.with_context(|| {
        format!("cannot listen on {address} (page); is the port taken? try --http 127.0.0.1:0")
    })?;
    if !address.ip().is_loopback() {
        warn!(
            "the page at {address} asks for keys, but plain HTTP lets everyone on that network read \
             them; use --http 127.0.0.1:8080 to keep it to this computer"
        );
    }
    Ok(listener)
}

/// Serves the page until the server stops.
pub async fn serve(
    hub: Arc<Hub>,
    door: Arc<Door>,
    keys: PageKeys,
    map: Map,
    stages: Vec<StageConfig>,
    quic_port: u16,
    listener: TcpListener,
) -> Result<()> {
    let stop = hub.stop.clone();
    let (boot, rates) = (crate::clock::now(), messages::Rates::of(hub.vehicles.len()));
    let page = Arc::new(Page { hub, map, stages, boot, rates, keys, door, quic_port });
    let router = router(page).into_make_service_with_connect_info::<SocketAddr>();
    // Dropped at the stop rather than drained: WebSockets would drain for ever.
    tokio::select! {
        served = axum::serve(listener, router) => served.context("the page's server failed"),
        () = stop.wait() => Ok(()),
    }
}

fn router(page: Arc<Page>) -> Router {
    Router::new()
        .route("/", get(async || file("text/html; charset=utf-8", INDEX)))
        .route("/style.css", get(async || file("text/css; charset=utf-8", STYLE)))
        .route("/app.js", get(async || file("text/javascript; charset=utf-8", APP)))
        .route("/map.js", get(async || file("text/javascript; charset=utf-8", MAP)))
        .route("/cameras.js", get(async || file("text/javascript; charset=utf-8", CAMERAS)))
        .route("/waterfall.js", get(async || file("text/javascript; charset=utf-8", WATERFALL)))
        .route("/icon.svg", get(async || file("image/svg+xml", ICON)))
        .route("/api/map", get(map))
        .route("/api/stats", get(stats::get))
        .route("/api/estop", post(vehicles::stop_all))
        .route("/api/vehicles", get(vehicles::list))
        .route("/api/vehicles/{vehicle}/estop", post(vehicles::stop))
        .route("/api/vehicles/{vehicle}/cameras", get(cameras::list))
        .route("/api/vehicles/{vehicle}/cameras/{name}", put(cameras::put).patch(cameras::patch))
        .route("/pairing.js", get(async || file("text/javascript; charset=utf-8", PAIRING)))
        .route("/api/pairing", get(pairing::standing).post(pairing::open).delete(pairing::shut))
        .route("/enter", get(access::enter))
        .route("/ws", get(watch))
        // Also before routes that are not there: what exists is nobody's business.
        .layer(middleware::from_fn_with_state(page.clone(), access::guard))
        // A camera takes some hundred bytes.
        .layer(DefaultBodyLimit::max(16 << 10))
        .with_state(page)
}

pub(crate) fn file(kind: &'static str, text: &'static str) -> Response {
    let mut response = text.into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    for (name, value) in GUARDS {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    response
}

async fn map(State(page): State<Arc<Page>>) -> Response {
    let mut response = page.map.jpeg.clone().into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("image/jpeg"));
    for (name, value) in GUARDS {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    response
}

/// Returns the vehicle of this name, or the answer that there is none.
pub(crate) fn vehicle<'a>(page: &'a Page, name: &str) -> Result<&'a Arc<Vehicle>, Box<Response>> {
    let found = page.hub.vehicles.iter().find(|vehicle| vehicle.name == name);
    found.ok_or_else(|| {
        let names: Vec<_> = page.hub.vehicles.iter().map(|vehicle| &*vehicle.name).collect();
        let text = format!("there is no vehicle '{name}'; there are {}", names.join(", "));
        Box::new((StatusCode::NOT_FOUND, text).into_response())
    })
}

/// What `/ws` is asked for.
#[derive(Debug, Deserialize)]
struct Watched {
    vehicle: Option<String>,
}

async fn watch(
    State(page): State<Arc<Page>>,
    Query(watched): Query<Watched>,
    headers: HeaderMap,
    upgrade: Result<WebSocketUpgrade, axum::extract::ws::rejection::WebSocketUpgradeRejection>,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let named = watched.vehicle.map(|name| vehicle(&page, &name).cloned());
    let vehicle = match named.unwrap_or_else(|| Ok(page.hub.vehicles[0].clone())) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    match upgrade {
        // Viewers have nothing to say: a byte limit keeps a hostile one small.
        Ok(upgrade) => upgrade
            .max_message_size(1024)
            .on_upgrade(async move |socket| viewer::run(page, vehicle, socket).await),
        Err(rejection) => rejection.into_response(),
    }
}

pub(crate) fn refuse(refusal: &origin::Refusal) -> Response {
    warn!("page: {refusal}");
    (StatusCode::FORBIDDEN, refusal.to_string()).into_response()
}

const INDEX: &str = include_str!("page/index.html");
const STYLE: &str = include_str!("page/style.css");
const APP: &str = include_str!("page/app.js");
const CAMERAS: &str = include_str!("page/cameras.js");
const PAIRING: &str = include_str!("page/pairing.js");
const MAP: &str = include_str!("page/map.js");
const WATERFALL: &str = include_str!("page/waterfall.js");
pub(crate) const ICON: &str = include_str!("page/icon.svg");

/// Nothing from elsewhere, and no other page may frame ours and steal a click on the button.
const GUARDS: [(&str, &str); 5] = [
    (
        "content-security-policy",
        "default-src 'self'; img-src 'self' blob:; frame-ancestors 'none'; base-uri 'none'; \
         form-action 'none'",
    ),
    ("x-frame-options", "DENY"),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cache-control", "no-cache"),
];

#[cfg(test)]
mod tests;
