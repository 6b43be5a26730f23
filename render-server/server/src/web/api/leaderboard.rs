//! The leaderboard over HTTP: standings for the page and the wall, and check-in of teams.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use axum::extract::{ConnectInfo, Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};
use tracing::warn;
use vizflyt_protocol::messages::FlightPhase;

use crate::flights::check_in::{self, CheckIn, Claim};
use crate::flights::leaderboard::{
    Attempt, GradeBoard, LeaderboardError, Run, Standing, grade_boards, standings,
};
use crate::flights::vehicle::VehicleFlight;
use crate::web::access::{Shown, Viewer};
use crate::web::http::refuse;
use crate::web::origin;
use crate::web::state::{Page, vehicle};
use vizflyt_process::lock;

/// Data of the page and the wall.
#[derive(Debug, Serialize)]
struct Board {
    /// Name of the arena.
    course: String,
    /// Ranking by official runs.
    official: Vec<Standing>,
    /// Ranking by practice runs.
    practice: Vec<Standing>,
    /// Rankings by signed grades, for all projects.
    graded: Vec<GradeBoard>,
    /// Newest runs, newest first.
    newest: Vec<Run>,
    /// Vehicles that fly or are about to.
    vehicles: Vec<Flyer>,
}

/// A vehicle, and the team that has checked in.
#[derive(Debug, Serialize)]
struct Flyer {
    vehicle: String,
    team: Option<String>,
    attempt: Attempt,
    phase: FlightPhase,
    /// Time since take-off, during a flight. [s]
    flight_s: Option<f64>,
}

/// `GET /api/leaderboard`: standings of this server's course.
pub(in crate::web) async fn show(State(page): State<Arc<Page>>) -> Response {
    let Some(board) = &page.rooms.flights.leaderboard else { return none_kept() };
    let course = page.rooms.flights.vehicles[0].arena.name.as_str().to_owned();
    let runs = match board.runs(Some(&course)).await {
        Ok(runs) => runs,
        Err(error) => return failed(&error),
    };
    let grades = match board.grades().await {
        Ok(grades) => grades,
        Err(error) => return failed(&error),
    };
    let now = crate::clock::now();
    let flyer = |vehicle: &Arc<VehicleFlight>| {
        let (by, flight) = (lock(&vehicle.checked_in).clone(), vehicle.flight());
        let flight_s = flight.took_off.filter(|_| flight.landed.is_none());
        Flyer {
            vehicle: vehicle.name.as_str().to_owned(),
            team: by.as_ref().map(|by| by.team.clone()),
            attempt: by.map_or(Attempt::Practice, |by| by.attempt),
            phase: vehicle.phase(),
            flight_s: flight_s.map(|at| now.seconds_since(at)),
        }
    };
    let answer = Board {
        official: standings(&runs, &course, Attempt::Official),
        practice: standings(&runs, &course, Attempt::Practice),
        graded: grade_boards(&grades),
        vehicles: page.rooms.flights.vehicles.iter().map(flyer).collect(),
        newest: runs.into_iter().take(NEWEST).collect(),
        course,
    };
    Json(answer).into_response()
}

/// Check-in of a team: by its token, or set by the instructor.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::web) struct CheckingIn {
    token: Option<String>,
    team: Option<String>,
    #[serde(default)]
    attempt: Attempt,
}

/// `PUT /api/vehicles/V/team`: a team checks in on its vehicle by its token ([`crate::flights::check_in`]).
pub(in crate::web) async fn put(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    Json(asked): Json<CheckingIn>,
) -> Response {
    // Cookies may authorize this request, so pages of other sites are rejected.
    if let Err(refusal) = origin::check_navigation(&headers) {
        return refuse(&refusal);
    }
    let Some(board) = &page.rooms.flights.leaderboard else { return none_kept() };
    let Some(token) = &asked.token else {
        return (StatusCode::BAD_REQUEST, "give the team's token").into_response();
    };
    if !lock(&page.team_tries).may_try(Instant::now(), from.ip()) {
        return (StatusCode::TOO_MANY_REQUESTS, "too many wrong tokens; wait a minute")
            .into_response();
    }
    match board.team_of(token).await {
        Ok(Some(team)) => {
            let viewer = page.access.judge(from.ip(), &headers).map(|shown| shown.viewer);
            let claim = Claim {
                team: Some(&team),
                from: from.ip(),
                is_instructor: viewer == Some(Viewer::Instructor),
                has_vehicle: viewer.is_some_and(|viewer| viewer.may_see(&name)),
            };
            let by = CheckIn {
                team: team.clone(),
                attempt: asked.attempt,
                at: crate::clock::now(),
                from: Some(from.ip()),
            };
            take(&page, &name, claim, Some(by))
        }
        Ok(None) => {
            lock(&page.team_tries).charge(Instant::now(), from.ip());
            warn!("page: {from} came with a wrong team token");
            (StatusCode::UNAUTHORIZED, "no team has this token").into_response()
        }
        Err(error) => failed(&error),
    }
}

/// `POST /api/vehicles/V/team`: the instructor checks a team in by its name.
pub(in crate::web) async fn assign(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    Json(asked): Json<CheckingIn>,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let Some(board) = &page.rooms.flights.leaderboard else { return none_kept() };
    let teams = match board.teams().await {
        Ok(teams) => teams,
        Err(error) => return failed(&error),
    };
    let team = asked.team.unwrap_or_default();
    if teams.iter().any(|known| known.name == team && !known.retired) {
        let claim = Claim { team: None, from: from.ip(), is_instructor: true, has_vehicle: true };
        let (attempt, at) = (asked.attempt, crate::clock::now());
        return take(&page, &name, claim, Some(CheckIn { team, attempt, at, from: None }));
    }
    let names: Vec<_> = teams.iter().filter(|team| !team.retired).map(|team| &*team.name).collect();
    let text = match &*names {
        [] => "there are no teams yet: vizflyt leaderboard team add NAME".to_owned(),
        names => format!("there is no team '{team}'; there are {}", names.join(", ")),
    };
    (StatusCode::NOT_FOUND, text).into_response()
}

/// `DELETE /api/vehicles/V/team`: checks the current team out.
pub(in crate::web) async fn check_out(
    State(page): State<Arc<Page>>,
    Path(name): Path<String>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    Extension(shown): Extension<Shown>,
    headers: HeaderMap,
) -> Response {
    if let Err(refusal) = origin::check(&headers) {
        return refuse(&refusal);
    }
    let is_instructor = shown.viewer == Viewer::Instructor;
    take(
        &page,
        &name,
        Claim { team: None, from: from.ip(), is_instructor, has_vehicle: true },
        None,
    )
}

fn take(page: &Page, name: &str, claim: Claim<'_>, by: Option<CheckIn>) -> Response {
    let vehicle = match vehicle(page, name) {
        Ok(vehicle) => vehicle,
        Err(none) => return *none,
    };
    let (flight, runtime) = (vehicle.flight(), vehicle.runtime());
    let runtime = runtime.map(|runtime| runtime.address.ip());
    let mut checked_in = lock(&vehicle.checked_in);
    if let Err(refusal) = check_in::judge(checked_in.as_ref(), claim, &flight, runtime) {
        let refused_at = vehicle.name.as_str();
        warn!("page: {}: check-in for {refused_at} rejected: {refusal}", claim.from);
        return (StatusCode::FORBIDDEN, refusal.to_string()).into_response();
    }
    // A running flight keeps the team of its take-off.
    let text = match &by {
        Some(by) => format!("{} flies {} next: {}", by.team, vehicle.name, by.attempt.name()),
        None => format!("no team is checked in to fly {}", vehicle.name),
    };
    *checked_in = by;
    drop(checked_in);
    vehicle.note(&text);
    text.into_response()
}

fn none_kept() -> Response {
    (StatusCode::NOT_FOUND, "no runs are kept here: vizflyt serve --leaderboard FILE")
        .into_response()
}

fn failed(error: &LeaderboardError) -> Response {
    warn!("page: {error}");
    (
        StatusCode::SERVICE_UNAVAILABLE,
        "the leaderboard cannot be read now; the server's log has the reason",
    )
        .into_response()
}

/// Maximum runs on the page.
const NEWEST: usize = 20;

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
    use crate::flights::leaderboard::{GradeEntry, GradePlace, RunState};

    let place = |seconds| Standing {
        rank: 1,
        team: "wasps".to_owned(),
        stages_passed: 1,
        stages: 2,
        seconds,
        runs: 1,
        run: "1".to_owned(),
    };
    let grade = |median_s| GradeEntry {
        team: "wasps".to_owned(),
        hash: "f00d".to_owned(),
        plugin_sha256: "f00d".to_owned(),
        project: "p4".to_owned(),
        level: "ug".to_owned(),
        conditions: "day".to_owned(),
        flights: 1,
        finished: 1,
        stages: 2,
        mean_stages_passed: 1.0,
        median_s,
        score: 50.0,
    };
    let graded = |median_s| GradeBoard {
        project: "p4".to_owned(),
        level: "ug".to_owned(),
        conditions: "day".to_owned(),
        places: vec![GradePlace { rank: 1, grades: 1, best: grade(median_s) }],
    };
    let run = |team: Option<String>, ended_unix_ms, seconds| Run {
        id: "1".to_owned(),
        team,
        course: "race".to_owned(),
        vehicle: "vizflyt".to_owned(),
        attempt: Attempt::Official,
        state: RunState::Ended,
        began_unix_ms: 0,
        ended_unix_ms,
        outcome: "landed".to_owned(),
        stages_passed: 1,
        stages: 2,
        seconds,
        penalty_s: 0.0,
        min_clearance_m: seconds,
    };
    let flyer = |team, flight_s| Flyer {
        vehicle: "vizflyt".to_owned(),
        team,
        attempt: Attempt::Practice,
        phase: FlightPhase::Flying,
        flight_s,
    };
    let wasps = || Some("wasps".to_owned());
    let board = Board {
        course: "race".to_owned(),
        official: vec![place(Some(9.0)), place(None)],
        practice: vec![place(Some(9.0)), place(None)],
        graded: vec![graded(Some(9.0)), graded(None)],
        newest: vec![run(wasps(), Some(1), Some(9.0)), run(None, None, None)],
        vehicles: vec![flyer(wasps(), Some(1.0)), flyer(None, None)],
    };
    vec![serde_json::json!(board)]
}
