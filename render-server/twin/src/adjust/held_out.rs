//! Cross-validation by tags: triangulates tags that the adjustment did not use.

use glam::{DMat3, DVec3};

use super::capture::Capture;
use super::solve::{self, Solved};
use super::state::{State, TagPlace, inwards};
use super::{HeldOut, Known, Options};
use crate::align::corners::{Ray, meet};

/// Returns the result of each held-out tag, in the order of the capture's tags. `None` if too few other tags remain to
/// align the capture, or if too few images saw the tag.
pub(super) fn held_out(
    capture: &Capture,
    state: &State,
    solved: &Solved,
    options: Options,
    known: Known,
) -> Vec<Option<HeldOut>> {
    let mut results = vec![None; capture.tags.len()];
    let is_placed = |tag: &usize| !matches!(state.tags[*tag], TagPlace::Nowhere);
    let is_given = |tag: &usize| matches!(state.tags[*tag], TagPlace::Given(_));
    let placed: Vec<usize> = (0..capture.tags.len()).filter(is_placed).collect();
    // Measured positions and sizes are compared with different quantities; a tag with both counts by its position.
    let any_given = placed.iter().any(is_given);
    let anchors: Vec<usize> = placed.into_iter().filter(|tag| is_given(tag) == any_given).collect();
    if anchors.len() < 2 {
        return results;
    }
    let parts = anchors.len().min(PARTS);
    for part in 0..parts {
        let without: Vec<usize> = anchors.iter().copied().skip(part).step_by(parts).collect();
        let mut state = state.clone();
        if solve::settle(capture, &mut state, options, known, solved.noise, &without).is_err() {
            continue;
        }
        for &tag in &without {
            results[tag] = look(capture, &state, tag);
        }
    }
    results
}

/// Triangulates a tag from images only.
fn look(capture: &Capture, state: &State, tag: usize) -> Option<HeldOut> {
    let mut rays: [Vec<Ray>; 4] = Default::default();
    for (camera, image) in capture.images.iter().enumerate() {
        for seen in image.tags.iter().filter(|seen| seen.tag == tag) {
            for (k, rays) in rays.iter_mut().enumerate() {
                let pixel = seen.corners_px[k] - inwards(seen)[k] * state.inset_px;
                let pose = state.pose_at(camera, pixel);
                let direction = pose.rotation * state.lens.slope(pixel)?.extend(1.0);
                rays.push(Ray { origin: pose.translation_m, direction: direction.normalize() });
            }
        }
    }
    let mut corners_m = [DVec3::ZERO; 4];
    for (corner, rays) in corners_m.iter_mut().zip(&rays) {
        *corner = meet(rays)?.position;
    }
    let round_m: f64 = (0..4).map(|k| corners_m[k].distance(corners_m[(k + 1) % 4])).sum();
    let middle = |corners: &[DVec3; 4]| corners.iter().sum::<DVec3>() / 4.0;
    let given = capture.tags[tag].corners_m;
    let expected = given.unwrap_or(corners_m);
    let (mut sum, mut count) = (0.0, 0.0);
    let mut information = DMat3::ZERO;
    let middle_m = middle(&corners_m);
    for (camera, image) in capture.images.iter().enumerate() {
        for seen in image.tags.iter().filter(|seen| seen.tag == tag) {
            let ray_m = middle_m - state.cameras[camera].translation_m;
            let (reach_m, along) = (ray_m.length().max(1e-3), ray_m.normalize_or_zero());
            let across = DMat3::IDENTITY
                - DMat3::from_cols(along * along.x, along * along.y, along * along.z);
            information += across * (state.lens.fx_px / reach_m).powi(2);
            if let Some(off_px) = state.tag_off_px(camera, &expected, seen) {
                sum += off_px * off_px;
                count += 1.0;
            }
        }
    }
    let variance = information.inverse();
    let by_pixel_m = (variance.x_axis.x + variance.y_axis.y + variance.z_axis.z).max(0.0).sqrt();
    Some(HeldOut {
        by_pixel_m: if by_pixel_m.is_finite() { by_pixel_m } else { f64::MAX },
        off_m: given.map(|given| middle(&given).distance(middle(&corners_m))),
        size_error: round_m / (4.0 * capture.tags[tag].size_m) - 1.0,
        rms_px: if count > 0.0 { (sum / count).sqrt() } else { return None },
    })
}

/// Number of groups; each needs some rounds of the complete adjustment.
const PARTS: usize = 5;
