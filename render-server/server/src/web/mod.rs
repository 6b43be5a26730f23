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
//! GET /api/vehicles/V/crash           what its last failed flight looked like at its end, JSON ([`api::crash`])
//! GET /api/vehicles/V/crash/ID/CAMERA/KIND/N   an image of that, JPEG; KIND is colour or depth
//! PUT /api/vehicles/V/cameras/NAME    a whole camera, by the keys of `[[cameras]]`; from the next
//!                                     tick on
//! PATCH /api/vehicles/V/cameras/NAME  as PUT, but only what is given changes
//! ```
//! ```text
//! GET /api/leaderboard        the standings of the course, JSON; GET /wall shows them large ([`api::leaderboard`])
//! PUT /api/vehicles/V/team    a team checks in by its token; POST: the instructor names it; DELETE: nobody
//! ```
//! `/lab` is the checklist and the queue of a lab day ([`lab`]).
//! `GET /api/scenes` lists the scenes to choose from, `PUT /api/scene` changes to one ([`api::scenes`]);
//! `GET` and `PUT /api/environment` are its light and weather ([`api::environment`]).
//! Whoever is not on this computer logs in or needs a key, for everything but the page's own files
//! ([`guard`]); all routes are in one table ([`routes`]):
//! ```text
//! GET /enter?key=K     exchanges a key for a cookie
//! GET /api/session     who the server takes the viewer for, and the token of whoever has a cookie
//! POST /api/login, /api/logout     the instructor's password for a session ([`password`])
//! GET, POST, DELETE /api/pairing   the open pairing, its code; the instructor's ([`api::pairing`])
//! ```
//! A viewer that reads slowly gets fewer pictures and states, never old ones, and holds up
//! nobody. Only pages of the same origin may watch or stop ([`origin`]).

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

#[cfg(test)]
mod tests;
