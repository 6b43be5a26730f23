//! Where a scene lies in the room, and how well that is known.
//!
//! ```text
//! floor    three points of the floor, one known length ------------------------------.
//! corners  rays from posed images to printed tags -> points -.                        |
//!                                                            +-> points (matched) -> Fit -> go or no-go
//! track    the camera's places by motion capture (recording) '
//! ```
//! A scene's own units and axes are arbitrary. What comes out is the similarity that takes them to the `world` frame,
//! with bounds on what matters to a vehicle: how far a wall may be from where the twin has it.

pub mod corners;
mod eigen;
pub mod floor;
pub mod level;
pub mod points;
pub mod recording;
pub mod track;

#[cfg(test)]
mod tests_support;

use glam::{DQuat, DVec3};

/// Takes points of a scene to the world: `scale * (rotation * p) + translation_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Metres per unit of the scene.
    pub scale: f64,
    /// The scene's axes to the world's.
    pub rotation: DQuat,
    /// Where the scene's origin lies. [m, world]
    pub translation_m: DVec3,
}

impl Similarity {
    /// Returns where a point of the scene lies. [m, world]
    pub fn transform_point(&self, p_scene: DVec3) -> DVec3 {
        self.rotation * p_scene * self.scale + self.translation_m
    }
}

/// A scene's place, and how well it is known. Sigmas are one standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Takes the scene to the world.
    pub world_from_scene: Similarity,
    /// How far apart what should coincide is, root mean square. [m]
    pub rms_m: f64,
    /// The worst of it. [m]
    pub worst_m: f64,
    /// Pairs that were used.
    pub used: usize,
    /// Pairs that contradicted the rest, and were left out.
    pub left_out: usize,
    /// Of the scale, as a share of it.
    pub scale_sigma: f64,
    /// Of the vertical: the worse direction. [rad]
    pub tilt_sigma_rad: f64,
    /// Of the heading. [rad]
    pub yaw_sigma_rad: f64,
    /// Of the place at the middle of what was matched, along each axis. [m]
    pub place_sigma_m: f64,
    /// That middle. [m, world]
    pub middle_m: DVec3,
}

impl Fit {
    /// Returns how far what the scene shows at a place may be from where it really is: three sigmas of place, scale,
    /// tilt and heading together. [m]
    pub fn bound_m(&self, p_world: DVec3) -> f64 {
        let arm_m = p_world - self.middle_m;
        let level_m = arm_m.truncate().length();
        let scale_m = self.scale_sigma * arm_m.length();
        let tilt_m = self.tilt_sigma_rad * arm_m.length();
        let yaw_m = self.yaw_sigma_rad * level_m;
        let place_m2 = 3.0 * self.place_sigma_m.powi(2);
        3.0 * (place_m2 + scale_m.powi(2) + tilt_m.powi(2) + yaw_m.powi(2)).sqrt()
    }

    /// Returns the worst of [`Self::bound_m`] over the corners of a box. [m]
    pub fn bound_within_m(&self, min_m: DVec3, max_m: DVec3) -> f64 {
        let corner = |index: u32| {
            let pick = |bit: u32, low: f64, high: f64| if index & bit == 0 { low } else { high };
            DVec3::new(
                pick(1, min_m.x, max_m.x),
                pick(2, min_m.y, max_m.y),
                pick(4, min_m.z, max_m.z),
            )
        };
        (0..8).map(|index| self.bound_m(corner(index))).fold(0.0, f64::max)
    }
}

/// Why a place could not be found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// Fewer than needed.
    #[error("{given} points are too few; give at least {needed}")]
    TooFew {
        /// So many came.
        given: usize,
        /// So many are needed.
        needed: usize,
    },
    /// All on one line, or in one place.
    #[error("the points lie on one line, about which the scene may turn; give one well beside it")]
    OnOneLine,
    /// A length of nothing.
    #[error("the two ends of the known length coincide in the scene; pick them farther apart")]
    NoLength,
    /// Which side of the floor is up?
    #[error(
        "what is known to be above the floor lies in it; pick floor points of the floor, or say which way is up"
    )]
    FloorAmbiguous,
    /// A number that is none, or a length that is not positive.
    #[error("{0} is not a finite number above zero")]
    BadNumber(&'static str),
    /// More pairs contradict each other than agree.
    #[error(
        "{left_out} of {given} pairs contradict the others; are they matched with the right ones, and did anything \
         move?"
    )]
    Contradictory {
        /// So many do not fit.
        left_out: usize,
        /// Of so many.
        given: usize,
    },
    /// Nothing in the motion shows where the tracked point is.
    #[error(
        "the camera hardly moved: {0}; walk through the room, and turn the camera while you do"
    )]
    HardlyMoved(&'static str),
}
