//! Lens: values of a camera that are computed once per intrinsics, and the distortion of vectors of slopes (the
//! vector form of [`Distortion::distort`]).
//!
//! Budget: the bounds cost about 250 inversions of the lens, 2 ms, when the intrinsics of a camera change. The
//! distortion costs about 2 ns per splat and thread.

use glam::DVec2;
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use super::simd::Simd;
use crate::Camera;
use crate::limits::BLUR_PX2;

/// Coefficients of a lens, as in [`Distortion`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Model {
    /// Pinhole without distortion.
    Pinhole,
    /// k1, k2, p1, p2, k3.
    BrownConrady([f32; 5]),
    /// k1, k2, k3, k4.
    KannalaBrandt([f32; 4]),
}

/// Values that depend on the intrinsics only.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    of: Intrinsics,
    pub(super) model: Model,
    /// [`Camera::slope_bounds`].
    pub(super) slopes: [DVec2; 2],
    /// Maximum length of a slope; splats with longer slopes are dropped.
    pub(super) reach: f64,
    /// Bounds on the means of splats that may touch the image. Used only with a lens.
    pub(super) shown: ShownSlopes,
}

/// Bounds on the means of splats that may touch the image behind a lens. With `z` the depth of the mean, and `d` the
/// distance from it at which its splat is still visible: `low - spread d / z <= slope <= high + spread d / z`, unless
/// `z < large d`.
#[derive(Clone, Copy, Debug)]
pub(super) struct ShownSlopes {
    pub(super) low: DVec2,
    pub(super) high: DVec2,
    pub(super) spread: f64,
    pub(super) large: f64,
}

impl Lens {
    fn new(camera: &Camera) -> Self {
        let k = &camera.intrinsics;
        let slopes = camera.slope_bounds();
        let reach = k.distortion.reach();
        let (model, steep) = match k.distortion {
            Distortion::None => (Model::Pinhole, 1.0),
            Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
                // Maximum length of a slope that is linearised.
                let r = slopes[0].abs().max(slopes[1].abs()).length().min(reach);
                let rr = r * r;
                // Upper bound of the greatest singular value of the lens's Jacobian.
                let radial = 3.0 * k1.abs() + rr * (5.0 * k2.abs() + rr * 7.0 * k3.abs());
                let steep = 1.0 + rr * radial + 8.0 * r * (p1.abs() + p2.abs());
                let model = Model::BrownConrady([k1, k2, p1, p2, k3].map(|k| k as f32));
                (model, steep * (1.0 + rr).sqrt())
            }
            Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
                // In angles, a fisheye is nowhere steep: the growth of slopes and of the arc cancel.
                let tt = std::f64::consts::FRAC_PI_2.powi(2);
                let bend = 7.0 * k3.abs() + tt * 9.0 * k4.abs();
                let steep = 1.0 + tt * (3.0 * k1.abs() + tt * (5.0 * k2.abs() + tt * bend));
                (Model::KannalaBrandt([k1, k2, k3, k4].map(|k| k as f32)), steep)
            }
        };
        // Start value: everything that the lens can image.
        let whole = ShownSlopes {
            low: DVec2::splat(-reach),
            high: DVec2::splat(reach),
            spread: 0.0,
            large: 0.0,
        };
        let shown = match model {
            Model::Pinhole => whole,
            _ => MARGINS.iter().find_map(|&share| shown(k, steep, share)).unwrap_or(whole),
        };
        Self { of: *k, model, slopes, reach, shown }
    }
}

/// Margins around the image in which means are bounded exactly, as shares of its size. The first one that the lens
/// can image is used.
const MARGINS: [f64; 3] = [0.6, 0.3, 0.1];

/// Returns the bounds of a lens that spreads no angle by more than `steep`, if the lens can image the whole image and
/// a margin of `share` of its size.
fn shown(k: &Intrinsics, steep: f64, share: f64) -> Option<ShownSlopes> {
    let focal = DVec2::new(k.fx_px, k.fy_px);
    let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
    // Distance at which the most opaque splat is visible by blur only, plus a pixel for the steps between the points.
    let near_px = DVec2::splat((2.0 * 255f64.ln() * BLUR_PX2).sqrt() + 1.0);
    let margin_px = share * size.max_element();
    let far_px = near_px + margin_px;
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    // Minimum displacement of the image point when the slope moves by one.
    let mut least = f64::INFINITY;
    for i in 0..=POINTS {
        for j in 0..=POINTS {
            let at = DVec2::new(f64::from(i), f64::from(j)) / f64::from(POINTS);
            let border = i % POINTS == 0 || j % POINTS == 0;
            if border {
                let slope = k.slope(at * (size + 2.0 * near_px) - near_px)?;
                (low, high) = (low.min(slope), high.max(slope));
            }
            if border || i % 4 == 0 && j % 4 == 0 {
                let slope = k.slope(at * (size + 2.0 * far_px) - far_px)?;
                let bend = k.distortion.distort(slope).1;
                // Smallest singular value: the product of both, divided by an upper bound of the greater one.
                let greatest = bend.x_axis.length().hypot(bend.y_axis.length());
                least = least.min(bend.determinant().abs() / greatest);
            }
        }
    }
    // A splat touches the image if its distorted mean is within `steep d / z` of it in x and in y. Its slope is then
    // within that, times the diagonal, divided by `least`. One quarter is added for the space between the points.
    let spread = 1.25 * steep * std::f64::consts::SQRT_2 / least;
    let large = focal.max_element() * steep / margin_px;
    (spread.is_finite() && large.is_finite()).then_some(ShownSlopes { low, high, spread, large })
}

/// Number of points, minus one, along each side of the image at which a lens is evaluated.
const POINTS: u32 = 24;

/// Cache of lenses by intrinsics.
#[derive(Debug, Default)]
pub(super) struct Lenses {
    kept: Vec<Lens>,
    oldest: usize,
}

impl Lenses {
    /// Returns the lens of a validated camera.
    pub(super) fn of(&mut self, camera: &Camera) -> Lens {
        if let Some(lens) = self.kept.iter().find(|lens| lens.of == camera.intrinsics) {
            return *lens;
        }
        let lens = Lens::new(camera);
        if self.kept.len() < KEPT {
            self.kept.reserve_exact(KEPT);
            self.kept.push(lens);
        } else {
            self.kept[self.oldest] = lens;
            self.oldest = (self.oldest + 1) % KEPT;
        }
        lens
    }
}

/// Capacity of the cache: twice the number of cameras of one vehicle.
const KEPT: usize = 16;

/// Distorted slopes and the lens's Jacobian there, which is symmetric: xx, xy, yy.
pub(super) struct Distorted<F> {
    pub(super) slope: [F; 2],
    pub(super) jacobian: [F; 3],
}

/// Distorts a vector of slopes.
#[inline(always)]
pub(super) fn distort<S: Simd>(s: S, model: &Model, slope: [S::F; 2]) -> Distorted<S::F> {
    let one = s.splat(1.0);
    let [x, y] = slope;
    let rr = s.mul_add(x, x, y * y);
    match *model {
        Model::Pinhole => Distorted { slope, jacobian: [one, s.splat(0.0), one] },
        Model::BrownConrady([k1, k2, p1, p2, k3]) => {
            let (p1, p2) = (s.splat(p1), s.splat(p2));
            let radial = polynomial(s, rr, [1.0, k1, k2, k3]);
            let growth = polynomial(s, rr, [k1, 2.0 * k2, 3.0 * k3]);
            let two = s.splat(2.0);
            // p1 y + p2 x, and the shift 2 s (p1 y + p2 x) + r^2 (p2, p1).
            let across = s.mul_add(p1, y, p2 * x);
            let shift_x = s.mul_add(two * x, across, rr * p2);
            let shift_y = s.mul_add(two * y, across, rr * p1);
            let (py, px) = (p1 * y, p2 * x);
            let three = s.splat(3.0);
            let xx = s.mul_add(two, s.mul_add(x * x, growth, s.mul_add(three, px, py)), radial);
            let xy = two * s.mul_add(x * y, growth, s.mul_add(p1, x, p2 * y));
            let yy = s.mul_add(two, s.mul_add(y * y, growth, s.mul_add(three, py, px)), radial);
            Distorted {
                slope: [s.mul_add(x, radial, shift_x), s.mul_add(y, radial, shift_y)],
                jacobian: [xx, xy, yy],
            }
        }
        Model::KannalaBrandt([k1, k2, k3, k4]) => {
            // On the axis any direction is valid: both factors are 1 there.
            let r = s.max(s.sqrt(rr), s.splat(1e-6));
            let inverse_r = one / r;
            let t = atan(s, r, inverse_r);
            let tt = t * t;
            let scale = t * polynomial(s, tt, [1.0, k1, k2, k3, k4]) * inverse_r;
            let bend = polynomial(s, tt, [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]);
            let along = bend / s.mul_add(r, r, one);
            let (ux, uy) = (x * inverse_r, y * inverse_r);
            let d = along - scale;
            Distorted {
                slope: [x * scale, y * scale],
                jacobian: [s.mul_add(d, ux * ux, scale), d * ux * uy, s.mul_add(d, uy * uy, scale)],
            }
        }
    }
}

/// Returns `factors[0] + x (factors[1] + x (factors[2] + ...))`.
#[inline(always)]
fn polynomial<S: Simd, const N: usize>(s: S, x: S::F, factors: [f32; N]) -> S::F {
    let mut sum = s.splat(factors[N - 1]);
    for k in (0..N - 1).rev() {
        sum = s.mul_add(sum, x, s.splat(factors[k]));
    }
    sum
}

/// Returns the arc tangent of a positive vector, given also its inverse, within 2e-7. [rad]
#[inline(always)]
fn atan<S: Simd>(s: S, v: S::F, inverse: S::F) -> S::F {
    let steep = s.lt(s.splat(1.0), v);
    let w = s.select(steep, inverse, v);
    let angle = w * polynomial(s, w * w, ATAN);
    s.select(steep, s.splat(std::f32::consts::FRAC_PI_2) - angle, angle)
}

/// `atan(x) / x` on 0 to 1 in powers of `x^2`, minimax in the angle: 6e-9 rad, 2e-7 in f32 (fitted by reweighted
/// least squares). This is 0.0003 px for a fisheye of 3840 px and 170 degrees.
const ATAN: [f32; 9] = [
    0.999_999_9,
    -0.333_325_98,
    0.199_859_07,
    -0.141_612_28,
    0.104_989_424,
    -0.072_348_5,
    0.039_781_142,
    -0.014_401_309,
    0.002_456_712_8,
];

#[cfg(test)]
mod tests;
