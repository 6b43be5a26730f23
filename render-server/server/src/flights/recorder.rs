//! Records one vehicle's flights in the leaderboard: a run at its take-off, its verdict when it is decided, and
//! again when the vehicle has landed.
//!
//! The verdict is the autograder's ([`vizflyt_arena::verdict`]): lab flights and graded flights are judged by
//! the same code.

use std::sync::Arc;
use std::time::Duration;

use glam::DVec3;
use tokio::time::{MissedTickBehavior, interval};
use tracing::warn;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::verdict::Verdict;
use vizflyt_protocol::messages::OutcomeKind;
use vizflyt_protocol::time::ServerTime;

use super::leaderboard::{Attempt, Leaderboard, LeaderboardError, NewRun, RunEnd};
use super::vehicle::VehicleFlight;
use vizflyt_process::lock;

/// Records a vehicle's flights until the task is dropped. Official runs of a team beyond `most_official` become
/// practice.
pub(crate) async fn record(
    board: Leaderboard,
    vehicle: Arc<VehicleFlight>,
    arena: ArenaConfig,
    most_official: Option<u32>,
) {
    let mut telemetry = vehicle.telemetry.subscribe();
    let mut log = vehicle.events.subscribe();
    let mut beat = interval(HEARD_EVERY);
    beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut recorder =
        Recorder { board, vehicle: vehicle.clone(), arena, most_official, run: None, last: None };
    loop {
        let is_beat = tokio::select! {
            _ = telemetry.changed() => { telemetry.mark_unchanged(); false }
            _ = log.changed() => { log.mark_unchanged(); false }
            _ = beat.tick() => true,
        };
        if let Err(error) = recorder.follow(is_beat).await {
            // A failure must not stop the flight: it is logged, and tried again at the next change.
            warn!("{error}");
            if is_beat {
                vehicle.note(&format!("this flight is not recorded: {error}"));
            }
        }
    }
}

struct Recorder {
    board: Leaderboard,
    vehicle: Arc<VehicleFlight>,
    arena: ArenaConfig,
    most_official: Option<u32>,
    run: Option<Running>,
    /// Number of the last recorded flight.
    last: Option<u64>,
}

/// Present run.
struct Running {
    id: String,
    /// Number of its flight.
    flight: u64,
    /// Time of the recorded decision. The run is recorded again if an earlier event changes the decision, and after
    /// the landing.
    decided: Option<ServerTime>,
}

impl Recorder {
    async fn follow(&mut self, is_beat: bool) -> Result<(), LeaderboardError> {
        let (number, flight) = (self.vehicle.flights(), self.vehicle.flight());
        // Another runtime has taken over: the previous flight is over.
        if self.run.as_ref().is_some_and(|run| run.flight != number) {
            self.run = None;
        }
        // The start position is known once the vehicle is in the air. A flight that does not get there is
        // recorded when it has ended.
        let start_m = lock(&self.vehicle.samples).kept().first().map(|sample| sample.p_world_m);
        let has_begun = start_m.is_some()
            || self.arena.rules.start_box.is_none()
            || flight.end.decided().is_some();
        let is_new = flight.took_off.is_some() && self.last != Some(number);
        if self.run.is_none() && is_new && (has_begun || flight.landed.is_some()) {
            let id = self.begin(start_m).await?;
            self.last = Some(number);
            self.run = Some(Running { id, flight: number, decided: None });
        }
        let Some(run) = &mut self.run else { return Ok(()) };
        let landed = flight.landed.is_some();
        let decided = flight.end.decided().map(|(at, _)| at);
        if landed || decided != run.decided {
            let verdict = self.vehicle.verdict(&self.arena);
            self.board.end(&run.id, &end(&verdict, &self.arena)).await?;
            run.decided = decided;
            if landed {
                self.run = None;
            }
        } else if is_beat && run.decided.is_none() {
            self.board.keep_alive(&run.id).await?;
        }
        Ok(())
    }

    async fn begin(&self, start_m: Option<DVec3>) -> Result<String, LeaderboardError> {
        let checked_in = lock(&self.vehicle.checked_in).clone();
        let mut attempt = checked_in.as_ref().map_or(Attempt::Practice, |by| by.attempt);
        let is_elsewhere = start_m.is_some_and(|p_m| !self.arena.rules.starts_within(p_m));
        if is_elsewhere && attempt == Attempt::Official {
            self.vehicle.note("it began outside the start box: this flight is practice");
            attempt = Attempt::Practice;
        }
        let new = NewRun {
            team: checked_in.as_ref().map(|by| by.team.clone()),
            course: self.arena.name.clone(),
            vehicle: self.vehicle.name.as_str().to_owned(),
            attempt,
        };
        match self.board.begin(&new, self.most_official).await {
            Err(error @ LeaderboardError::Spent { .. }) => {
                self.vehicle.note(&format!("{error}: this flight is practice"));
                self.board.begin(&NewRun { attempt: Attempt::Practice, ..new }, None).await
            }
            begun => begun,
        }
    }
}

fn end(verdict: &Verdict, arena: &ArenaConfig) -> RunEnd {
    // On the leaderboard, the goal counts as the last stage of the course.
    let goal = u32::from(arena.goal.is_some());
    let reached = if verdict.outcome == OutcomeKind::Finished { goal } else { 0 };
    RunEnd {
        outcome: verdict.outcome.name().to_owned(),
        stages_passed: verdict.stages_passed as u32 + reached,
        stages: verdict.stages.len() as u32 + goal,
        seconds: Some(verdict.seconds),
        penalty_s: verdict.penalty_s,
        min_clearance_m: verdict.min_clearance_m,
        // A verdict has string keys and finite or absent numbers.
        verdict: serde_json::to_string(verdict).unwrap_or_default(),
    }
}

/// Interval of keep-alives of a run.
const HEARD_EVERY: Duration = Duration::from_secs(10);
