//! Verdict on a flight, from its events, its samples and the arena's rules. Pure: graded and live flights use
//! the same code.
//!
//! ```text
//! events (referee, runtime) --> the flight's end (vizflyt_protocol::flight_end) --> outcome, time
//!                           \-> stages passed, with times
//! samples (pose, clearance) --> take-off, minimum clearance, maximum speed, path length
//! ```
//! The timer starts at take-off and stops at the end: the finish, a collision, or another end that comes first
//! (VizFlyt paper, section IV, project 5). The score is the passed share of the course; a goal is its last
//! part.

use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::flight_end::{EndReason, FlightEnd};
use vizflyt_protocol::messages::{Event, EventKind, OutcomeKind};
use vizflyt_protocol::time::ServerTime;

use crate::config::ArenaConfig;
use crate::referee::AIRBORNE_M;

/// State of the vehicle at one instant of a flight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    pub stamp: ServerTime,
    /// Position of the body's centre. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Heading: from x, counter-clockwise. [rad, world]
    pub yaw_rad: f64,
    /// Distance from the body's surface to the nearest obstacle; negative is penetration. [m]
    pub clearance_m: f64,
}

/// A part of the course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageVerdict {
    /// Name in `arena.toml`.
    pub name: String,
    /// Time of passage since take-off; `None` if it was not passed. [s]
    pub passed_s: Option<f64>,
}

/// Result of a flight.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// Kind of end.
    pub outcome: OutcomeKind,
    /// Reason in one sentence.
    pub reason: String,
    /// Reason as data.
    pub end: EndReason,
    /// Time of the end; `None` if nothing is known of the flight.
    #[serde(skip)]
    pub ended: Option<ServerTime>,
    pub stages_passed: usize,
    /// Stages in order.
    pub stages: Vec<StageVerdict>,
    /// Duration from take-off to the end; 0 without a take-off. [s]
    pub seconds: f64,
    /// Penalties, which are added to the time. [s]
    pub penalty_s: f64,
    /// Score, 0 to 100.
    pub score: f64,
    /// Minimum distance of the body's surface to an obstacle in flight; `None` without a flight. [m]
    pub min_clearance_m: Option<f64>,
    /// Maximum speed. [m/s]
    pub max_speed_mps: f64,
    /// Length of the flown path. [m]
    pub path_m: f64,
}

/// Judges a flight in `arena` by all its events and samples, each in order of time.
///
/// ```
/// use vizflyt_arena::verdict::judge;
/// use vizflyt_protocol::messages::OutcomeKind;
/// # let arena = vizflyt_arena::ArenaConfig::parse(r#"
/// # name = "room"
/// # scene = "scene.ply"
/// # body_radius_m = 0.12
/// # takeoff_height_m = 1.2
/// # spawn = { position_m = [1, 2, 0] }
/// # geofence = { min_m = [0, 0, -0.5], max_m = [11, 4.5, 3.65] }
/// # limits = { max_speed_mps = 3.0, max_acceleration_mps2 = 6.0 }
/// # [[cameras]]
/// # name = "front"
/// # width_px = 320
/// # height_px = 240
/// # horizontal_fov_deg = 90.0
/// # position_m = [0.06, 0, 0.02]
/// # "#).unwrap();
/// // No event and no sample: the vehicle never took off.
/// let verdict = judge(&arena, &[], &[]);
/// assert_eq!((verdict.outcome, verdict.score), (OutcomeKind::Error, 0.0));
/// ```
pub fn judge(arena: &ArenaConfig, events: &[Event], samples: &[Sample]) -> Verdict {
    judge_ended(arena, &FlightEnd::of(events), events, samples)
}

/// Judges a flight with a known end, while `events` may lack the oldest ones.
pub fn judge_ended(
    arena: &ArenaConfig,
    end: &FlightEnd,
    events: &[Event],
    samples: &[Sample],
) -> Verdict {
    let airborne_m = arena.spawn.position_m.z + AIRBORNE_M;
    let took_off = samples.iter().find(|sample| sample.p_world_m.z > airborne_m);
    let took_off_m = took_off.map(|sample| sample.p_world_m);
    let took_off = took_off.map(|sample| sample.stamp);
    let last = samples.last().map(|sample| sample.stamp);
    let (ended, end) = match (end.decided(), took_off) {
        (Some((stamp, reason)), _) => (Some(stamp), reason.clone()),
        (None, Some(_)) => (last, EndReason::RecordEnds),
        (None, None) => (last, EndReason::NeverTookOff),
    };
    let outcome = end.outcome();
    let since = |stamp: ServerTime| took_off.map_or(0.0, |at| stamp.seconds_since(at).max(0.0));

    let mut stages: Vec<StageVerdict> = (arena.stages.iter())
        .map(|stage| StageVerdict { name: stage.name.clone(), passed_s: None })
        .collect();
    for event in events.iter().filter(|event| ended.is_none_or(|ended| event.stamp <= ended)) {
        if let EventKind::Stage { index, .. } = event.kind
            && let Some(stage) = stages.get_mut(usize::from(index))
        {
            stage.passed_s.get_or_insert(since(event.stamp));
        }
    }
    let stages_passed = stages.iter().filter(|stage| stage.passed_s.is_some()).count();
    let in_flight = |sample: &&Sample| {
        took_off.is_some_and(|at| sample.stamp >= at)
            && ended.is_none_or(|ended| sample.stamp <= ended)
    };
    let flown: Vec<&Sample> = samples.iter().filter(in_flight).collect();
    // Without a goal, the last stage is the finish.
    let has_goal = arena.goal.is_some();
    let parts = stages.len() + usize::from(has_goal);
    let passed = stages_passed + usize::from(has_goal && outcome == OutcomeKind::Finished);
    Verdict {
        outcome,
        reason: end.to_string(),
        end,
        ended,
        stages_passed,
        stages,
        seconds: ended.map_or(0.0, since),
        penalty_s: arena.rules.penalty_s(took_off_m, flown.iter().map(|s| s.clearance_m)),
        score: 100.0 * passed as f64 / parts.max(1) as f64,
        min_clearance_m: flown.iter().map(|s| s.clearance_m).reduce(f64::min),
        max_speed_mps: flown.iter().map(|s| s.v_world_mps.length()).fold(0.0, f64::max),
        path_m: flown.windows(2).map(|w| w[0].p_world_m.distance(w[1].p_world_m)).sum(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::StageConfig;
    use crate::referee::tests::arena;
    use vizflyt_protocol::flight_end::{Collision, Obstacle, PluginFault};
    use vizflyt_protocol::messages::{FlightPhase, bounded};

    fn at(s: f64) -> ServerTime {
        ServerTime::ZERO.plus_seconds(1.0 + s)
    }

    fn event(s: f64, kind: EventKind) -> Event {
        Event { stamp: at(s), kind, text: bounded("") }
    }

    fn ended(s: f64, reason: EndReason) -> Event {
        event(s, EventKind::Ended(reason))
    }

    fn take_off() -> Event {
        event(0.0, EventKind::Phase(FlightPhase::TakingOff))
    }

    fn crashed() -> EndReason {
        EndReason::Plugin(PluginFault::ended("exit status 3"))
    }

    fn stage(s: f64, index: u8) -> Event {
        event(s, EventKind::Stage { index, name: bounded("gate") })
    }

    fn course() -> ArenaConfig {
        let mut config = arena();
        let gate = |name: &str, x: f64| StageConfig {
            name: name.into(),
            center_m: DVec3::new(x, 0.0, 1.0),
            normal: DVec3::X,
            width_m: 1.0,
            height_m: 0.8,
            ..StageConfig::default()
        };
        config.stages = vec![gate("first", 2.0), gate("second", 4.0), gate("third", 6.0)];
        config
    }

    /// Rises for a second, then flies along x at 2 m/s; clearance falls by 0.1 m per second.
    fn samples(seconds: u32) -> Vec<Sample> {
        let at_tick = |tick: u32| {
            let s = f64::from(tick) / 10.0;
            let x = (s - 1.0).max(0.0) * 2.0;
            Sample {
                stamp: at(s),
                p_world_m: DVec3::new(x, 0.0, s.min(1.0)) + course().spawn.position_m,
                v_world_mps: if s > 1.0 { DVec3::X * 2.0 } else { DVec3::Z },
                yaw_rad: 0.0,
                clearance_m: 1.0 - s * 0.1,
            }
        };
        (0..=seconds * 10).map(at_tick).collect()
    }

    #[test]
    fn first_end_determines_the_outcome() {
        let hit = EventKind::Collision(Collision {
            p_world_m: DVec3::ZERO,
            clearance_m: -0.01,
            with: Obstacle::Object(bounded("door")),
            speed_mps: 2.0,
        });
        let events = [take_off(), stage(2.0, 0), event(3.4, hit), ended(3.5, crashed())];
        let verdict = judge(&course(), &events, &samples(6));
        let reason = "collision with 'door' at (0.00, 0.00, 0.00) m, at 2.0 m/s";
        assert_eq!((verdict.outcome, verdict.reason.as_str()), (OutcomeKind::Collided, reason));
        assert_eq!(verdict.ended, Some(at(3.4)));
        // In the air 0.4 s after the first sample; samples after the contact do not count.
        assert!((verdict.seconds - 3.0).abs() < 1e-6, "{}", verdict.seconds);
        assert_eq!((verdict.stages_passed, verdict.score), (1, 25.0));
        assert!((verdict.stages[0].passed_s.unwrap() - 1.6).abs() < 1e-6);
        assert_eq!(verdict.stages[1].passed_s, None);
        assert!((verdict.min_clearance_m.unwrap() - 0.66).abs() < 0.01);
        assert!((verdict.path_m - 5.4).abs() < 0.11, "{}", verdict.path_m);
    }

    #[test]
    fn finish_is_the_last_part_of_the_score() {
        let finished = EventKind::Finished { seconds: 4.6 };
        let mut events = vec![take_off(), stage(2.0, 0), stage(3.0, 1), stage(4.0, 2)];
        events.push(event(5.0, finished));
        let verdict = judge(&course(), &events, &samples(6));
        assert_eq!((verdict.outcome, verdict.stages_passed), (OutcomeKind::Finished, 3));
        assert_eq!(verdict.score, 100.0);
        // A stage after the end does not count.
        let late = [take_off(), event(3.0, EventKind::TimeLimit { limit_s: 3.0 }), stage(3.5, 0)];
        let verdict = judge(&course(), &late, &samples(6));
        assert_eq!((verdict.outcome, verdict.stages_passed), (OutcomeKind::Timeout, 0));
    }

    #[test]
    fn early_landing_stops_the_timer() {
        let asked = ended(2.4, EndReason::PluginLanded);
        let verdict = judge(&course(), &[take_off(), asked.clone()], &samples(6));
        assert_eq!(verdict.outcome, OutcomeKind::Landed);
        assert!((verdict.seconds - 2.0).abs() < 1e-6);
        // A landing without a pose is an error; a lost pose that came back does not count.
        let lost = event(2.0, EventKind::PoseLost { age_s: 0.2 });
        let blind = ended(2.3, EndReason::PoseLost { age_s: 0.5 });
        let blind = judge(&course(), &[take_off(), lost.clone(), blind], &samples(6));
        assert_eq!(
            (blind.outcome, blind.reason.as_str()),
            (OutcomeKind::Error, "pose lost for 0.5 s")
        );
        let back = event(2.1, EventKind::PoseRegained);
        let seen = judge(&course(), &[take_off(), lost, back, asked], &samples(6));
        assert_eq!(seen.outcome, OutcomeKind::Landed);
    }

    #[test]
    fn flight_without_take_off_has_no_time_and_clearance() {
        let verdict = judge(&course(), &[], &samples(0));
        assert_eq!((verdict.outcome, verdict.min_clearance_m), (OutcomeKind::Error, None));
        let failed = judge(&course(), &[ended(0.0, crashed())], &[]);
        assert_eq!((failed.outcome, failed.seconds), (OutcomeKind::PluginFailed, 0.0));
    }

    #[test]
    fn record_that_ends_in_flight_is_an_error() {
        let verdict = judge(&course(), &[take_off(), stage(2.0, 0)], &samples(6));
        assert_eq!((verdict.outcome, verdict.stages_passed), (OutcomeKind::Error, 1));
        assert_eq!(verdict.reason, "the record ends before the flight");
    }
}
