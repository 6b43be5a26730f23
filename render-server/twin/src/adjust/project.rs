//! Projection and its derivatives by the point and the lens.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

/// Number of estimated lens parameters: logarithm of both focal lengths, the first two radial coefficients, and the
/// principal point. The principal point is hard to distinguish from a camera rotation. But if it were fixed at the
/// image's centre, as structure from motion assumes, its error would bias the readout time.
pub(super) const LENS: usize = 5;

/// A point in an image.
pub(super) struct Projected {
    pub(super) pixel: DVec2,
    /// Derivatives by x, y, z of the point. [px/m]
    pub(super) by_point: [DVec2; 3],
    /// Derivatives by the lens's parameters.
    pub(super) by_lens: [DVec2; LENS],
}

/// Projects a point [m, cam]; `None` if it is not ahead, or beyond the lens's range.
pub(super) fn project(k: &Intrinsics, reach: f64, p_cam: DVec3) -> Option<Projected> {
    if !(p_cam.z > 0.0) {
        return None;
    }
    let slope = p_cam.truncate() / p_cam.z;
    if !(slope.length() <= reach) {
        return None;
    }
    let (bent, jacobian) = k.distortion.distort(slope);
    let focal = DVec2::new(k.fx_px, k.fy_px);
    let by_slope = [jacobian.x_axis * focal, jacobian.y_axis * focal];
    let by_point = [
        by_slope[0] / p_cam.z,
        by_slope[1] / p_cam.z,
        -(by_slope[0] * slope.x + by_slope[1] * slope.y) / p_cam.z,
    ];
    let rr = slope.length_squared();
    let radial = match k.distortion {
        Distortion::None | Distortion::BrownConrady { .. } => [slope * rr, slope * (rr * rr)],
        Distortion::KannalaBrandt { .. } => {
            let r = rr.sqrt();
            // Near the axis, t^3 / r is r^2.
            let unit = if r > 1e-9 { slope / r } else { DVec2::ZERO };
            [3, 5].map(|power| unit * r.atan().powi(power))
        }
    };
    let by_lens = [bent * focal, radial[0] * focal, radial[1] * focal, DVec2::X, DVec2::Y];
    let pixel = bent * focal + DVec2::new(k.cx_px, k.cy_px);
    pixel.is_finite().then_some(Projected { pixel, by_point, by_lens })
}

/// Returns the lens with changed parameters.
pub(super) fn moved(k: &Intrinsics, change: &[f64; LENS]) -> Intrinsics {
    let [zoom, by1, by2, x_px, y_px] = *change;
    let distortion = match k.distortion {
        Distortion::None => {
            Distortion::BrownConrady { k1: by1, k2: by2, p1: 0.0, p2: 0.0, k3: 0.0 }
        }
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
            Distortion::BrownConrady { k1: k1 + by1, k2: k2 + by2, p1, p2, k3 }
        }
        Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
            Distortion::KannalaBrandt { k1: k1 + by1, k2: k2 + by2, k3, k4 }
        }
    };
    let (fx_px, fy_px) = (k.fx_px * zoom.exp(), k.fy_px * zoom.exp());
    let (cx_px, cy_px) = (k.cx_px + x_px, k.cy_px + y_px);
    Intrinsics { fx_px, fy_px, cx_px, cy_px, distortion, ..*k }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_match_finite_differences() {
        let pinhole = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        for distortion in [
            Distortion::None,
            Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 0.001, p2: -0.002, k3: 0.01 },
            Distortion::KannalaBrandt { k1: 0.01, k2: -0.02, k3: 0.003, k4: 0.001 },
        ] {
            let k = Intrinsics { distortion, fx_px: 470.0, ..pinhole };
            let p = DVec3::new(0.3, -0.2, 1.1);
            let at = |k: &Intrinsics, p: DVec3| project(k, 3.0, p).unwrap();
            let here = at(&k, p);
            assert!((here.pixel - k.project(p).unwrap()).length() < 1e-9);
            let h = 1e-6;
            for (axis, derivative) in DVec3::AXES.into_iter().zip(here.by_point) {
                let slope = (at(&k, p + axis * h).pixel - at(&k, p - axis * h).pixel) / (2.0 * h);
                assert!((slope - derivative).length() < 1e-4);
            }
            for (i, derivative) in here.by_lens.into_iter().enumerate() {
                let change = |by: f64| std::array::from_fn(|j| if i == j { by } else { 0.0 });
                let (ahead, behind) = (moved(&k, &change(h)), moved(&k, &change(-h)));
                let slope = (at(&ahead, p).pixel - at(&behind, p).pixel) / (2.0 * h);
                assert!((slope - derivative).length() < 1e-4, "number {i}");
            }
        }
    }

    #[test]
    fn rejects_points_behind_or_beyond_the_lens() {
        let k = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        assert!(project(&k, 3.0, DVec3::NEG_Z).is_none());
        assert!(project(&k, 3.0, DVec3::new(4.0, 0.0, 1.0)).is_none());
        assert!(project(&k, 3.0, DVec3::splat(f64::NAN)).is_none());
    }
}
