//! Camera with a pose in the world.

use glam::DVec2;
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, InvalidIntrinsics, Pose, World};

use crate::Atmosphere;
use crate::limits::JACOBIAN_MARGIN;

/// Camera: intrinsics, pose, near plane, background and air.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image size, focal lengths, principal point, lens distortion.
    pub intrinsics: Intrinsics,
    /// Pose of the camera.
    pub world_from_cam: Pose<World, Cam>,
    /// Distance of the near plane; closer splats are not rendered. [m]
    pub near_m: f32,
    /// Linear RGB of pixels without splats, in clear air and unchanged light.
    pub background: [f32; 3],
    /// Light on the scene, and the air between scene and camera.
    pub atmosphere: Atmosphere,
}

impl Camera {
    /// Returns a camera with black background and clear air.
    pub const fn new(
        intrinsics: Intrinsics,
        world_from_cam: Pose<World, Cam>,
        near_m: f32,
    ) -> Self {
        let atmosphere = Atmosphere::CLEAR;
        Self { intrinsics, world_from_cam, near_m, background: [0.0; 3], atmosphere }
    }

    /// Checks that all values are in the range that renderers support.
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
        self.atmosphere.validate()
    }

    /// Returns minimum and maximum `(x / z, y / z)` at which a splat is linearised.
    ///
    /// For a pinhole, or a lens close to one, the linearisation diverges far outside the image. It is therefore taken
    /// at a slope within the image, widened by [`JACOBIAN_MARGIN`] of half its size on every side. For a fisheye it
    /// does not diverge, because the lens compresses large slopes, and everything that it can image is close to the
    /// image. There, the linearisation is taken at the splat itself: taken elsewhere, splats at 80 degrees would
    /// cover all of a narrower image.
    pub(crate) fn slope_bounds(&self) -> [DVec2; 2] {
        let k = &self.intrinsics;
        let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
        let mut low = DVec2::INFINITY;
        let mut high = DVec2::NEG_INFINITY;
        let mut show = |slope: DVec2| {
            low = low.min(slope);
            high = high.max(slope);
        };
        let reach = k.distortion.reach();
        match k.distortion {
            Distortion::None => {
                let centre = DVec2::new(k.cx_px, k.cy_px);
                let focal = DVec2::new(k.fx_px, k.fy_px);
                show(-centre / focal);
                show((size - centre) / focal);
            }
            Distortion::BrownConrady { .. } => {
                // The lens bends the border of the image. Beyond its reach, the reach is the border.
                for i in 0..=BORDER_POINTS {
                    let t = f64::from(i) / f64::from(BORDER_POINTS);
                    for at in [
                        DVec2::new(t, 0.0),
                        DVec2::new(t, 1.0),
                        DVec2::new(0.0, t),
                        DVec2::new(1.0, t),
                    ] {
                        let pixel = at * size;
                        show(k.slope(pixel).unwrap_or_else(|| {
                            let outward = pixel - DVec2::new(k.cx_px, k.cy_px);
                            outward.normalize_or_zero() * reach
                        }));
                    }
                }
            }
            Distortion::KannalaBrandt { .. } => {
                return [DVec2::splat(-reach), DVec2::splat(reach)];
            }
        }
        let margin = (high - low) * (0.5 * JACOBIAN_MARGIN);
        [low - margin, high + margin]
    }
}

/// Why a camera is invalid.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidCamera {
    /// Invalid intrinsics.
    #[error(transparent)]
    Intrinsics(#[from] InvalidIntrinsics),
    /// Pose is not finite, not a rotation, or further than 1e7 m from the origin.
    #[error("camera pose {0} is not a rotation and a finite position within 1e7 m")]
    Pose(String),
    /// Near plane is out of range.
    #[error("near plane at {0} m is outside 0.0001 to 1e6 m")]
    Near(f32),
    /// Background is not finite.
    #[error("background {0:?} is not finite")]
    Background([f32; 3]),
    /// Light or fog is out of range.
    #[error("{0:?}: light and fog are finite and at least 0, at most 100")]
    Atmosphere(Atmosphere),
}

/// Points on each side of the image that sample the border behind a lens.
const BORDER_POINTS: u32 = 32;
/// At this distance, f32 resolves 1 m. [m]
const MAX_DISTANCE_M: f64 = 1e7;
/// Minimum near plane. For smaller values, the squares of the projection exceed f32. [m]
const MIN_NEAR_M: f32 = 1e-4;
const MAX_NEAR_M: f32 = 1e6;
