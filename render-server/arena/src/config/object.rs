//! `[[objects]]`: rigid parts of the twin beside its scene: a gate's frame that stands still; a clock's hand, a door, a
//! pendulum that move by themselves.

use std::collections::HashSet;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::ArenaConfig;
use super::validate::{ConfigError, check_name, check_number, check_position, invalid};

/// One of `[[objects]]`.
///
/// ```
/// let text = r#"
/// name = "hand"
/// scene = "hand.ply"
/// position_m = [8.9, 0.3, 1.1]
/// yaw_deg = 12.0
/// motion = { kind = "rotation", axis = [1, 0, 0], period_s = 6.0 }
/// "#;
/// let hand: vizflyt_arena::config::ObjectConfig = toml::from_str(text).unwrap();
/// assert_eq!(hand.phase_s, None);
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectConfig {
    /// Its name; unique, at most 32 bytes.
    pub name: String,
    /// The file of its splats, in metres of its own frame, relative to the folder of `arena.toml`.
    pub scene: String,
    /// Where the origin of its frame rests. [m, world]
    pub position_m: DVec3,
    /// How far its frame is turned about the world's z, counter-clockwise. [deg]
    #[serde(default)]
    pub yaw_deg: f64,
    /// Where in its motion it is when the arena starts; without it, random by the seed. [s]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase_s: Option<f64>,
    /// How it moves about its rest; without it, it stands still, as a part of the scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion: Option<MotionConfig>,
}

/// `motion`: how an object moves about its rest, over and over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum MotionConfig {
    /// Turns evenly about an axis through its origin.
    Rotation {
        /// It turns counter-clockwise about this; any length but 0. [object]
        axis: DVec3,
        /// Time of one turn. [s]
        period_s: f64,
    },
    /// Slides or swings to and fro, as a sine; at rest in the middle, where it is fastest.
    Oscillation {
        /// How far it slides to each side. [m, object at rest]
        #[serde(default, skip_serializing_if = "is_none")]
        slide_m: DVec3,
        /// It swings about this axis through its origin. [object]
        #[serde(default, skip_serializing_if = "is_none")]
        axis: DVec3,
        /// How far it swings to each side. [deg]
        #[serde(default, skip_serializing_if = "is_zero")]
        swing_deg: f64,
        /// Time of once to and fro. [s]
        period_s: f64,
    },
    /// Runs along points at an even speed without turning.
    Path {
        /// The points, 2 to 64, from where it rests. [m, object at rest]
        points_m: Vec<DVec3>,
        /// How fast it runs, 0.01 to 30. [m/s]
        speed_mps: f64,
        /// Whether it runs on from the last point to the first; else it turns there and runs back.
        #[serde(default)]
        closed: bool,
    },
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_none(vector: &DVec3) -> bool {
    *vector == DVec3::ZERO
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl ArenaConfig {
    pub(super) fn check_objects(&self) -> Result<(), ConfigError> {
        if self.objects.len() > MAX_OBJECTS {
            let advice = format!("give at most {MAX_OBJECTS} [[objects]]");
            return Err(invalid("objects", format!("{} of them", self.objects.len()), advice));
        }
        let mut taken = HashSet::new();
        for (index, object) in self.objects.iter().enumerate() {
            let key = |field: &str| format!("objects[{index}].{field}");
            check_name(&key("name"), &object.name, &mut taken)?;
            if object.scene.trim().is_empty() {
                let advice = "give the file of its splats, relative to this file";
                return Err(invalid(key("scene"), "\"\"", advice));
            }
            check_position(&key("position_m"), object.position_m)?;
            check_number(&key("yaw_deg"), object.yaw_deg, "degrees", -360.0..=360.0)?;
            if let Some(phase_s) = object.phase_s {
                check_number(&key("phase_s"), phase_s, "s", 0.0..=MAX_PERIOD_S)?;
            }
            if let Some(motion) = &object.motion {
                check_motion(motion, |field| format!("objects[{index}].motion.{field}"))?;
            }
        }
        Ok(())
    }
}

fn check_motion(motion: &MotionConfig, key: impl Fn(&str) -> String) -> Result<(), ConfigError> {
    let axis_is_one = |axis: DVec3| {
        check_position(&key("axis"), axis)?;
        if axis.length() > 1e-6 {
            return Ok(());
        }
        let advice = "give the axis it turns about, for example [1.0, 0.0, 0.0]";
        Err(invalid(key("axis"), axis, advice))
    };
    let period = MIN_PERIOD_S..=MAX_PERIOD_S;
    match motion {
        MotionConfig::Rotation { axis, period_s } => {
            axis_is_one(*axis)?;
            check_number(&key("period_s"), *period_s, "s", period)
        }
        MotionConfig::Oscillation { slide_m, axis, swing_deg, period_s } => {
            check_position(&key("slide_m"), *slide_m)?;
            check_number(&key("swing_deg"), *swing_deg, "degrees", -360.0..=360.0)?;
            if *swing_deg != 0.0 {
                axis_is_one(*axis)?;
            } else if *slide_m == DVec3::ZERO {
                let advice = "it does not move: give slide_m, or axis and swing_deg";
                return Err(invalid(key("swing_deg"), swing_deg, advice));
            } else {
                check_position(&key("axis"), *axis)?;
            }
            check_number(&key("period_s"), *period_s, "s", period)
        }
        MotionConfig::Path { points_m, speed_mps, .. } => {
            if !(2..=MAX_POINTS).contains(&points_m.len()) {
                let advice = format!("give 2 to {MAX_POINTS} points");
                let found = format!("{} of them", points_m.len());
                return Err(invalid(key("points_m"), found, advice));
            }
            for (n, &point_m) in points_m.iter().enumerate() {
                check_position(&key(&format!("points_m[{n}]")), point_m)?;
            }
            check_number(&key("speed_mps"), *speed_mps, "m/s", 0.01..=30.0)?;
            let length_m: f64 = points_m.windows(2).map(|pair| (pair[1] - pair[0]).length()).sum();
            let round_s = 2.0 * length_m / speed_mps;
            if (MIN_PERIOD_S..=MAX_PERIOD_S).contains(&round_s) {
                return Ok(());
            }
            let advice = format!(
                "there and back take {round_s:.3} s; they must take {MIN_PERIOD_S} to \
                 {MAX_PERIOD_S} s"
            );
            Err(invalid(key("speed_mps"), speed_mps, advice))
        }
    }
}

/// Objects of one arena at most: each costs every image and every pose a little.
pub const MAX_OBJECTS: usize = 32;
const MAX_POINTS: usize = 64;
/// Faster things are a blur to a camera of 60 Hz. [s]
const MIN_PERIOD_S: f64 = 0.05;
/// Nanoseconds of it are exact in f64. [s]
const MAX_PERIOD_S: f64 = 86400.0;
