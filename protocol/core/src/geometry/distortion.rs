//! Lens distortion: map from the slope of a ray to its distorted slope.
//!
//! Slopes are `(x / z, y / z)` in `cam`, without a unit. A model maps the slope of a ray to the distorted slope. Focal
//! lengths and principal point convert it to pixels. Both models are those of OpenCV, so that its calibrations can be
//! used directly.

use glam::{DMat2, DVec2};
use serde::{Deserialize, Serialize};

/// Distortion model of a lens, relative to a pinhole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum Distortion {
    /// No distortion: a pinhole.
    #[default]
    None,
    /// Radial and tangential distortion, for most lenses up to about 110 degrees (Brown 1966, "Decentering distortion
    /// of lenses"; OpenCV `calibrateCamera`). With `r = |s|`:
    /// `s (1 + k1 r^2 + k2 r^4 + k3 r^6) + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)`.
    BrownConrady {
        /// Radial coefficient of r^2.
        k1: f64,
        /// Radial coefficient of r^4.
        k2: f64,
        /// Tangential coefficient along y.
        p1: f64,
        /// Tangential coefficient along x.
        p2: f64,
        /// Radial coefficient of r^6.
        k3: f64,
    },
    /// Fisheye (Kannala and Brandt 2006, "A generic camera model", equation 6; OpenCV
    /// `fisheye::calibrate`). With `t = atan r`: `s / r (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9)`.
    KannalaBrandt {
        /// Coefficient of t^3.
        k1: f64,
        /// Coefficient of t^5.
        k2: f64,
        /// Coefficient of t^7.
        k3: f64,
        /// Coefficient of t^9.
        k4: f64,
    },
}

impl Distortion {
    /// Returns the distorted slope and its Jacobian with respect to the slope, column by column.
    ///
    /// ```
    /// use glam::DVec2;
    /// use vizflyt_protocol::geometry::Distortion;
    /// let lens = Distortion::BrownConrady { k1: 0.1, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 };
    /// // r^2 = 0.25: all slopes grow by 2.5 %.
    /// let (distorted, _) = lens.distort(DVec2::new(0.3, 0.4));
    /// assert!((distorted - DVec2::new(0.3075, 0.41)).length() < 1e-12);
    /// ```
    pub fn distort(&self, slope: DVec2) -> (DVec2, DMat2) {
        let DVec2 { x, y } = slope;
        match *self {
            Self::None => (slope, DMat2::IDENTITY),
            Self::BrownConrady { k1, k2, p1, p2, k3 } => {
                let rr = slope.length_squared();
                let radial = 1.0 + rr * (k1 + rr * (k2 + rr * k3));
                // d radial / d (r^2).
                let growth = k1 + rr * (2.0 * k2 + rr * 3.0 * k3);
                let shift = DVec2::new(
                    2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
                    p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y,
                );
                let across = 2.0 * (x * y * growth + p1 * x + p2 * y);
                let jacobian = DMat2::from_cols(
                    DVec2::new(radial + 2.0 * (x * x * growth + p1 * y + 3.0 * p2 * x), across),
                    DVec2::new(across, radial + 2.0 * (y * y * growth + 3.0 * p1 * y + p2 * x)),
                );
                (slope * radial + shift, jacobian)
            }
            Self::KannalaBrandt { k1, k2, k3, k4 } => {
                let r = slope.length();
                if r < NEAR_AXIS {
                    // atan r / r = 1 - r^2 / 3 + ..., and t^3 / r = r^2: both below rounding.
                    return (slope, DMat2::IDENTITY);
                }
                let t = libm::atan(r);
                let tt = t * t;
                let bent = t * (1.0 + tt * (k1 + tt * (k2 + tt * (k3 + tt * k4))));
                let bend =
                    1.0 + tt * (3.0 * k1 + tt * (5.0 * k2 + tt * (7.0 * k3 + tt * 9.0 * k4)));
                let scale = bent / r;
                // Along the radius, the slope grows by `along`; across it, by `scale`.
                let along = bend / (1.0 + r * r);
                let u = slope / r;
                let d = along - scale;
                let jacobian = DMat2::from_cols(
                    DVec2::new(scale + d * u.x * u.x, d * u.x * u.y),
                    DVec2::new(d * u.x * u.y, scale + d * u.y * u.y),
                );
                (slope * scale, jacobian)
            }
        }
    }

    /// Returns the slope with this distorted slope; `None` if there is none within [`Self::reach`].
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        if *self == Self::None {
            return Some(distorted);
        }
        let reach = self.reach();
        // The radial map is monotonic: bisect the interval that contains the solution, in angles, so that its far end
        // is finite. Newton's method then handles the small tangential terms.
        let wanted = distorted.length();
        if wanted < NEAR_AXIS {
            return Some(distorted);
        }
        let (mut low, mut high) = (0.0, libm::atan(reach));
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if self.radius(libm::tan(middle)) < wanted {
                low = middle;
            } else {
                high = middle;
            }
        }
        let mut slope = distorted / wanted * libm::tan(0.5 * (low + high));
        for _ in 0..20 {
            let (found, jacobian) = self.distort(slope);
            let change = jacobian.inverse() * (distorted - found);
            if !change.is_finite() {
                return None;
            }
            slope += change;
            if change.length() <= 1e-14 * (1.0 + slope.length()) {
                break;
            }
        }
        let (found, _) = self.distort(slope);
        let exact = (found - distorted).length() <= 1e-9 * (1.0 + wanted);
        (exact && slope.length() <= reach * (1.0 + 1e-9)).then_some(slope)
    }

    /// Returns the maximum length of a slope that the lens images; infinite for a pinhole. Beyond it, the map would
    /// fold back in some direction and show the same place twice.
    ///
    /// ```
    /// use vizflyt_protocol::geometry::Distortion;
    /// // r (1 - 0.3 r^2) grows until r^2 = 1 / 0.9.
    /// let lens = Distortion::BrownConrady { k1: -0.3, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 };
    /// assert!((lens.reach() - (1.0 / 0.9f64).sqrt()).abs() < 1e-9);
    /// ```
    pub fn reach(&self) -> f64 {
        let Some(growth) = self.growth() else { return f64::INFINITY };
        // First root of the growth: steps that are fine near the axis, where lenses have their roots, then bisection.
        let Some(past) = (1..=REACH_STEPS).find(|&i| !growth.is_positive(growth.place(i))) else {
            return libm::tan(MAX_ANGLE_RAD);
        };
        let (mut low, mut high) = (growth.place(past - 1), growth.place(past));
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if growth.is_positive(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        let root = libm::sqrt(low);
        if growth.is_angle { libm::tan(root) } else { root }
    }

    /// Whether the lens images a slope of this length: `length <= self.reach()`, but faster.
    pub fn reaches(&self, length: f64) -> bool {
        let Some(growth) = self.growth() else { return !length.is_nan() };
        let r = if growth.is_angle { libm::atan(length) } else { length };
        (1..=REACH_STEPS)
            .map(|i| growth.place(i))
            .take_while(|&u| growth.is_positive(u))
            .any(|u| u > r * r)
            || length <= self.reach()
    }

    /// Returns the growth along the radius; `None` for a pinhole.
    fn growth(&self) -> Option<Growth> {
        let farthest = libm::tan(MAX_ANGLE_RAD);
        Some(match *self {
            Self::None => return None,
            Self::BrownConrady { k1, k2, p1, p2, k3 } => Growth {
                factors: [3.0 * k1, 5.0 * k2, 7.0 * k3, 0.0],
                // The tangential part adds 3 r^2 |p| along the radius on one side, and subtracts it on the other.
                tilt: 6.0 * libm::hypot(p1, p2),
                is_angle: false,
                end: farthest,
            },
            Self::KannalaBrandt { k1, k2, k3, k4 } => Growth {
                factors: [3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4],
                tilt: 0.0,
                is_angle: true,
                end: MAX_ANGLE_RAD,
            },
        })
    }

    /// Returns the number of the model (0 none, 1 Brown-Conrady, 2 Kannala-Brandt) and the coefficients in OpenCV's
    /// order (`k1 k2 p1 p2 k3` or `k1 k2 k3 k4`), padded with zeros.
    pub fn to_wire(&self) -> (u8, [f64; 5]) {
        match *self {
            Self::None => (0, [0.0; 5]),
            Self::BrownConrady { k1, k2, p1, p2, k3 } => (1, [k1, k2, p1, p2, k3]),
            Self::KannalaBrandt { k1, k2, k3, k4 } => (2, [k1, k2, k3, k4, 0.0]),
        }
    }

    /// Inverse of [`Self::to_wire`]; `None` for an unknown model number.
    pub fn from_wire(model: u8, [a, b, c, d, e]: [f64; 5]) -> Option<Self> {
        Some(match model {
            0 => Self::None,
            1 => Self::BrownConrady { k1: a, k2: b, p1: c, p2: d, k3: e },
            2 => Self::KannalaBrandt { k1: a, k2: b, k3: c, k4: d },
            _ => return None,
        })
    }

    /// Whether all coefficients are finite and within the range of real lenses.
    pub(crate) fn is_valid(&self) -> bool {
        self.to_wire().1.iter().all(|k| k.abs() <= MAX_COEFFICIENT)
    }

    /// Returns the distorted radius of a slope of this length, from the radial part only.
    fn radius(&self, r: f64) -> f64 {
        self.radial_only().distort(DVec2::new(r, 0.0)).0.x
    }

    fn radial_only(&self) -> Self {
        match *self {
            Self::BrownConrady { k1, k2, k3, .. } => {
                Self::BrownConrady { k1, k2, p1: 0.0, p2: 0.0, k3 }
            }
            other => other,
        }
    }
}

/// Derivative of a lens's map along the radius, as a polynomial in u: r^2 or t^2.
struct Growth {
    factors: [f64; 4],
    tilt: f64,
    /// Whether u is the squared angle t^2.
    is_angle: bool,
    /// Maximum r or t that is examined.
    end: f64,
}

impl Growth {
    fn is_positive(&self, u: f64) -> bool {
        let radial = self.factors.iter().rev().fold(0.0, |sum, k| (sum + k) * u);
        1.0 + radial - self.tilt * libm::sqrt(u) > 0.0
    }

    /// Returns the value of u at a step.
    fn place(&self, step: u32) -> f64 {
        let share = f64::from(step) / f64::from(REACH_STEPS);
        self.end * self.end * share * share * share
    }
}

/// Slopes below this are distorted by less than the resolution of f64.
const NEAR_AXIS: f64 = 1e-8;
/// Maximum angle of a ray from the axis that is rendered. At 89 degrees the slope is 57, and depth along z is no longer
/// meaningful. [rad]
const MAX_ANGLE_RAD: f64 = 89.0 * core::f64::consts::PI / 180.0;
/// Number of steps of the root search. Polynomials of degree four have at most three turning points.
const REACH_STEPS: u32 = 256;
/// Maximum coefficient. Larger values are typing errors.
const MAX_COEFFICIENT: f64 = 1e3;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lenses() -> impl Strategy<Value = Distortion> {
        let k = || -0.3..0.3f64;
        let p = || -0.01..0.01f64;
        prop_oneof![
            (k(), k(), p(), p(), k()).prop_map(|(k1, k2, p1, p2, k3)| Distortion::BrownConrady {
                k1,
                k2,
                p1,
                p2,
                k3
            }),
            (p(), p(), p(), p()).prop_map(|(k1, k2, k3, k4)| Distortion::KannalaBrandt {
                k1,
                k2,
                k3,
                k4
            }),
        ]
    }

    proptest! {
        #[test]
        fn undistort_inverts_distort(lens in lenses(), angle in 0.0..core::f64::consts::TAU, share in 0.0..0.9f64) {
            let r = libm::tan(libm::atan(lens.reach().min(3.0)) * share);
            let slope = DVec2::from_angle(angle) * r;
            let back = lens.undistort(lens.distort(slope).0);
            prop_assert!(
                back.is_some_and(|back| (back - slope).length() < 1e-8 * (1.0 + r)),
                "{:?} became {:?}", slope, back
            );
        }

        #[test]
        fn jacobian_matches_finite_differences(
            lens in lenses(), x in -0.8..0.8f64, y in -0.8..0.8f64,
        ) {
            let at = DVec2::new(x, y);
            let (_, jacobian) = lens.distort(at);
            let h = 1e-6;
            for (axis, column) in [(DVec2::X, jacobian.x_axis), (DVec2::Y, jacobian.y_axis)] {
                let (ahead, behind) = (lens.distort(at + axis * h).0, lens.distort(at - axis * h).0);
                let measured = (ahead - behind) / (2.0 * h);
                prop_assert!((measured - column).length() < 1e-6, "{} for {}", column, measured);
            }
        }

        #[test]
        fn reaches_agrees_with_reach(lens in lenses(), share in 0.0..2.0f64, r in 0.0..70.0f64) {
            for length in [share * lens.reach().min(100.0), r] {
                prop_assert_eq!(lens.reaches(length), length <= lens.reach(), "{}", length);
            }
            prop_assert!(!lens.reaches(f64::NAN) && !Distortion::None.reaches(f64::NAN));
        }

        #[test]
        fn survives_the_wire_format(lens in lenses()) {
            let (model, numbers) = lens.to_wire();
            prop_assert_eq!(Distortion::from_wire(model, numbers), Some(lens));
        }
    }

    #[test]
    fn a_barrel_lens_ends_where_it_folds_back() {
        // r (1 - 0.3 r^2) grows until r^2 = 1 / 0.9.
        let lens = Distortion::BrownConrady { k1: -0.3, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 };
        assert!((lens.reach() - (1.0 / 0.9f64).sqrt()).abs() < 1e-9);
        // 2/3 of that is the maximum distorted radius.
        assert_eq!(lens.undistort(DVec2::new(0.71, 0.0)), None);
        assert!(lens.undistort(DVec2::new(0.70, 0.0)).is_some());
    }

    #[test]
    fn a_tangential_lens_does_not_fold_back() {
        // Without the limit, slopes around 33 to one side would appear in the middle of the image.
        let lens = Distortion::BrownConrady { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.01, k3: 0.0 };
        assert!((lens.reach() - 1.0 / 0.06).abs() < 1e-6);
        let mut last = f64::NEG_INFINITY;
        for i in -1000..=1000 {
            let x = lens.distort(DVec2::new(lens.reach() * f64::from(i) / 1000.0, 0.0)).0.x;
            assert!(x > last, "it turns back at {i}");
            last = x;
        }
    }

    #[test]
    fn the_equidistant_fisheye_maps_angles_to_the_radius() {
        let lens = Distortion::KannalaBrandt { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 };
        let angle = 80f64.to_radians();
        let (distorted, _) = lens.distort(DVec2::new(0.0, angle.tan()));
        assert!((distorted - DVec2::new(0.0, angle)).length() < 1e-12);
        assert!(lens.reach() > 57.0);
    }

    #[test]
    fn rejects_invalid_lenses() {
        for k1 in [f64::NAN, f64::INFINITY, 1e4] {
            assert!(!Distortion::KannalaBrandt { k1, k2: 0.0, k3: 0.0, k4: 0.0 }.is_valid());
        }
        assert_eq!(Distortion::from_wire(3, [0.0; 5]), None);
    }
}
