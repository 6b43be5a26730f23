//! What a failed flight looked like at its end, as the page shows it.

use std::sync::Arc;

use serde::Serialize;
use vizflyt_arena::verdict::Verdict;
use vizflyt_protocol::messages::Event;

use super::recent_previews::{Preview, Shot};

/// What a failed flight looked like at its end.
#[derive(Debug, Serialize)]
pub struct CrashCard {
    /// Counts the vehicle's cards, from 1.
    pub id: u64,
    /// Whose.
    pub(super) vehicle: String,
    /// The arena's name.
    pub(super) course: String,
    /// The end, UTC. [ms since 1970]
    pub(super) ended_unix_ms: u64,
    /// What decided the flight.
    pub(super) event: Event,
    /// What the flight was worth.
    pub(super) verdict: Verdict,
    /// What it probably failed of, in words.
    pub(super) cause: String,
    /// What the cameras showed, oldest first.
    pub(super) images: Vec<CardImages>,
    /// Where it was in its last seconds.
    pub(super) samples: Vec<CardSample>,
    /// SVG of clearance and speed in its last seconds.
    pub(super) clearance_svg: String,
    /// SVG of the place from above, with the way flown.
    pub(super) top_svg: String,
    /// At which height the obstacles of that are. [m, world]
    pub(super) top_height_m: f64,
    /// What happened, up to the end.
    pub(super) events: Vec<CardEvent>,
    /// The last lines that the plugin printed.
    pub(super) printed: Vec<String>,
    #[serde(skip)]
    pub(super) shots: Vec<Vec<Shot>>,
}

/// The images of a camera.
#[derive(Debug, Serialize)]
pub(super) struct CardImages {
    pub(super) camera: String,
    /// When they were, before the end. [s]
    pub(super) before_s: Vec<f64>,
}

/// Where it was at one moment.
#[derive(Debug, Serialize)]
pub(super) struct CardSample {
    /// Before the end. [s]
    pub(super) before_s: f64,
    /// [m, world]
    pub(super) p_world_m: [f64; 3],
    /// [m/s, world]
    pub(super) v_world_mps: [f64; 3],
    /// From x, counter-clockwise. [rad, world]
    pub(super) yaw_rad: f64,
    /// From the body's surface to the nearest obstacle; absent where there is none. [m]
    pub(super) clearance_m: Option<f64>,
}

#[derive(Debug, Serialize)]
pub(super) struct CardEvent {
    /// Before the end. [s]
    pub(super) before_s: f64,
    pub(super) text: String,
}

impl CrashCard {
    /// Returns an image of a camera, both by their number; `None` if there is none.
    pub fn image(&self, camera: usize, number: usize) -> Option<&Arc<Preview>> {
        Some(&self.shots.get(camera)?.get(number)?.preview)
    }
}
