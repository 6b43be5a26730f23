//! `[[objects]]`: rigid parts of the twin outside of its scene: the frame of a gate that stands still; the hand
//! of a clock, a door or a pendulum that moves.

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
    /// Name of the object; unique, at most 32 bytes.
    pub name: String,
    /// File of its splats, in metres in the object's frame, relative to the folder of `arena.toml`.
    pub scene: String,
    /// Rest position of the object frame's origin. [m, world]
    pub position_m: DVec3,
    /// Rotation of the object frame about the world's z, counter-clockwise. [deg]
    #[serde(default)]
    pub yaw_deg: f64,
    /// Phase of the motion when the arena starts; without it, random by the seed. [s]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase_s: Option<f64>,
    /// Periodic motion about the rest position; without it, the object is fixed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion: Option<MotionConfig>,
}

/// `motion`: periodic motion of an object about its rest position.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum MotionConfig {
    /// Turns at a constant rate about an axis through its origin.
    Rotation {
        /// Axis of the counter-clockwise turn; any length but 0. [object]
        axis: DVec3,
        /// Duration of one turn. [s]
        period_s: f64,
    },
    /// Slides or swings as a sine; the rest position is the middle, where the speed is highest.
    Oscillation {
        /// Amplitude of the slide, to each side. [m, object at rest]
        #[serde(default, skip_serializing_if = "is_none")]
        slide_m: DVec3,
        /// Axis of the swing, through the object's origin. [object]
        #[serde(default, skip_serializing_if = "is_none")]
        axis: DVec3,
        /// Amplitude of the swing, to each side. [deg]
        #[serde(default, skip_serializing_if = "is_zero")]
        swing_deg: f64,
        /// Duration of one full cycle. [s]
        period_s: f64,
    },
    /// Follows points at a constant speed without turning.
    Path {
        /// Points, 2 to 64, relative to the rest position. [m, object at rest]
        points_m: Vec<DVec3>,
        /// Speed along the path, 0.01 to 30. [m/s]
        speed_mps: f64,
        /// Whether the path continues from the last point to the first; otherwise the object turns back there.
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

/// Maximum number of objects in an arena: each adds cost to every image and every pose.
pub const MAX_OBJECTS: usize = 32;
const MAX_POINTS: usize = 64;
/// Faster objects are a blur to a camera of 60 Hz. [s]
const MIN_PERIOD_S: f64 = 0.05;
/// In f64, times up to this are exact to the nanosecond. [s]
const MAX_PERIOD_S: f64 = 86400.0;
