//! Web page of the server: static files from the binary, one WebSocket per viewer, stop button and settings.
//!
//! ```text
//! GET /            page (no framework, no files from other hosts)
//! GET /ws?vehicle=V   WebSocket: JSON text (arena, track, events, state at 20 Hz) and binary previews
//!                  (camera, kind, JPEG) at 15 Hz at most, newest wins; default: the first vehicle
//! GET /api/map     top view: a JPEG rendered at the start
//! GET /api/shell   solid cells for the instructor's 3D view ([`crate::web::top_view::shell`])
//! GET /api/splats/N   part N of the twin for the 3D view, SPZ ([`twin`])
//! GET /api/twin    image of the twin from any viewpoint, JPEG, for browsers that cannot render it
//!                  ([`twin_picture`])
//! GET /api/stats   image age by stage, dropped images with reasons, JSON; ?vehicle=NAME
//! POST /api/estop  EmergencyStop to the runtimes of all vehicles
//! GET /api/vehicles                   vehicles, JSON; V below is the name of a vehicle
//! POST /api/vehicles/V/estop          EmergencyStop to its runtime
//! POST /api/vehicles/V/start          permits take-off, if the vehicle waits for it
//! POST /api/vehicles/V/land           ends the flight: brakes, then lands
//! POST /api/vehicles/V/reset          on the ground: resets course, clock, path and figures
//! GET /api/vehicles/V/cameras         current cameras, JSON
//! GET /api/vehicles/V/crash           crash card of the last failed flight, JSON ([`api::crash`])
//! GET /api/vehicles/V/crash/ID/CAMERA/KIND/N   image of a crash card, JPEG; KIND is colour or depth
//! PUT /api/vehicles/V/cameras/NAME    replaces a camera, by the keys of `[[cameras]]`; takes effect
//!                                     at the next tick
//! PATCH /api/vehicles/V/cameras/NAME  changes only the given keys of a camera
//! ```
//! ```text
//! GET /api/leaderboard        standings of the course, JSON; GET /wall shows them large ([`api::leaderboard`])
//! PUT /api/vehicles/V/team    team checks in by its token; POST: the instructor sets it; DELETE: removes it
//! ```
//! `/lab` is the checklist and the queue of a lab day ([`lab`]).
//! `GET /api/scenes` lists the available scenes, `PUT /api/scene` selects one ([`api::scenes`]);
//! `GET` and `PUT /api/environment` are its light and weather ([`api::environment`]).
//! Viewers on other computers must log in or show a key, except for the page's static files
//! ([`guard`]); all routes are in one table ([`routes`]):
//! ```text
//! GET /enter?key=K     exchanges a key for a cookie
//! GET /api/session     role of the viewer; token, if the viewer has a cookie
//! POST /api/login, /api/logout     the instructor's password for a session ([`password`])
//! GET, POST, DELETE /api/pairing   open pairing and its code; instructor only ([`api::pairing`])
//! ```
//! A slow viewer receives fewer images and states, never outdated ones, and does not delay others.
//! Only pages of the same origin may watch or stop ([`origin`]).

mod access;
mod api;
mod editors;
mod guard;
mod http;
mod https;
mod lab;
mod listener;
pub(crate) mod messages;
pub(crate) mod origin;
mod password;
mod percent;
pub mod previews;
mod rates;
mod routes;
mod sessions;
mod state;
mod stats;
pub mod top_view;
pub mod twin;
mod twin_picture;
mod viewer;
mod watchers;

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Result;
use tokio::net::TcpListener;

pub use self::access::{Access, Login, Logins, PageKeys};
pub use self::api::lab::Evidence;
pub use self::editors::align::{Aligner, Length, Line, Picks, Solved, Wish};
pub use self::editors::course::{Course, CourseFile};
pub use self::editors::{Place, ViewArgs, align, edit, set_up, view};
pub use self::guard::Takes;
pub(crate) use self::https::PageTls;
pub(crate) use self::lab::{Lab, follow as follow_lab};
pub use self::password::set_password;
pub(crate) use self::rates::Rates;
pub use self::routes::list as routes;
pub(crate) use self::state::Page;
pub use self::stats::{ServerStages, VehicleStats};
pub(crate) use self::twin_picture::TwinPictures;

/// Binds the page's address, for HTTPS or plain HTTP. Plain HTTP on a public address requires `plain`.
///
/// # Errors
/// If binding fails, or plain HTTP is not permitted on this address.
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

#[cfg(test)]
mod tests;
