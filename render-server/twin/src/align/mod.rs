//! Alignment of a scene with the room, and its accuracy.
//!
//! ```text
//! floor    three points of the floor, one known length ------------------------------.
//! corners  rays from posed images to printed tags -> points -.                        |
//!                                                            +-> points (matched) -> Fit -> go or no-go
//! track    the camera's positions by motion capture (recording) '
//! ```
//! A scene's own units and axes are arbitrary. The result is the similarity transform to the `world` frame, with bounds
//! on the error that matters to a vehicle: the distance between a real wall and the twin's wall.

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

/// Similarity transform from a scene to the world: `scale * (rotation * p) + translation_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Metres per unit of the scene.
    pub scale: f64,
    /// Rotation from the scene's axes to the world's.
    pub rotation: DQuat,
    /// Position of the scene's origin. [m, world]
    pub translation_m: DVec3,
}

impl Similarity {
    /// Transforms a point of the scene. [m, world]
    pub fn transform_point(&self, p_scene: DVec3) -> DVec3 {
        self.rotation * p_scene * self.scale + self.translation_m
    }
}

/// Alignment of a scene, and its accuracy. Sigmas are one standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Transform from the scene to the world.
    pub world_from_scene: Similarity,
    /// RMS residual of the matched pairs. [m]
    pub rms_m: f64,
    /// Maximum residual. [m]
    pub worst_m: f64,
    /// Number of pairs used.
    pub used: usize,
    /// Number of rejected pairs, which contradict the rest.
    pub left_out: usize,
    /// Relative standard deviation of the scale.
    pub scale_sigma: f64,
    /// Standard deviation of the vertical, in the worse direction. [rad]
    pub tilt_sigma_rad: f64,
    /// Standard deviation of the heading. [rad]
    pub yaw_sigma_rad: f64,
    /// Standard deviation of the position along each axis, at the centroid of the matched points. [m]
    pub place_sigma_m: f64,
    /// Centroid of the matched points. [m, world]
    pub middle_m: DVec3,
}

impl Fit {
    /// Returns the maximum alignment error at a position: three sigmas of position, scale, tilt and heading together.
    /// [m]
    pub fn bound_m(&self, p_world: DVec3) -> f64 {
        let arm_m = p_world - self.middle_m;
        let level_m = arm_m.truncate().length();
        let scale_m = self.scale_sigma * arm_m.length();
        let tilt_m = self.tilt_sigma_rad * arm_m.length();
        let yaw_m = self.yaw_sigma_rad * level_m;
        let place_m2 = 3.0 * self.place_sigma_m.powi(2);
        3.0 * (place_m2 + scale_m.powi(2) + tilt_m.powi(2) + yaw_m.powi(2)).sqrt()
    }

    /// Returns the maximum of [`Self::bound_m`] over the corners of a box. [m]
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

/// Why a scene cannot be aligned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// Too few points.
    #[error("{given} points are too few; give at least {needed}")]
    TooFew {
        /// Number of given points.
        given: usize,
        /// Minimum number.
        needed: usize,
    },
    /// All points are on one line or at one place.
    #[error(
        "the points lie on one line, so rotation about it is undetermined; add a point well away from it"
    )]
    OnOneLine,
    /// The known length is zero in the scene.
    #[error("the two ends of the known length coincide in the scene; pick them farther apart")]
    NoLength,
    /// The upward side of the floor is ambiguous.
    #[error(
        "the point above the floor lies in the floor's plane; select points on the floor, or give the upward direction"
    )]
    FloorAmbiguous,
    /// A value that is not finite, or a length that is not positive.
    #[error("{0} is not a finite number above zero")]
    BadNumber(&'static str),
    /// More pairs contradict each other than agree.
    #[error(
        "{left_out} of {given} pairs contradict the others; are they matched with the right ones, and did anything \
         move?"
    )]
    Contradictory {
        /// Number of contradicting pairs.
        left_out: usize,
        /// Number of all pairs.
        given: usize,
    },
    /// The motion does not determine the position of the tracked point.
    #[error(
        "the camera hardly moved: {0}; walk through the room, and turn the camera while you do"
    )]
    HardlyMoved(&'static str),
}
