//! One edit of a scene, with all its parameters.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::carve::{Carve, TooManyCells};
use super::region::{Region, select};
use super::{decimate, parts, similarity};
use crate::Splats;

/// One edit of a scene. Lengths and axes are those of the scene when the step is applied.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum EditStep {
    /// Keeps only splats in at least one of the regions.
    Crop {
        /// Regions in which splats are kept, by their centres.
        within: Vec<Region>,
    },
    /// Removes splats in any of the regions.
    Remove {
        /// Regions in which splats are removed, by their centres.
        within: Vec<Region>,
    },
    /// Removes faint splats.
    Faint {
        /// Minimum peak opacity of kept splats, 0 to 1.
        below: f64,
    },
    /// Removes large splats.
    Large {
        /// Maximum of a kept splat's largest standard deviation. [scene]
        above: f64,
    },
    /// Removes small splats.
    Small {
        /// Minimum of a kept splat's largest standard deviation. [scene]
        below: f64,
    },
    /// Removes connected parts of few splats, and haze that belongs to no part.
    Floaters {
        /// Side of the cells. Splats in neighbouring cells are connected. [scene]
        cell: f64,
        /// Minimum number of splats of a kept part.
        least: u32,
    },
    /// Keeps the largest connected parts.
    Parts {
        /// Side of the cells, as in [`EditStep::Floaters`]. [scene]
        cell: f64,
        /// Number of kept parts.
        keep: u32,
    },
    /// Keeps splats that are visible from the free space around a path.
    Carve(Carve),
    /// Keeps the most opaque and largest splats.
    Decimate {
        /// Number of kept splats.
        count: u32,
    },
    /// Rotates the scene about its origin, including its directional colours.
    Turn {
        /// Rotation from old to new axes: a unit quaternion x, y, z, w.
        rotation: [f64; 4],
    },
    /// Scales the scene.
    Scale {
        /// Factor by which lengths are multiplied.
        factor: f64,
    },
    /// Moves the scene.
    Move {
        /// Translation. [scene]
        by: [f64; 3],
    },
}

/// Error: a parameter of a step is out of range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: {advice}")]
pub struct InvalidStep {
    /// Name of the parameter.
    pub key: &'static str,
    /// Value of the parameter.
    pub value: String,
    /// Valid values.
    pub advice: &'static str,
}

/// Error of an edit. The scene is unchanged.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EditError {
    /// A parameter of the step is invalid.
    #[error(transparent)]
    Invalid(#[from] InvalidStep),
    /// The edit would remove all splats.
    #[error(
        "none of the {0} splats would be left; lengths are in the scene's own unit: compare `vizflyt scene inspect`"
    )]
    NothingLeft(usize),
    /// The grid needs too much memory.
    #[error(transparent)]
    TooManyCells(#[from] TooManyCells),
    /// Solid splats are missing around the path.
    #[error(
        "carve: nothing solid is within {1} of {0:?}; points are in the scene's own axes and unit: compare `vizflyt scene inspect`"
    )]
    NothingAround([f64; 3], f64),
    /// Free space is missing around the path.
    #[error(
        "carve: nothing can be reached from {0:?}: solid splats are all around; give a place with more room, or a smaller \
         radius"
    )]
    NoRoom([f64; 3]),
}

impl EditStep {
    /// Checks that every parameter is in range.
    ///
    /// # Errors
    /// The first invalid parameter.
    pub fn check(&self) -> Result<(), InvalidStep> {
        match self {
            Self::Crop { within } | Self::Remove { within } => {
                if !(1..=MAX_REGIONS).contains(&within.len()) {
                    let advice = "give 1 to 100 regions";
                    return Err(invalid("within", format!("{} regions", within.len()), advice));
                }
                within.iter().try_for_each(Region::check)
            }
            Self::Faint { below } if !(0.0..=1.0).contains(below) => {
                Err(invalid("below", below, "an opacity is 0 to 1"))
            }
            Self::Faint { .. } => Ok(()),
            Self::Large { above } => check_length("above", *above),
            Self::Small { below } => check_length("below", *below),
            Self::Floaters { cell, least } => {
                check_length("cell", *cell)?;
                check_count("least", *least)
            }
            Self::Parts { cell, keep } => {
                check_length("cell", *cell)?;
                check_count("keep", *keep)
            }
            Self::Carve(carve) => carve.check(),
            Self::Decimate { count } => check_count("count", *count),
            Self::Turn { rotation } => check_rotation(*rotation),
            Self::Scale { factor } if (1e-6..=1e6).contains(factor) => Ok(()),
            Self::Scale { factor } => Err(invalid("factor", factor, "give 1e-6 to 1e6")),
            Self::Move { by } => check_point("by", *by),
        }
    }

    /// Applies the step. Returns the number of removed splats.
    ///
    /// # Errors
    /// [`EditError`]; the splats are then unchanged.
    pub fn apply(&self, splats: &mut Splats) -> Result<usize, EditError> {
        self.check()?;
        let keep = match self {
            Self::Turn { rotation } => {
                let rotation = DQuat::from_array(*rotation).normalize();
                similarity::transform(splats, 1.0, rotation, DVec3::ZERO);
                return Ok(0);
            }
            Self::Scale { factor } => {
                similarity::transform(splats, *factor, DQuat::IDENTITY, DVec3::ZERO);
                return Ok(0);
            }
            Self::Move { by } => {
                similarity::transform(splats, 1.0, DQuat::IDENTITY, DVec3::from(*by));
                return Ok(0);
            }
            Self::Crop { within } => select(within, splats),
            Self::Remove { within } => {
                let mut keep = select(within, splats);
                for keep in &mut keep {
                    *keep = !*keep;
                }
                keep
            }
            Self::Faint { below } => {
                splats.opacities.par_iter().map(|opacity| f64::from(*opacity) >= *below).collect()
            }
            Self::Large { above } => by_size(splats, |size| size <= *above),
            Self::Small { below } => by_size(splats, |size| size >= *below),
            Self::Floaters { cell, least } => parts::of_at_least(splats, *cell, *least as usize),
            Self::Parts { cell, keep } => parts::largest(splats, *cell, *keep as usize),
            Self::Carve(carve) => carve.seen(splats)?,
            Self::Decimate { count } => decimate::most_important(splats, *count as usize),
        };
        let (before, left) = (splats.len(), keep.iter().filter(|keep| **keep).count());
        if left == 0 {
            return Err(EditError::NothingLeft(before));
        }
        if left < before {
            splats.keep(&keep);
        }
        Ok(before - left)
    }
}

/// Marks the splats for which the largest standard deviation satisfies `wanted`.
fn by_size(splats: &Splats, wanted: impl Fn(f64) -> bool + Sync) -> Vec<bool> {
    splats.scales_m.par_iter().map(|scales| wanted(f64::from(scales.max_element()))).collect()
}

#[allow(clippy::needless_pass_by_value)] // Why: most values are made for it.
pub(super) fn invalid(
    key: &'static str,
    value: impl ToString,
    advice: &'static str,
) -> InvalidStep {
    InvalidStep { key, value: value.to_string(), advice }
}

pub(super) fn check_length(key: &'static str, length: f64) -> Result<(), InvalidStep> {
    let is_meant = (1e-9..=MAX_COORDINATE).contains(&length);
    if is_meant { Ok(()) } else { Err(invalid(key, length, "give a length above 0, up to 1e7")) }
}

pub(super) fn check_point(key: &'static str, point: [f64; 3]) -> Result<(), InvalidStep> {
    let is_near = point.iter().all(|v| v.abs() <= MAX_COORDINATE);
    let advice = "give three numbers within 1e7 of the origin";
    if is_near { Ok(()) } else { Err(invalid(key, format!("{point:?}"), advice)) }
}

pub(super) fn check_rotation(rotation: [f64; 4]) -> Result<(), InvalidStep> {
    let is_unit = (DQuat::from_array(rotation).length() - 1.0).abs() < 1e-3;
    let advice = "give a unit quaternion as [x, y, z, w]; the identity is [0, 0, 0, 1]";
    if is_unit { Ok(()) } else { Err(invalid("rotation", format!("{rotation:?}"), advice)) }
}

fn check_count(key: &'static str, count: u32) -> Result<(), InvalidStep> {
    if count > 0 { Ok(()) } else { Err(invalid(key, count, "give at least 1")) }
}

/// Maximum regions of one step; lassos are drawn by hand.
const MAX_REGIONS: usize = 100;
/// Maximum coordinate: f32 still resolves one unit there. [scene]
pub(super) const MAX_COORDINATE: f64 = 1e7;
