//! Page of `vizflyt scene align`: the view, with a panel that records clicks as points of the room.
//!
//! ```text
//! GET  /align.js          panel
//! GET  /api/align         Setup: the arena of the file
//! POST /api/align/pick    pixel -> point of the scene, or the reason of a failure
//! POST /api/align/solve   Picks -> Solved: placement, its accuracy as text, go or no-go
//! POST /api/align/save    Wish -> writes arena.toml, or returns the reason of a failure
//! ```
//! The page stores the clicks; the server stores nothing. The caller solves ([`Aligner`]), because this crate imports
//! no solver. Requests must come from this server's page; only a browser on this computer may write.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{ConnectInfo, DefaultBodyLimit, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{Geofence, Spawn, StageConfig};

use super::engine::{Engine, Request};
use super::place::Place;
use crate::web::http::{file, ordered, ordered_here};
use vizflyt_process::lock;

/// Computes a placement from clicks, and saves it.
pub trait Aligner: Send + Sync {
    /// Returns the scene's placement.
    ///
    /// # Errors
    /// Text that names the missing picks.
    fn solve(&self, picks: &Picks) -> Result<Solved, String>;

    /// Writes the placement into the arena's file; returns the report.
    ///
    /// # Errors
    /// Reason for which nothing was written.
    fn save(&self, wish: &Wish) -> Result<Vec<Line>, String>;
}

/// Points that a person has clicked, in the axes and units of the scene's file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Picks {
    /// Points of the floor: the first is at `origin_at_m`, the second gives the heading.
    pub floor: Vec<DVec3>,
    /// A point above the floor.
    pub above: DVec3,
    /// A known length. Without it, the scene keeps its size.
    pub length: Option<Length>,
    /// Position of the first floor point; above z = 0 if it is on a table. [m, world]
    pub origin_at_m: DVec3,
    /// Heading from the first to the second point, counter-clockwise from x. [deg]
    pub yaw_deg: f64,
    /// Fence within which the accuracy of the twin is evaluated. [m, world]
    pub geofence: Geofence,
    /// Roughness of the clicked surfaces, root mean square. [m]
    pub rough_m: f64,
}

/// A length that was measured in the room.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Length {
    /// Its ends, in the scene's file.
    pub ends: [DVec3; 2],
    /// Measured length. [m]
    pub metres: f64,
}

/// Request to save.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wish {
    /// The placement, with its fence.
    pub picks: Picks,
    /// Start of flights.
    pub spawn: Spawn,
    /// Whether to save an insufficiently accurate placement.
    pub force: bool,
}

/// A placement, and its report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Solved {
    /// Placement of the scene's file.
    pub place: Place,
    /// Report, as on the command line.
    pub lines: Vec<Line>,
    /// Whether the accuracy is sufficient; `None` if the scale is unknown.
    pub go: Option<bool>,
}

/// A line of a report: keyword and text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Line {
    /// Keyword of one word.
    pub key: &'static str,
    pub text: String,
}

/// Initial data of the page.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Setup {
    place: Place,
    geofence: Geofence,
    spawn: Spawn,
    takeoff_height_m: f64,
    body_radius_m: f64,
    stages: Vec<StageConfig>,
    /// Crop box; does not move with the scene.
    crop: Option<Geofence>,
}

impl Setup {
    pub(super) fn new(arena: &ArenaConfig, place: Place) -> Self {
        Self {
            place,
            geofence: arena.geofence,
            spawn: arena.spawn,
            takeoff_height_m: arena.takeoff_height_m,
            body_radius_m: arena.body_radius_m,
            stages: arena.stages.clone(),
            crop: arena.scene.crop,
        }
    }
}

/// Shared state of the panel's routes.
pub(super) struct Panel {
    pub(super) engine: Arc<Mutex<Engine>>,
    pub(super) aligner: Arc<dyn Aligner>,
    pub(super) setup: Setup,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Click {
    /// Request of the image.
    request: Request,
    /// Pixel in the image. [px]
    px: DVec2,
}

/// Returns the routes of the panel.
pub(super) fn routes(panel: Panel) -> Router {
    const SCRIPT: &str = "text/javascript; charset=utf-8";
    Router::new()
        .route("/align.js", get(async || file(SCRIPT, include_str!("../page/align.js"))))
        .route("/api/align", get(setup))
        .route("/api/align/pick", post(pick))
        .route("/api/align/solve", post(solve))
        .route("/api/align/save", post(save))
        .layer(DefaultBodyLimit::max(MAX_ORDER))
        .with_state(Arc::new(panel))
}

async fn setup(State(panel): State<Arc<Panel>>) -> Response {
    Json(&panel.setup).into_response()
}

async fn pick(
    State(panel): State<Arc<Panel>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let Click { request, px } = match ordered(&headers, body) {
        Ok(click) => click,
        Err(refusal) => return *refusal,
    };
    let picked = tokio::task::spawn_blocking(move || lock(&panel.engine).pick(&request, px)).await;
    match picked {
        Ok(Ok(Ok(picked))) => Json(picked).into_response(),
        Ok(Ok(Err(nothing))) => refused(nothing.to_string()),
        Ok(Err(error)) => refused(format!("{error:#}")),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

async fn solve(
    State(panel): State<Arc<Panel>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    let picks: Picks = match ordered(&headers, body) {
        Ok(picks) => picks,
        Err(refusal) => return *refusal,
    };
    match check(&picks).and_then(|()| panel.aligner.solve(&picks)) {
        Ok(solved) => Json(solved).into_response(),
        Err(why) => refused(why),
    }
}

async fn save(
    State(panel): State<Arc<Panel>>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    const WHY: &str = "only a browser on this computer may write its files; open the page here, or through ssh -L";
    let wish: Wish = match ordered_here(from, WHY, &headers, body) {
        Ok(wish) => wish,
        Err(refusal) => return *refusal,
    };
    match check(&wish.picks).and_then(|()| panel.aligner.save(&wish)) {
        Ok(lines) => Json(lines).into_response(),
        Err(why) => refused(why),
    }
}

fn check(picks: &Picks) -> Result<(), String> {
    let count = picks.floor.len();
    if count > MAX_POINTS {
        return Err(format!("{count} points of the floor; {MAX_POINTS} are plenty"));
    }
    Ok(())
}

fn refused(why: String) -> Response {
    (StatusCode::UNPROCESSABLE_ENTITY, why).into_response()
}

/// Maximum number of floor points.
const MAX_POINTS: usize = 200;
/// Maximum request: the floor points, and the rest.
const MAX_ORDER: usize = 64 * 1024;

#[cfg(test)]
mod tests;
