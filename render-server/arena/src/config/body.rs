//! `[[body]]`: parts of the vehicle for collision checks.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::validate::{check_number, invalid};
use super::{ArenaConfig, ConfigError};

/// `[[body]]`: each part is a sphere, or a capsule between two points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BodyPart {
    /// Centre of a sphere, or one end of a capsule's axis. [m, body]
    pub from_m: DVec3,
    /// Other end of the capsule's axis; without it, the part is a sphere. [m, body]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_m: Option<DVec3>,
    /// Radius of the sphere or capsule. [m]
    pub radius_m: f64,
}

/// Maximum number of parts: each costs a few queries per pose.
const MAX_PARTS: usize = 16;

impl ArenaConfig {
    pub(super) fn check_body(&self) -> Result<(), ConfigError> {
        if self.body.len() > MAX_PARTS {
            let advice = format!("give at most {MAX_PARTS} [[body]] parts");
            return Err(invalid("body", format!("{} of them", self.body.len()), advice));
        }
        for (index, part) in self.body.iter().enumerate() {
            let key = |field: &str| format!("body[{index}].{field}");
            check_number(&key("radius_m"), part.radius_m, "m", 0.001..=2.0)?;
            for (field, p_m) in [("from_m", Some(part.from_m)), ("to_m", part.to_m)] {
                let Some(p_m) = p_m else { continue };
                // The fence and the guard use only the enclosing sphere.
                let reach_m = p_m.length() + part.radius_m;
                if !(reach_m <= self.body_radius_m + 1e-9) {
                    let advice = format!(
                        "reaches {reach_m:.3} m from the body's origin; body_radius_m = {} must \
                         enclose every part",
                        self.body_radius_m
                    );
                    return Err(invalid(key(field), p_m, advice));
                }
            }
        }
        Ok(())
    }
}
