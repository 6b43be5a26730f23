//! Detection of single corners where four squares meet.

use glam::{DMat2, DVec2};

use crate::image::Gray;

/// Returns corner candidates, the clearest first. [px]
pub(super) fn candidates(image: &Gray) -> Vec<DVec2> {
    let (width, height) = (image.width_px() as usize, image.height_px() as usize);
    if width <= 2 * BORDER || height <= 2 * BORDER {
        return Vec::new();
    }
    let smooth = smoothed(image);
    let mut responses: Vec<(f32, usize, usize)> = Vec::new();
    let mut greatest = 0.0f32;
    for y in BORDER..height - BORDER {
        for x in BORDER..width - BORDER {
            let response = response(&smooth, width, x, y);
            if response > MIN_RESPONSE {
                responses.push((response, x, y));
                greatest = greatest.max(response);
            }
        }
    }
    responses.retain(|(response, ..)| *response > MIN_SHARE * greatest);
    responses.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut kept: Vec<DVec2> = Vec::new();
    for (_, x, y) in responses {
        let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        if kept.iter().all(|other| (*other - at).abs().max_element() > RADIUS_PX) {
            kept.push(at);
        }
        if kept.len() == MAX_CANDIDATES {
            break;
        }
    }
    kept.into_iter().filter_map(|at| refine(image, at, 3)).collect()
}

/// Returns the corner response of a pixel. It is high if samples on a ring agree with the opposite ones and differ from
/// those a quarter turn away, and if their mean equals that of the middle.
fn response(smooth: &[f32], width: usize, x: usize, y: usize) -> f32 {
    let at = |dx: isize, dy: isize| {
        smooth[y.wrapping_add_signed(dy) * width + x.wrapping_add_signed(dx)]
    };
    let ring = RING.map(|(dx, dy)| at(dx, dy));
    let (mut quarters, mut opposite) = (0.0, 0.0);
    for n in 0..4 {
        quarters += ((ring[n] + ring[n + 8]) - (ring[n + 4] + ring[n + 12])).abs();
    }
    for n in 0..8 {
        opposite += (ring[n] - ring[n + 8]).abs();
    }
    let ring_mean = ring.iter().sum::<f32>() / 16.0;
    let middle = (at(0, 0) + at(1, 0) + at(-1, 0) + at(0, 1) + at(0, -1)) / 5.0;
    quarters - opposite - 16.0 * (ring_mean - middle).abs()
}

/// Returns the image smoothed by the kernel 1 2 1 in both directions.
fn smoothed(image: &Gray) -> Vec<f32> {
    let (width, height) = (image.width_px() as usize, image.height_px() as usize);
    let pixels = image.pixels();
    let mut smooth = vec![0.0; pixels.len()];
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let row = |y: usize| {
                let at = y * width + x;
                u16::from(pixels[at - 1]) + 2 * u16::from(pixels[at]) + u16::from(pixels[at + 1])
            };
            smooth[y * width + x] = f32::from(row(y - 1) + 2 * row(y) + row(y + 1)) / 16.0;
        }
    }
    smooth
}

/// Refines a corner to a fraction of a pixel: the point to which all gradients within `half_px` are perpendicular
/// (Forstner and Gulch 1987). `None` if it does not converge nearby.
pub(super) fn refine(image: &Gray, start: DVec2, half_px: i32) -> Option<DVec2> {
    let mut corner = start;
    for _ in 0..MAX_ROUNDS {
        let mut sum = DMat2::ZERO;
        let mut right = DVec2::ZERO;
        for dy in -half_px..=half_px {
            for dx in -half_px..=half_px {
                let off = DVec2::new(dx.into(), dy.into());
                let at = corner + off;
                let gradient = DVec2::new(
                    sample(image, at + DVec2::X)? - sample(image, at - DVec2::X)?,
                    sample(image, at + DVec2::Y)? - sample(image, at - DVec2::Y)?,
                );
                // Less weight towards the window's border: pixels that enter or leave the window would cause jumps.
                let weight = (-off.length_squared() / f64::from(half_px * half_px)).exp();
                let outer = DMat2::from_cols(gradient * gradient.x, gradient * gradient.y) * weight;
                sum += outer;
                right += outer * at;
            }
        }
        if !(sum.determinant() > 1e-3 * sum.x_axis.x.max(sum.y_axis.y).powi(2)) {
            return None;
        }
        let moved = sum.inverse() * right;
        let step_px = moved.distance(corner);
        corner = moved;
        if !(corner.distance(start) <= f64::from(half_px)) {
            return None;
        }
        if step_px < 0.002 {
            break;
        }
    }
    Some(corner)
}

/// Returns the interpolated brightness; `None` outside the image.
pub(super) fn sample(image: &Gray, px: DVec2) -> Option<f64> {
    let at = px - 0.5;
    let whole = at.floor();
    let most = DVec2::new(f64::from(image.width_px()) - 1.0, f64::from(image.height_px()) - 1.0);
    if !(whole.cmpge(DVec2::ZERO).all() && whole.cmplt(most).all()) {
        return None;
    }
    let part = at - whole;
    let (x, y) = (whole.x as u32, whole.y as u32);
    let row = |y: u32| {
        f64::from(image.at(x, y)) * (1.0 - part.x) + f64::from(image.at(x + 1, y)) * part.x
    };
    Some(row(y) * (1.0 - part.y) + row(y + 1) * part.y)
}

/// Ring of radius 5, clockwise.
const RING: [(isize, isize); 16] = [
    (0, -5),
    (2, -5),
    (3, -3),
    (5, -2),
    (5, 0),
    (5, 2),
    (3, 3),
    (2, 5),
    (0, 5),
    (-2, 5),
    (-3, 3),
    (-5, 2),
    (-5, 0),
    (-5, -2),
    (-3, -3),
    (-2, -5),
];
/// Radius of the ring, and minimum distance of corners. [px]
const RADIUS_PX: f64 = 5.0;
/// Margin for the ring and one pixel of smoothing. [px]
const BORDER: usize = 6;
/// Minimum response: four pairs of quarters that differ by ten grey levels. [grey levels]
const MIN_RESPONSE: f32 = 40.0;
/// Minimum response of a corner relative to the clearest one, for uneven light.
const MIN_SHARE: f32 = 0.15;
/// Maximum number of candidates: a board and a similar amount of clutter.
const MAX_CANDIDATES: usize = 1500;
/// Maximum number of iterations; typical are three to six.
const MAX_ROUNDS: usize = 12;
