//! A pinhole camera placed in the world.

use vizflyt_protocol::geometry::{Cam, Intrinsics, InvalidIntrinsics, Pose, World};

/// What is drawn, from where.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Size, focal lengths, principal point.
    pub intrinsics: Intrinsics,
    /// Where the camera is.
    pub world_from_cam: Pose<World, Cam>,
    /// Splats nearer than this are not drawn. [m]
    pub near_m: f32,
    /// Linear RGB shown where nothing covers the pixel.
    pub background: [f32; 3],
}

impl Camera {
    /// Checks that every number is one a renderer can work with.
    pub fn validate(&self) -> Result<(), InvalidCamera> {
        self.intrinsics.validate()?;
        let far_away = self.world_from_cam.translation_m.abs().max_element() > MAX_DISTANCE_M;
        if !self.world_from_cam.is_valid() || far_away {
            return Err(InvalidCamera::Pose(format!("{:?}", self.world_from_cam)));
        }
        if !(MIN_NEAR_M..=MAX_NEAR_M).contains(&self.near_m) {
            return Err(InvalidCamera::Near(self.near_m));
        }
        if !self.background.iter().all(|v| v.is_finite()) {
            return Err(InvalidCamera::Background(self.background));
        }
        Ok(())
    }
}

/// Why a camera is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidCamera {
    /// The intrinsics are.
    #[error(transparent)]
    Intrinsics(#[from] InvalidIntrinsics),
    /// The pose is not finite, not a rotation, or further than 1e7 m from the origin.
    #[error("camera pose {0} is no rotation and finite position within 1e7 m")]
    Pose(String),
    /// The near plane is not a sensible distance.
    #[error("near plane at {0} m is outside 0.0001 to 1e6 m")]
    Near(f32),
    /// The background is not finite.
    #[error("background {0:?} is not finite")]
    Background([f32; 3]),
}

/// f32 resolves 1 m there. [m]
const MAX_DISTANCE_M: f64 = 1e7;
/// Closer, the squares of the projection leave f32. [m]
const MIN_NEAR_M: f32 = 1e-4;
const MAX_NEAR_M: f32 = 1e6;
