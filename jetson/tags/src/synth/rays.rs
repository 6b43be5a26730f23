//! The ray through every pixel of a lens.

use glam::{DMat2, DVec2};
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

/// Slopes of the rays through the pixels' middles, row by row; NaN outside the lens's image.
#[derive(Debug)]
pub(super) struct Rays {
    width: u32,
    height: u32,
    slopes: Vec<DVec2>,
    reach: f64,
}

impl Rays {
    pub(super) fn new(k: &Intrinsics) -> Self {
        let reach = k.distortion.reach();
        let mut slopes = Vec::with_capacity(k.pixels());
        for y in 0..k.height_px {
            // The neighbour's slope is a good initial value; the first pixel of a row has none.
            let mut start = None;
            for x in 0..k.width_px {
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let slope = start
                    .and_then(|start| refine(k, pixel, start, reach))
                    .or_else(|| k.slope(pixel));
                slopes.push(slope.unwrap_or(DVec2::NAN));
                start = slope;
            }
        }
        Self { width: k.width_px, height: k.height_px, slopes, reach }
    }

    /// Returns the slope of a pixel's ray and its derivatives by one pixel right and down; `None` outside the lens's
    /// image.
    pub(super) fn at(&self, x: u32, y: u32) -> Option<(DVec2, DMat2)> {
        let slope = |x: u32, y: u32| self.slopes[y as usize * self.width as usize + x as usize];
        let here = slope(x, y);
        // The last column and row use backward differences.
        let right =
            if x + 1 < self.width { slope(x + 1, y) - here } else { here - slope(x.max(1) - 1, y) };
        let down = if y + 1 < self.height {
            slope(x, y + 1) - here
        } else {
            here - slope(x, y.max(1) - 1)
        };
        (here.is_finite() && right.is_finite() && down.is_finite())
            .then_some((here, DMat2::from_cols(right, down)))
    }

    /// Returns the pixel of a slope; `None` beyond the lens's maximum slope.
    pub(super) fn pixel(&self, slope: DVec2, k: &Intrinsics) -> Option<DVec2> {
        if !(slope.length() <= self.reach) {
            return None;
        }
        let distorted = k.distortion.distort(slope).0;
        Some(distorted * DVec2::new(k.fx_px, k.fy_px) + DVec2::new(k.cx_px, k.cy_px))
    }
}

/// Computes the slope of a pixel by Newton's method from a nearby slope: accurate, without the bisection that makes
/// [`Intrinsics::slope`] safe for any initial value. `None` if it does not converge.
fn refine(k: &Intrinsics, pixel: DVec2, start: DVec2, reach: f64) -> Option<DVec2> {
    let centre = DVec2::new(k.cx_px, k.cy_px);
    let distorted = (pixel - centre) / DVec2::new(k.fx_px, k.fy_px);
    if k.distortion == Distortion::None {
        return Some(distorted);
    }
    let mut slope = start;
    for _ in 0..6 {
        let (found, jacobian) = k.distortion.distort(slope);
        let change = jacobian.inverse() * (distorted - found);
        if !change.is_finite() {
            return None;
        }
        slope += change;
        if change.length() < 1e-12 {
            return (slope.length() < reach).then_some(slope);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_match_the_lens_model() {
        let pinhole = Intrinsics::from_horizontal_fov(320, 240, 1.4);
        for distortion in [
            Distortion::None,
            Distortion::BrownConrady { k1: -0.3, k2: 0.1, p1: 0.001, p2: -0.002, k3: 0.0 },
            // The lens has no image in its corners.
            Distortion::BrownConrady { k1: -0.4, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 },
            Distortion::KannalaBrandt { k1: 0.01, k2: -0.002, k3: 0.0, k4: 0.0 },
        ] {
            let k = Intrinsics { distortion, ..pinhole };
            let rays = Rays::new(&k);
            for y in (0..240).step_by(7) {
                for x in (0..320).step_by(7) {
                    let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let found = rays.slopes[(y * 320 + x) as usize];
                    match k.slope(pixel) {
                        Some(slope) => assert!((found - slope).length() < 1e-8, "{pixel}: {found}"),
                        None => assert!(!found.is_finite(), "{pixel}: {found}"),
                    }
                }
            }
        }
    }
}
