//! Result of an adjustment, and its accuracy.

use glam::{DMat3, DVec3};

use super::capture::Capture;
use super::solve::{Problem, Solved, middle_m};
use super::start::Start;
use super::state::State;
use super::{Adjusted, HeldOut, Known, Readout, TagResult};

/// Assembles the result.
pub(super) fn describe(
    capture: &Capture,
    state: &State,
    solved: &Solved,
    known: Known,
    start: &Start,
    held_out: &[Option<HeldOut>],
) -> Adjusted {
    let (scale_sigma, tilt_sigma_rad) = sigmas(state, solved);
    let by_tags = tags_disagree(capture, held_out);
    let (points_rms_px, points_outliers) = fit_of_points(capture, state, solved);
    Adjusted {
        known,
        world_from_scene: start.world_from_scene,
        lens: state.lens,
        readout: readout(state, solved),
        world_from_cam: state.cameras.clone(),
        points_m: state.points.clone(),
        points_rms_px,
        points_outliers,
        places_rms_m: fit_of_places(capture, state),
        tags: (0..capture.tags.len())
            .map(|tag| fit_of_tag(capture, state, solved, tag, held_out[tag]))
            .collect(),
        inset_px: state.inset_px,
        scale_sigma: known.scale.then(|| scale_sigma.hypot(by_tags)),
        // Tags displaced by a fraction of the distance between them rotate the result by that angle.
        tilt_sigma_rad: known.up.then(|| {
            let turned = if known.place { by_tags } else { 0.0 };
            tilt_sigma_rad.hypot(turned)
        }),
        rounds: solved.rounds,
    }
}

/// Returns the standard deviations of the scale and of the vertical [rad] (in the worse direction). They belong to the
/// similarity transform closest to the cameras' errors, by the covariance of the normal equations.
fn sigmas(state: &State, solved: &Solved) -> (f64, f64) {
    let middle = middle_m(state);
    let count = state.cameras.len() as f64;
    let arms = || state.cameras.iter().map(|pose| pose.translation_m - middle);
    let reach2: f64 = arms().map(DVec3::length_squared).sum();
    // A camera's own rotation counts like a point at the mean distance.
    let lever2 = reach2 / count;
    let mut inertia = DMat3::from_diagonal(DVec3::splat(count * lever2));
    for arm in arms() {
        let outer = DMat3::from_cols(arm * arm.x, arm * arm.y, arm * arm.z);
        inertia += DMat3::from_diagonal(DVec3::splat(arm.length_squared())) - outer;
    }
    let back = inertia.inverse();
    let size = solved.layout.size;
    let (mut scale, mut turns) = (vec![0.0; size], [vec![0.0; size], vec![0.0; size]]);
    for (camera, (pose, arm)) in state.cameras.iter().zip(arms()).enumerate() {
        let at = solved.layout.camera * camera;
        scale[at..at + 3].copy_from_slice(&(arm / reach2).to_array());
        for (axis, turn) in [DVec3::X, DVec3::Y].into_iter().zip(&mut turns) {
            // back * (arm x change + lever^2 turn), along the axis.
            let row = back * axis;
            turn[at..at + 3].copy_from_slice(&row.cross(arm).to_array());
            let by_turn = pose.rotation.conjugate() * row * lever2;
            turn[at + 3..at + 6].copy_from_slice(&by_turn.to_array());
        }
    }
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let covered = |direction: &[f64]| solved.factor.solve(direction.to_vec());
    let scale_variance = product(&scale, &covered(&scale));
    let [x, y] = &turns;
    let (by_x, by_y) = (covered(x), covered(y));
    let (a, b, c) = (product(x, &by_x), product(x, &by_y), product(y, &by_y));
    let worse = 0.5 * (a + c) + (0.25 * (a - c).powi(2) + b * b).sqrt();
    (scale_variance.max(0.0).sqrt(), worse.max(0.0).sqrt())
}

/// Returns the readout time and its standard deviation, if estimated.
fn readout(state: &State, solved: &Solved) -> Option<Readout> {
    let at = solved.layout.readout()?;
    let mut one = vec![0.0; solved.layout.size];
    one[at] = 1.0;
    let sigma_s = solved.factor.solve(one)[at].max(0.0).sqrt();
    Some(Readout { seconds: state.rolling.readout_s, sigma_s })
}

/// Returns the error of held-out tags relative to the distance between them, reduced by their number. The normal
/// equations assume an exact layout and do not include it.
fn tags_disagree(capture: &Capture, held_out: &[Option<HeldOut>]) -> f64 {
    let placed: Vec<(DVec3, f64)> = capture
        .tags
        .iter()
        .zip(held_out)
        .filter_map(|(tag, held)| {
            let corners = tag.corners_m?;
            // A tag that its own sightings place badly is no evidence about the others.
            let held = (*held).filter(|held| held.by_pixel_m <= MOST_BY_PIXEL_M)?;
            Some((corners.iter().sum::<DVec3>() / 4.0, held.off_m?))
        })
        .collect();
    let count = placed.len() as f64;
    if placed.len() > 1 {
        let middle = placed.iter().map(|(p, _)| *p).sum::<DVec3>() / count;
        let spread2: f64 = placed.iter().map(|(p, _)| p.distance_squared(middle)).sum();
        let off2: f64 = placed.iter().map(|(_, off_m)| off_m * off_m).sum();
        return TOGETHER * (off2 / count / spread2).sqrt();
    }
    let sizes: Vec<f64> = held_out.iter().flatten().map(|held| held.size_error).collect();
    let off2: f64 = sizes.iter().map(|share| share * share).sum();
    if sizes.is_empty() { 0.0 } else { off2.sqrt() / sizes.len() as f64 }
}

fn fit_of_points(capture: &Capture, state: &State, solved: &Solved) -> (f64, f64) {
    let problem = Problem::new(capture, state, false, false, &[]);
    let limit_px = OUTLIER_SIGMAS * solved.noise.point_px;
    let (mut sum, mut good, mut all) = (0.0, 0.0f64, 0.0f64);
    for point in 0..state.points.len() {
        let sightings = problem.sightings(point);
        for &(camera, pixel) in if sightings.len() < 2 { &[] } else { sightings } {
            all += 1.0;
            let off = state.off_px(camera, state.points[point], pixel);
            if let Some(off_px) = off.map(glam::DVec2::length).filter(|px| *px <= limit_px) {
                sum += off_px * off_px;
                good += 1.0;
            }
        }
    }
    ((sum / good.max(1.0)).sqrt(), 1.0 - good / all.max(1.0))
}

fn fit_of_places(capture: &Capture, state: &State) -> Option<f64> {
    let off_m2 = |(image, pose): (&super::Image, &vizflyt_protocol::geometry::Pose<_, _>)| {
        let at_m = pose.transform_point(capture.tracked_in_cam_m);
        Some(at_m.distance_squared(image.place?.position_m))
    };
    let all: Vec<f64> = capture.images.iter().zip(&state.cameras).filter_map(off_m2).collect();
    (!all.is_empty()).then(|| (all.iter().sum::<f64>() / all.len() as f64).sqrt())
}

fn fit_of_tag(
    capture: &Capture,
    state: &State,
    solved: &Solved,
    tag: usize,
    held_out: Option<HeldOut>,
) -> Option<TagResult> {
    let corners_m = state.corners_m(capture, tag)?;
    let limit_px = (OUTLIER_SIGMAS * solved.noise.tag_px).max(CONTRADICTS_PX);
    let (mut sightings, mut contradicting, mut sum) = (0, 0, 0.0);
    for (camera, image) in capture.images.iter().enumerate() {
        for seen in image.tags.iter().filter(|seen| seen.tag == tag) {
            sightings += 1;
            // At short distance, a blurred corner can be many pixels off without contradicting.
            let ahead_m = state.cameras[camera].rotation.conjugate()
                * (corners_m[0] - state.cameras[camera].translation_m);
            let near_px = CONTRADICTS_M * state.lens.fx_px / ahead_m.z.max(1e-3);
            match state.tag_off_px(camera, &corners_m, seen) {
                Some(off_px) if off_px <= limit_px.max(near_px) => sum += off_px * off_px,
                _ => contradicting += 1,
            }
        }
    }
    let agree = f64::from(u32::max(sightings - contradicting, 1));
    let rms_px = (sum / agree).sqrt();
    let (sightings, contradicting) = (sightings as usize, contradicting as usize);
    Some(TagResult { sightings, contradicting, corners_m, rms_px, held_out })
}

/// Maximum position error per pixel of image error, for a held-out tag that counts. [m]
const MOST_BY_PIXEL_M: f64 = 0.03;
/// Factor for correlated errors: nearby tags have a common error where the walk between them drifted. Without it,
/// scales of recorded captures were off by 0.5 to 3 sigmas.
const TOGETHER: f64 = 1.5;
/// Outlier limit in sigmas, two axes together: it rejects one in 90 good sightings.
const OUTLIER_SIGMAS: f64 = 3.0;
/// Minimum error of a contradicting sighting: rolling shutter and blur displace corners by less. [px]
const CONTRADICTS_PX: f64 = 4.0;
/// Minimum error of a contradicting sighting as a length: in good captures, errors are smaller; confused tags are much
/// farther off. [m]
const CONTRADICTS_M: f64 = 0.05;
