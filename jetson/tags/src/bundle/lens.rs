//! Projection through a lens with its derivatives, also by the lens parameters.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

/// Number of estimated lens parameters: fx, fy, cx, cy, then k1 k2 p1 p2 or k1 k2 k3 k4. k3 of Brown-Conrady stays
/// constant: boards do not reach far enough outwards to separate it from k2.
pub(crate) const LENS: usize = 8;

pub(super) struct Projected {
    pub(super) pixel: DVec2,
    /// Derivatives by x, y, z of the point. [px/m]
    pub(super) by_point: [DVec2; 3],
    /// Derivatives by the lens parameters.
    pub(super) by_lens: [DVec2; LENS],
}

/// Returns the projection of a point [m, cam]; `None` unless it is in front of the camera.
pub(super) fn project(k: &Intrinsics, p_cam: DVec3) -> Option<Projected> {
    if !(p_cam.z > 1e-6) {
        return None;
    }
    let slope = p_cam.truncate() / p_cam.z;
    let (bent, jacobian) = k.distortion.distort(slope);
    let focal = DVec2::new(k.fx_px, k.fy_px);
    let by_slope = [jacobian.x_axis * focal, jacobian.y_axis * focal];
    let by_point = [
        by_slope[0] / p_cam.z,
        by_slope[1] / p_cam.z,
        -(by_slope[0] * slope.x + by_slope[1] * slope.y) / p_cam.z,
    ];
    let DVec2 { x, y } = slope;
    let coefficients = match k.distortion {
        Distortion::None => [DVec2::ZERO; 4],
        Distortion::BrownConrady { .. } => {
            let rr = slope.length_squared();
            [
                slope * rr,
                slope * (rr * rr),
                DVec2::new(2.0 * x * y, rr + 2.0 * y * y),
                DVec2::new(rr + 2.0 * x * x, 2.0 * x * y),
            ]
        }
        Distortion::KannalaBrandt { .. } => {
            let r = slope.length();
            if r < 1e-9 {
                [DVec2::ZERO; 4]
            } else {
                let t = r.atan();
                let unit = slope / r;
                [3, 5, 7, 9].map(|power| unit * t.powi(power))
            }
        }
    };
    let by_lens = [
        DVec2::new(bent.x, 0.0),
        DVec2::new(0.0, bent.y),
        DVec2::X,
        DVec2::Y,
        coefficients[0] * focal,
        coefficients[1] * focal,
        coefficients[2] * focal,
        coefficients[3] * focal,
    ];
    let pixel = bent * focal + DVec2::new(k.cx_px, k.cy_px);
    (pixel.is_finite()).then_some(Projected { pixel, by_point, by_lens })
}

/// Returns the lens with changed parameters.
pub(super) fn moved(k: &Intrinsics, change: &[f64]) -> Intrinsics {
    let distortion = match k.distortion {
        Distortion::None => Distortion::None,
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => Distortion::BrownConrady {
            k1: k1 + change[4],
            k2: k2 + change[5],
            p1: p1 + change[6],
            p2: p2 + change[7],
            k3,
        },
        Distortion::KannalaBrandt { k1, k2, k3, k4 } => Distortion::KannalaBrandt {
            k1: k1 + change[4],
            k2: k2 + change[5],
            k3: k3 + change[6],
            k4: k4 + change[7],
        },
    };
    Intrinsics {
        fx_px: k.fx_px + change[0],
        fy_px: k.fy_px + change[1],
        cx_px: k.cx_px + change[2],
        cy_px: k.cy_px + change[3],
        distortion,
        ..*k
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_match_finite_differences() {
        let pinhole = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        for distortion in [
            Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 0.001, p2: -0.002, k3: 0.01 },
            Distortion::KannalaBrandt { k1: 0.01, k2: -0.02, k3: 0.003, k4: 0.001 },
        ] {
            let k = Intrinsics { distortion, fx_px: 470.0, ..pinhole };
            let p = DVec3::new(0.3, -0.2, 1.1);
            let here = project(&k, p).unwrap();
            assert!((here.pixel - k.project(p).unwrap()).length() < 1e-9);
            let h = 1e-6;
            for (axis, derivative) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().zip(here.by_point)
            {
                let ahead = project(&k, p + axis * h).unwrap().pixel;
                let behind = project(&k, p - axis * h).unwrap().pixel;
                assert!(((ahead - behind) / (2.0 * h) - derivative).length() < 1e-4);
            }
            for (i, derivative) in here.by_lens.into_iter().enumerate() {
                let mut change = [0.0; LENS];
                change[i] = h;
                let ahead = project(&moved(&k, &change), p).unwrap().pixel;
                change[i] = -h;
                let behind = project(&moved(&k, &change), p).unwrap().pixel;
                assert!(((ahead - behind) / (2.0 * h) - derivative).length() < 1e-4, "number {i}");
            }
        }
    }

    #[test]
    fn points_behind_the_camera_have_no_projection() {
        let k = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        assert!(project(&k, DVec3::NEG_Z).is_none());
        assert!(project(&k, DVec3::splat(f64::NAN)).is_none());
    }
}
