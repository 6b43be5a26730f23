//! `[[no_fly]]`: boxes that the body's surface must not enter.

use std::collections::HashSet;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::MAX_NO_FLY;

use super::validate::{check_name, check_position, invalid};
use super::{ArenaConfig, ConfigError};

/// `[[no_fly]]`: each box is axis-aligned, for example around a real table that the twin does not show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoFly {
    /// Name of the box; at most 32 bytes.
    pub name: String,
    /// Corner with the smallest x, y and z. [m, world]
    pub min_m: DVec3,
    /// Opposite corner. [m, world]
    pub max_m: DVec3,
}

impl NoFly {
    /// Returns the box. [world]
    pub fn volume(&self) -> Volume {
        Volume::aabb(self.min_m, self.max_m)
    }
}

/// A thinner box is a typing error, and thinner than the noise of a pose. [m]
const MIN_SIDE_M: f64 = 0.01;

impl ArenaConfig {
    pub(super) fn check_no_fly(&self) -> Result<(), ConfigError> {
        if self.no_fly.len() > MAX_NO_FLY {
            let advice = format!("give at most {MAX_NO_FLY} [[no_fly]] boxes");
            return Err(invalid("no_fly", format!("{} of them", self.no_fly.len()), advice));
        }
        let mut taken = HashSet::new();
        for (index, keep_out) in self.no_fly.iter().enumerate() {
            let key = |field: &str| format!("no_fly[{index}].{field}");
            check_name(&key("name"), &keep_out.name, &mut taken)?;
            check_position(&key("min_m"), keep_out.min_m)?;
            check_position(&key("max_m"), keep_out.max_m)?;
            if !((keep_out.max_m - keep_out.min_m).min_element() >= MIN_SIDE_M) {
                let advice = format!(
                    "must exceed min_m = {} by {MIN_SIDE_M} m or more on each axis",
                    keep_out.min_m
                );
                return Err(invalid(key("max_m"), keep_out.max_m, advice));
            }
            for (of, p_m) in self.places() {
                if keep_out.volume().signed_distance_m(p_m) < self.body_radius_m {
                    let advice = format!(
                        "{of} at {p_m} is inside the box or less than the body's radius, {} m, from it",
                        self.body_radius_m
                    );
                    return Err(invalid(key("min_m"), keep_out.min_m, advice));
                }
            }
        }
        Ok(())
    }

    /// Returns the positions that the vehicle must be able to reach, with names. [m, world]
    fn places(&self) -> Vec<(String, DVec3)> {
        let spawns = [("spawn".to_owned(), Some(self.spawn))].into_iter().chain(
            self.vehicles
                .iter()
                .map(|vehicle| (format!("the spawn of {}", vehicle.name), vehicle.spawn)),
        );
        let mut places = Vec::new();
        for (name, spawn) in spawns {
            let Some(spawn) = spawn else { continue };
            let top_m = spawn.position_m + DVec3::Z * self.takeoff_height_m;
            places.push((format!("the climb from {name}"), top_m));
            places.push((name, spawn.position_m));
        }
        places.extend(self.goal.map(|goal| ("the goal".to_owned(), goal.position_m)));
        let stages = self.stages.iter();
        places.extend(stages.map(|stage| (format!("stage {}", stage.name), stage.center_m)));
        places
    }
}
