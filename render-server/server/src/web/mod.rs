//! The page: static files from the binary, one WebSocket per viewer, and the stop button.
//!
//! ```text
//! GET /            the page (no framework, nothing fetched from elsewhere)
//! GET /ws?vehicle=V   WebSocket: JSON text (arena, track, events, state at 20 Hz) and binary
//!                  previews (camera, kind, JPEG) at 15 Hz at most, newest wins; of the first
//!                  vehicle, if none is named
//! GET /api/map     the top view: a JPEG rendered at the start
//! GET /api/shell   what is solid, as cells, for the instructor's view in space
//!                  ([`crate::web::top_view::shell`])
//! GET /api/splats/N   part N of the twin itself, for the same view, SPZ ([`twin`])
//! GET /api/twin    a picture of the twin from anywhere, for browsers that cannot draw it, JPEG
//!                  ([`twin_picture`])
//! GET /api/stats   ages by stage, images skipped and why, JSON; ?vehicle=NAME
//! POST /api/estop  EmergencyStop to the runtimes of all vehicles
//! GET /api/vehicles                   the vehicles, JSON; below, V is the name of one
//! POST /api/vehicles/V/estop          EmergencyStop to its runtime
//! POST /api/vehicles/V/start          lets it take off, if it waits for that
//! POST /api/vehicles/V/land           ends its flight: it brakes, then lands
//! POST /api/vehicles/V/reset          on the ground: course, clock, path and figures begin anew
//! GET /api/vehicles/V/cameras         its cameras of this moment, JSON
//! GET /api/vehicles/V/crash           what its last failed flight looked like at its end, JSON ([`crash`])
//! GET /api/vehicles/V/crash/ID/CAMERA/KIND/N   an image of that, JPEG; KIND is colour or depth
//! PUT /api/vehicles/V/cameras/NAME    a whole camera, by the keys of `[[cameras]]`; from the next
//!                                     tick on
//! PATCH /api/vehicles/V/cameras/NAME  as PUT, but only what is given changes
//! ```
//! ```text
//! GET /api/leaderboard        the standings of the course, JSON; GET /wall shows them large ([`leaderboard`])
//! PUT /api/vehicles/V/team    a team checks in by its token; POST: the instructor names it; DELETE: nobody
//! ```
//! `/lab` is the checklist and the queue of a lab day ([`lab`]).
//! `GET /api/scenes` lists the scenes to choose from, `PUT /api/scene` changes to one ([`scenes`]);
//! `GET` and `PUT /api/environment` are its light and weather ([`environment`]).
//! Whoever is not on this computer logs in or needs a key, for everything but the page's own files
//! ([`access`]); all routes are in one table ([`routes`]):
//! ```text
//! GET /enter?key=K     exchanges a key for a cookie
//! GET /api/session     who the server takes the viewer for, and the token of whoever has a cookie
//! POST /api/login, /api/logout     the instructor's password for a session ([`login`])
//! GET, POST, DELETE /api/pairing   the open pairing, its code; the instructor's ([`pairing`])
//! ```
//! A viewer that reads slowly gets fewer pictures and states, never old ones, and holds up
//! nobody. Only pages of the same origin may watch or stop ([`origin`]).

mod access;
mod cameras;
mod crash;
mod environment;
mod https;
mod lab;
mod leaderboard;
mod listener;
mod login;
pub(crate) mod messages;
pub(crate) mod origin;
mod pairing;
pub mod previews;
mod routes;
mod scenes;
mod sensors;
mod sessions;
mod stats;
pub mod top_view;
pub mod twin;
mod twin_picture;
mod vehicles;
mod view;
mod viewer;

pub use access::{Access, Login, Logins, PageKeys, Takes};
pub use lab::Evidence;
pub(crate) use lab::{Lab, follow as follow_lab};
pub use login::set_password;
pub use routes::list as routes;
pub use stats::{ServerStages, VehicleStats};
pub use view::align::{Aligner, Length, Line, Picks, Solved, Wish};
pub use view::course::{Course, CourseFile};
pub use view::{Place, ViewArgs, align, edit, set_up, view};

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use anyhow::Result;
use axum::Extension;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{Query, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use tokio::net::TcpListener;
use tracing::warn;
use vizflyt_arena::config::StageConfig;
use vizflyt_protocol::time::ServerTime;

use self::access::Shown;
pub(crate) use self::https::PageTls;
use self::listener::ConnectionPlace;
use self::previews::Previews;
use crate::authorization::Authorizer;
use crate::flights::vehicle::VehicleFlight;
use crate::rate_limit::RateLimiter;
use crate::scene::Scenes;
use crate::stream::Rooms;
use crate::web::top_view::TopView;
use crate::web::twin::TwinParts;
pub(crate) use crate::web::twin_picture::TwinPictures;

/// What the page's handlers share.
#[derive(Debug)]
pub(crate) struct Page {
    pub(crate) rooms: Rooms,
    pub(crate) previews: Arc<Previews>,
    pub(crate) top_view: TopView,
    pub(crate) twin: TwinParts,
    pub(crate) twin_pictures: TwinPictures,
    /// The course's gates, for the top view.
    pub(crate) stages: Vec<StageConfig>,
    /// When the server started; differs from start to start, so that a page notices a new server.
    pub(crate) boot: ServerTime,
    pub(crate) rates: messages::Rates,
    /// The lab day.
    pub(crate) lab: Arc<Lab>,
    /// Who may see and do what.
    pub(crate) access: Arc<Access>,
    /// Who may connect, and pairing.
    pub(crate) authorizer: Arc<Authorizer>,
    /// Where runtimes connect.
    pub(crate) quic_port: u16,
    /// Rate limiter for invalid team tokens.
    pub(crate) team_tries: Mutex<RateLimiter>,
    /// The scenes to choose from.
    pub(crate) scenes: Arc<Scenes>,
    /// Who watches, by WebSocket.
    pub(crate) watchers: Mutex<viewer::Watchers>,
}

/// Binds the page's address, for HTTPS or for plain HTTP; the latter not on a public address, unless
/// `plain` asks for it.
///
/// # Errors
/// An address that cannot be had, or is not to be had plainly.
pub(crate) fn bind(address: SocketAddr, tls: Option<&PageTls>, plain: bool) -> Result<TcpListener> {
    if tls.is_none() {
        https::check_plain(address, plain)?;
    }
    listener::bind(address)
}

/// Serves the page until the server stops.
pub(crate) async fn serve(page: Page, listener: TcpListener, tls: Option<PageTls>) {
    let stop = page.rooms.stop.clone();
    listener::serve(listener, tls, routes::router(Arc::new(page)), stop).await;
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
    picture("image/jpeg", page.top_view.jpeg.clone())
}

async fn shell(State(page): State<Arc<Page>>) -> Response {
    picture("application/octet-stream", page.top_view.shell.clone())
}

fn picture(kind: &'static str, bytes: Bytes) -> Response {
    let mut response = bytes.into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    for (name, value) in GUARDS {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    response
}

/// Returns the vehicle of this name, or the answer that there is none.
pub(crate) fn vehicle<'a>(
    page: &'a Page,
    name: &str,
) -> Result<&'a Arc<VehicleFlight>, Box<Response>> {
    let found = page.rooms.flights.vehicles.iter().find(|vehicle| vehicle.name == name);
    found.ok_or_else(|| {
        let names: Vec<_> =
            page.rooms.flights.vehicles.iter().map(|vehicle| &*vehicle.name).collect();
        let text = format!("there is no vehicle '{name}'; there are {}", names.join(", "));
        Box::new((StatusCode::NOT_FOUND, text).into_response())
    })
}

/// Returns what a page of ours orders in JSON, or the answer that refuses it.
pub(crate) fn ordered<T: DeserializeOwned>(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<T, Box<Response>> {
    origin::check(headers).map_err(|refusal| Box::new(refuse(&refusal)))?;
    let body = body.map_err(|rejection| Box::new(rejection.into_response()))?;
    serde_json::from_slice(&body)
        .map_err(|error| Box::new((StatusCode::BAD_REQUEST, error.to_string()).into_response()))
}

/// What `/ws` is asked for.
#[derive(Debug, Deserialize)]
struct Watched {
    vehicle: Option<String>,
}

async fn watch(
    State(page): State<Arc<Page>>,
    Query(watched): Query<Watched>,
    Extension(shown): Extension<Shown>,
    place: Option<Extension<ConnectionPlace>>,
    headers: HeaderMap,
    upgrade: Result<WebSocketUpgrade, axum::extract::ws::rejection::WebSocketUpgradeRejection>,
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
        // Viewers have nothing to send: a byte limit keeps a hostile one small.
        Ok(upgrade) => upgrade.max_message_size(1024).on_upgrade(async move |socket| {
            // Held for as long as it watches, and not to be taken from it.
            if let Some(Extension(place)) = &place {
                place.serve(Some(&shown.viewer));
            }
            viewer::run(page, vehicle, shown, socket).await;
        }),
        Err(rejection) => rejection.into_response(),
    }
}

pub(crate) fn refuse(refusal: &origin::Refusal) -> Response {
    warn!("page: {refusal}");
    (StatusCode::FORBIDDEN, refusal.to_string()).into_response()
}

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
