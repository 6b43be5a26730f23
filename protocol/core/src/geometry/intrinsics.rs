//! Camera model: a pinhole with optional lens distortion. Pixels are continuous: (0, 0) is the outer corner of the
//! top-left pixel, and pixel centres are at +0.5.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::Distortion;

/// Size, focal lengths, principal point and distortion of a camera.
///
/// ```
/// use glam::{DVec2, DVec3};
/// use vizflyt_protocol::geometry::{Distortion, Intrinsics};
/// let k = Intrinsics {
///     width_px: 320, height_px: 240,
///     fx_px: 200.0, fy_px: 200.0, cx_px: 160.0, cy_px: 120.0,
///     distortion: Distortion::None,
/// };
/// // 0.5 m right, 0.25 m up, 2 m ahead: (160 + 200 * 0.25, 120 - 200 * 0.125).
/// assert_eq!(k.project(DVec3::new(0.5, -0.25, 2.0)), Some(DVec2::new(210.0, 95.0)));
/// assert_eq!(k.unproject(DVec2::new(210.0, 95.0), 2.0), Some(DVec3::new(0.5, -0.25, 2.0)));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width. [px]
    pub width_px: u32,
    /// Image height. [px]
    pub height_px: u32,
    /// Focal length along x. [px]
    pub fx_px: f64,
    /// Focal length along y. [px]
    pub fy_px: f64,
    /// Principal point, x; the image centre is `width_px / 2`. [px]
    pub cx_px: f64,
    /// Principal point, y. [px]
    pub cy_px: f64,
    /// Lens distortion, applied to slopes before the focal lengths.
    pub distortion: Distortion,
}

impl Intrinsics {
    /// Maximum width and height of an image (8K). Bounds every buffer that is sized from a header. [px]
    pub const MAX_SIDE_PX: u32 = 8192;

    /// Returns pinhole intrinsics with square pixels, a centred principal point and this horizontal field of view, from
    /// the left edge to the right edge. [rad]
    pub fn from_horizontal_fov(width_px: u32, height_px: u32, fov_rad: f64) -> Self {
        let f_px = f64::from(width_px) / 2.0 / libm::tan(fov_rad / 2.0);
        Self {
            width_px,
            height_px,
            fx_px: f_px,
            fy_px: f_px,
            cx_px: f64::from(width_px) / 2.0,
            cy_px: f64::from(height_px) / 2.0,
            distortion: Distortion::None,
        }
    }

    /// Returns the same view with width and height divided by `by`, at least one pixel each.
    ///
    /// ```
    /// use vizflyt_protocol::geometry::Intrinsics;
    /// let half = Intrinsics::from_horizontal_fov(640, 480, 1.2).shrunk(2);
    /// assert_eq!(half, Intrinsics::from_horizontal_fov(320, 240, 1.2));
    /// ```
    pub fn shrunk(&self, by: u32) -> Self {
        let by = by.max(1);
        let (width_px, height_px) = ((self.width_px / by).max(1), (self.height_px / by).max(1));
        // Pixels are continuous from the outer corner, so all values scale with the size.
        let across = f64::from(width_px) / f64::from(self.width_px);
        let down = f64::from(height_px) / f64::from(self.height_px);
        Self {
            width_px,
            height_px,
            fx_px: self.fx_px * across,
            fy_px: self.fy_px * down,
            cx_px: self.cx_px * across,
            cy_px: self.cy_px * down,
            distortion: self.distortion,
        }
    }

    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.width_px as usize * self.height_px as usize
    }

    /// Projects a point [m, cam] to continuous pixel coordinates; `None` if it is not in front of the camera or outside
    /// the lens's range.
    pub fn project(&self, p_cam: DVec3) -> Option<DVec2> {
        if !(p_cam.z > 0.0) {
            return None;
        }
        let mut slope = p_cam.truncate() / p_cam.z;
        if self.distortion != Distortion::None {
            if !self.distortion.reaches(slope.length()) {
                return None;
            }
            slope = self.distortion.distort(slope).0;
        }
        let focal = DVec2::new(self.fx_px, self.fy_px);
        Some(focal * slope + DVec2::new(self.cx_px, self.cy_px))
    }

    /// Returns the point [m, cam] at a continuous pixel with this camera-z depth [m]; `None` if the lens shows nothing
    /// there.
    pub fn unproject(&self, pixel: DVec2, depth_m: f64) -> Option<DVec3> {
        Some((self.slope(pixel)? * depth_m).extend(depth_m))
    }

    /// Returns `(x / z, y / z)` in `cam` of the ray through a continuous pixel; `None` if the lens shows nothing there.
    pub fn slope(&self, pixel: DVec2) -> Option<DVec2> {
        let centre = DVec2::new(self.cx_px, self.cy_px);
        self.distortion.undistort((pixel - centre) / DVec2::new(self.fx_px, self.fy_px))
    }

    /// Checks that all numbers are in the range that renderer and receiver support.
    pub fn validate(&self) -> Result<(), InvalidIntrinsics> {
        let side = 1..=Self::MAX_SIDE_PX;
        if !side.contains(&self.width_px) || !side.contains(&self.height_px) {
            return Err(InvalidIntrinsics::Size(self.width_px, self.height_px));
        }
        let focal = 1e-3..=1e6;
        if !focal.contains(&self.fx_px) || !focal.contains(&self.fy_px) {
            return Err(InvalidIntrinsics::Focal(self.fx_px, self.fy_px));
        }
        let centre = -1e6..=1e6;
        if !centre.contains(&self.cx_px) || !centre.contains(&self.cy_px) {
            return Err(InvalidIntrinsics::Centre(self.cx_px, self.cy_px));
        }
        if !self.distortion.is_valid() {
            return Err(InvalidIntrinsics::Distortion);
        }
        Ok(())
    }
}

/// Reason for rejecting intrinsics.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum InvalidIntrinsics {
    /// A side is 0 or too large.
    #[error("image size {0}x{1} is outside 1x1 to 8192x8192")]
    Size(u32, u32),
    /// A focal length is not positive or out of range.
    #[error("focal length ({0}, {1}) px is outside 0.001 to 1e6; give fx and fy in pixels")]
    Focal(f64, f64),
    /// The principal point is not finite or far outside the image.
    #[error("principal point ({0}, {1}) px is outside -1e6 to 1e6; give cx and cy in pixels")]
    Centre(f64, f64),
    /// A coefficient is not finite, or larger than that of any lens.
    #[error("a distortion coefficient is outside -1000 to 1000; give them as OpenCV prints them")]
    Distortion,
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn project_inverts_unproject(
            u in -100.0..1000.0f64, v in -100.0..1000.0f64, z in 0.05..100.0f64,
            fov in 0.2..2.8f64, cx in 0.0..640.0f64,
        ) {
            let k = Intrinsics { cx_px: cx, ..Intrinsics::from_horizontal_fov(640, 480, fov) };
            let pixel = DVec2::new(u, v);
            let back = k.project(k.unproject(pixel, z).unwrap()).unwrap();
            prop_assert!((back - pixel).length() < 1e-8);
        }
    }

    #[test]
    fn does_not_project_points_behind_the_camera() {
        let k = Intrinsics::from_horizontal_fov(320, 240, 1.2);
        assert_eq!(k.project(DVec3::new(0.0, 0.0, 0.0)), None);
        assert_eq!(k.project(DVec3::new(0.0, 0.0, f64::NAN)), None);
    }

    #[test]
    fn rejects_invalid_intrinsics() {
        let good = Intrinsics::from_horizontal_fov(320, 240, 1.2);
        assert_eq!(good.validate(), Ok(()));
        assert!(Intrinsics { width_px: 0, ..good }.validate().is_err());
        assert!(Intrinsics { fx_px: f64::NAN, ..good }.validate().is_err());
        assert!(Intrinsics { cy_px: f64::INFINITY, ..good }.validate().is_err());
    }
}
