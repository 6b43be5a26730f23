//! `vizflyt scene align`'s page: the view, with a panel that takes clicks for points of the room.
//!
//! ```text
//! GET  /align.js          the panel
//! GET  /api/align         Setup: the arena as its file has it
//! POST /api/align/pick    a pixel -> the point of the scene there, or why there is none
//! POST /api/align/solve   Picks -> Solved: the place, in words how well it is known, go or no-go
//! POST /api/align/save    Wish -> arena.toml is written, or why not
//! ```
//! The page holds what was clicked; nothing is kept here. Solving is the caller's ([`Aligner`]): this crate imports no solver.
//! As all that acts, requests must come from a page of ours; and only a browser on this computer may write.

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

/// Finds a place from what was clicked, and writes it down.
pub trait Aligner: Send + Sync {
    /// Returns the scene's place.
    ///
    /// # Errors
    /// What the picks lack, in words.
    fn solve(&self, picks: &Picks) -> Result<Solved, String>;

    /// Writes the place into the arena's file; returns what was done, in words.
    ///
    /// # Errors
    /// Why nothing was written, in words.
    fn save(&self, wish: &Wish) -> Result<Vec<Line>, String>;
}

/// What a person has pointed at. Points are of the scene's file, in its own axes and units.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Picks {
    /// Points of the floor: the first is where `origin_at_m` is, the second lies ahead of it.
    pub floor: Vec<DVec3>,
    /// A point above the floor.
    pub above: DVec3,
    /// What is known to be how long; without, the scene keeps the size that it has.
    pub length: Option<Length>,
    /// Where the first point of the floor lies; above z = 0, if it is a table's. [m, world]
    pub origin_at_m: DVec3,
    /// The direction from the first to the second, counter-clockwise from x. [deg]
    pub yaw_deg: f64,
    /// Within it, the twin must not be off. [m, world]
    pub geofence: Geofence,
    /// How rough what was clicked at is, root mean square. [m]
    pub rough_m: f64,
}

/// A length that was measured in the room.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Length {
    /// Its ends, in the scene's file.
    pub ends: [DVec3; 2],
    /// How long it is. [m]
    pub metres: f64,
}

/// What is to be written.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wish {
    /// The place, with its fence.
    pub picks: Picks,
    /// Where flights begin.
    pub spawn: Spawn,
    /// Even if it is not known well enough.
    pub force: bool,
}

/// A place, and what is to be said of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Solved {
    /// Where the scene's file lies.
    pub place: Place,
    /// As the command line prints it.
    pub lines: Vec<Line>,
    /// Whether it is known well enough; `None` where the scale is not known at all.
    pub go: Option<bool>,
}

/// A line of a report: what it is about, and what there is to say.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Line {
    /// One word.
    pub key: &'static str,
    /// The rest.
    pub text: String,
}

/// What the page begins with.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Setup {
    place: Place,
    geofence: Geofence,
    spawn: Spawn,
    takeoff_height_m: f64,
    body_radius_m: f64,
    stages: Vec<StageConfig>,
    /// It does not move along with the scene.
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

/// What the panel's routes share.
pub(super) struct Panel {
    pub(super) engine: Arc<Mutex<Engine>>,
    pub(super) aligner: Arc<dyn Aligner>,
    pub(super) setup: Setup,
}

/// A click.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Click {
    /// What the picture shows.
    request: Request,
    /// Where in it. [px]
    px: DVec2,
}

/// The panel's files and orders.
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

/// Points of a floor that a person clicks at, at most.
const MAX_POINTS: usize = 200;
/// So many of them, and the rest.
const MAX_ORDER: usize = 64 * 1024;

#[cfg(test)]
mod tests;
