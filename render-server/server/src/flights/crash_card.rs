//! Data of a crash card, as the page shows it.

use std::sync::Arc;

use serde::Serialize;
use vizflyt_arena::verdict::Verdict;

use super::recent_previews::{Preview, TimedPreview};

/// Crash card: the last moments of a failed flight.
#[derive(Debug, Serialize)]
pub struct CrashCard {
    /// Number of the vehicle's card, from 1.
    pub id: u64,
    /// Name of the vehicle.
    pub(super) vehicle: String,
    /// Name of the arena.
    pub(super) course: String,
    /// Time of the end, UTC. [ms since 1970]
    pub(super) ended_unix_ms: u64,
    /// Cause of the flight's end, in a few words.
    pub(super) title: &'static str,
    /// Verdict of the flight.
    pub(super) verdict: Verdict,
    /// Probable cause, as text.
    pub(super) cause: String,
    /// Images of the cameras, oldest first.
    pub(super) images: Vec<CardImages>,
    /// Positions in the last seconds.
    pub(super) samples: Vec<CardSample>,
    /// SVG of clearance and speed in the last seconds.
    pub(super) clearance_svg: String,
    /// SVG of the room from above, with the flown path.
    pub(super) top_svg: String,
    /// Height of the section through the obstacles in that view. [m, world]
    pub(super) top_height_m: f64,
    /// Events up to the end.
    pub(super) events: Vec<CardEvent>,
    /// Last lines printed by the plugin.
    pub(super) printed: Vec<String>,
    #[serde(skip)]
    pub(super) shots: Vec<Vec<TimedPreview>>,
}

#[derive(Debug, Serialize)]
pub(super) struct CardImages {
    pub(super) camera: String,
    /// Times before the end. [s]
    pub(super) before_s: Vec<f64>,
}

/// State of the vehicle at one time.
#[derive(Debug, Serialize)]
pub(super) struct CardSample {
    /// Time before the end. [s]
    pub(super) before_s: f64,
    /// [m, world]
    pub(super) p_world_m: [f64; 3],
    /// [m/s, world]
    pub(super) v_world_mps: [f64; 3],
    /// Heading from x, counter-clockwise. [rad, world]
    pub(super) yaw_rad: f64,
    /// Distance from the body's surface to the nearest obstacle; absent if there is none. [m]
    pub(super) clearance_m: Option<f64>,
}

#[derive(Debug, Serialize)]
pub(super) struct CardEvent {
    /// Time before the end. [s]
    pub(super) before_s: f64,
    pub(super) text: String,
}

impl CrashCard {
    /// Returns an image of a camera by number, if it exists.
    pub fn image(&self, camera: usize, number: usize) -> Option<&Arc<Preview>> {
        Some(&self.shots.get(camera)?.get(number)?.preview)
    }
}

/// Returns examples of cards, for the check of the page's scripts.
#[cfg(test)]
pub(crate) fn examples() -> Vec<serde_json::Value> {
    use vizflyt_protocol::flight_end::{Collision, EndReason, Obstacle};
    let verdict = |end: EndReason, passed_s| Verdict {
        outcome: end.outcome(),
        reason: end.to_string(),
        end,
        ended: None,
        stages_passed: 0,
        stages: vec![vizflyt_arena::verdict::StageVerdict { name: "gate".to_owned(), passed_s }],
        seconds: 9.0,
        penalty_s: 0.0,
        score: 0.0,
        min_clearance_m: passed_s,
        max_speed_mps: 1.0,
        path_m: 9.0,
    };
    let sample = |clearance_m| CardSample {
        before_s: 0.1,
        p_world_m: [0.0; 3],
        v_world_mps: [0.0; 3],
        yaw_rad: 0.0,
        clearance_m,
    };
    let card = |end: EndReason, some: Option<f64>| CrashCard {
        id: 1,
        vehicle: "vizflyt".to_owned(),
        course: "race".to_owned(),
        ended_unix_ms: 0,
        title: end.title(),
        verdict: verdict(end, some),
        cause: "a sentence".to_owned(),
        images: vec![CardImages { camera: "front".to_owned(), before_s: vec![0.1] }],
        samples: vec![sample(some)],
        clearance_svg: "<svg/>".to_owned(),
        top_svg: "<svg/>".to_owned(),
        top_height_m: 1.0,
        events: vec![CardEvent { before_s: 0.1, text: "a sentence".to_owned() }],
        printed: vec!["a line".to_owned()],
        shots: Vec::new(),
    };
    let touch = EndReason::Collision(Collision {
        p_world_m: glam::DVec3::ZERO,
        clearance_m: -0.1,
        with: Obstacle::Scene,
        speed_mps: 1.0,
    });
    let (full, sparse) = (EndReason::TimeLimit { limit_s: 60.0 }, EndReason::StopButton);
    [(full, Some(1.0)), (touch, Some(1.0)), (sparse, None)]
        .map(|(end, some)| serde_json::json!(card(end, some)))
        .into()
}
