//! Alignment by a motion capture that tracked the camera.
//!
//! The tracked point is not the lens: its offset in the camera's axes is usually unmeasured. The clocks of the two
//! recordings also differ. Both are solved together with the alignment. But a camera that is carried level, however it
//! turns, does not determine the height of the tracked point above the lens; then the offset must be measured.

use glam::{DMat3, DQuat, DVec3};

use super::points::{self, Pair};
use super::{AlignError, Fit};

/// A camera pose of the capture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraPose {
    /// Time of the image on the capture's clock. [s]
    pub at_s: f64,
    /// Position of the lens. [scene]
    pub position: DVec3,
    /// Rotation from the camera's axes to the scene's.
    pub rotation: DQuat,
}

/// Position of the tracked point at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tracked {
    /// Time on the motion capture's clock. [s]
    pub at_s: f64,
    /// Position. [m, world]
    pub position_m: DVec3,
}

/// Alignment, and the values solved with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackFit {
    /// Alignment.
    pub fit: Fit,
    /// Motion capture's clock minus the capture's clock. [s]
    pub offset_s: f64,
    /// Tracked point in the camera's axes. [m]
    pub point_in_cam_m: DVec3,
}

/// Aligns a scene by cameras and a track, both ascending in time, whose clocks differ by at most `max_offset_s`. If the
/// position of the tracked point is given in `measured_m` [m, cam], it is not solved.
///
/// # Errors
/// Too few cameras within the track, a camera that hardly moved or turned, or errors of [`points::fit`].
pub fn fit(
    cameras: &[CameraPose],
    track: &[Tracked],
    max_offset_s: f64,
    sigma_m: f64,
    measured_m: Option<DVec3>,
) -> Result<TrackFit, AlignError> {
    if !measured_m.is_none_or(DVec3::is_finite) {
        return Err(AlignError::BadNumber("the position of the tracked point"));
    }
    if !(max_offset_s >= 0.0 && max_offset_s.is_finite()) {
        return Err(AlignError::BadNumber("the maximum offset of the clocks"));
    }
    let finite =
        |c: &CameraPose| c.at_s.is_finite() && c.position.is_finite() && c.rotation.is_finite();
    if !(cameras.iter().all(finite)
        && track.iter().all(|t| t.at_s.is_finite() && t.position_m.is_finite()))
    {
        return Err(AlignError::BadNumber("a pose's coordinate"));
    }
    if measured_m.is_none() {
        check_turns(cameras)?;
    }
    // Coarse search first. Its step is small enough not to miss the optimum: hand motion has a period of about a
    // second.
    let count = (max_offset_s / COARSE_S).ceil().min(MAX_STEPS) as i64;
    let step_s = if count == 0 { 0.0 } else { max_offset_s / count as f64 };
    let mut best: Option<(f64, TrackFit)> = None;
    let mut last_error = AlignError::TooFew { given: 0, needed: NEEDED };
    let mut consider = |offset_s: f64, best: &mut Option<(f64, TrackFit)>| match at_offset(
        cameras,
        track,
        offset_s,
        sigma_m,
        measured_m,
        points::fit_all,
    ) {
        Ok((cost, found)) if best.is_none_or(|(least, _)| cost < least) => {
            *best = Some((cost, found));
        }
        Ok(_) => {}
        Err(error) => last_error = error,
    };
    for step in -count..=count {
        consider(step as f64 * step_s, &mut best);
    }
    let mut width_s = step_s;
    while width_s > FINE_S {
        width_s *= 0.5;
        let Some((_, found)) = best else { break };
        for offset_s in [found.offset_s - width_s, found.offset_s + width_s] {
            consider(offset_s, &mut best);
        }
    }
    let (_, rough) = best.ok_or(last_error)?;
    let (_, mut found) =
        at_offset(cameras, track, rough.offset_s, sigma_m, measured_m, points::fit)?;
    if measured_m.is_some() {
        found.fit.place_sigma_m = found.fit.place_sigma_m.hypot(RULER_M);
    }
    Ok(found)
}

/// Returns the mean squared residual [m^2] and the alignment for one clock offset.
fn at_offset(
    cameras: &[CameraPose],
    track: &[Tracked],
    offset_s: f64,
    sigma_m: f64,
    measured_m: Option<DVec3>,
    place: fn(&[Pair], f64) -> Result<Fit, AlignError>,
) -> Result<(f64, TrackFit), AlignError> {
    let seen: Vec<(CameraPose, DVec3)> = cameras
        .iter()
        .filter_map(|camera| Some((*camera, at(track, camera.at_s + offset_s)?)))
        .collect();
    if seen.len() < NEEDED || seen.len() * 2 < cameras.len() {
        return Err(AlignError::TooFew {
            given: seen.len(),
            needed: NEEDED.max(cameras.len() / 2),
        });
    }
    // Position of the tracked point in units of the scene. Iterate: with it known, the rest is matching of points, and
    // the other way round.
    let mut point = DVec3::ZERO;
    let mut found = None;
    for _ in 0..ROUNDS {
        let pairs: Vec<Pair> = seen
            .iter()
            .map(|&(camera, world_m)| Pair {
                scene: camera.position + camera.rotation * point,
                world_m,
            })
            .collect();
        let fit = place(&pairs, sigma_m)?;
        let back = fit.world_from_scene;
        if let Some(measured_m) = measured_m {
            // Known in metres, but the scene's unit is not.
            let before = point;
            point = measured_m / back.scale;
            found = Some(fit);
            if !(point.distance(before) * back.scale >= CONVERGED_M) {
                break;
            }
            continue;
        }
        let (mut change, mut used) = (DVec3::ZERO, 0.0);
        // Residuals in the camera's axes: their mean determines the point's position, apart from what a shift of the
        // complete scene explains as well. That is the mean in the scene's axes.
        let left = |pair: &Pair| {
            back.rotation.conjugate() * (pair.world_m - back.transform_point(pair.scene))
                / back.scale
        };
        let good = pairs.iter().zip(&seen).filter(|(pair, _)| {
            back.transform_point(pair.scene).distance(pair.world_m) <= 4.6 * fit.rms_m.max(sigma_m)
        });
        let mut turned = DMat3::ZERO;
        let mut sum = DVec3::ZERO;
        for (pair, (camera, _)) in good {
            change += camera.rotation.conjugate() * left(pair);
            turned += DMat3::from_quat(camera.rotation);
            sum += left(pair);
            used += 1.0;
        }
        let (change, turned, sum) = (change / used, turned * (1.0 / used), sum / used);
        // Normal equations of change and shift together: [I, T^T; T, I].
        let information = DMat3::IDENTITY - turned.transpose() * turned;
        let step = information.inverse() * (change - turned.transpose() * sum);
        point += step;
        found = Some(fit);
        if step.length() * back.scale < CONVERGED_M {
            break;
        }
    }
    let fit =
        found.ok_or(AlignError::HardlyMoved("its rotations do not determine the tracked point"))?;
    let point_in_cam_m = point * fit.world_from_scene.scale;
    Ok((fit.rms_m.powi(2), TrackFit { fit, offset_s, point_in_cam_m }))
}

/// Returns the interpolated position at a time, or `None` in a gap of the track. [m, world]
fn at(track: &[Tracked], at_s: f64) -> Option<DVec3> {
    let after = track.partition_point(|tracked| tracked.at_s < at_s);
    let next = track.get(after)?;
    let Some(last) = after.checked_sub(1).map(|before| track[before]) else {
        return (next.at_s == at_s).then_some(next.position_m);
    };
    let gap_s = next.at_s - last.at_s;
    (gap_s <= MAX_GAP_S).then(|| last.position_m.lerp(next.position_m, (at_s - last.at_s) / gap_s))
}

/// Rejects a camera with a constant orientation, which does not determine the tracked point's position.
fn check_turns(cameras: &[CameraPose]) -> Result<(), AlignError> {
    if cameras.len() < NEEDED {
        return Err(AlignError::TooFew { given: cameras.len(), needed: NEEDED });
    }
    let mean =
        cameras.iter().fold(DMat3::ZERO, |sum, camera| sum + DMat3::from_quat(camera.rotation))
            * (1.0 / cameras.len() as f64);
    let information = DMat3::IDENTITY - mean.transpose() * mean;
    let rows = std::array::from_fn(|row| information.row(row).to_array());
    let [(least, _), ..] = super::eigen::symmetric::<3>(rows);
    if least > TURNS {
        Ok(())
    } else {
        Err(AlignError::HardlyMoved("it turned about only one axis, or not at all"))
    }
}

/// Minimum number of cameras within the track.
const NEEDED: usize = 6;
/// Step of the coarse search: a hand-held camera moves at about 2 Hz, so ten steps per period. [s]
const COARSE_S: f64 = 0.05;
/// Resolution of the clock offset: 1 mm at 1 m/s. [s]
const FINE_S: f64 = 0.001;
/// Maximum number of coarse steps to each side: 100 s.
const MAX_STEPS: f64 = 2000.0;
const ROUNDS: usize = 30;
/// Convergence limit of the tracked point's motion. [m]
const CONVERGED_M: f64 = 1e-7;
/// Standard deviation of a hand-measured position of the tracked point. [m]
const RULER_M: f64 = 0.005;
/// Maximum gap of the track that is interpolated. [s]
const MAX_GAP_S: f64 = 0.1;
/// Minimum spread of the orientations: 1 minus the squared mean of each axis' direction; turns of 8 degrees to each
/// side.
const TURNS: f64 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::Similarity;
    use crate::align::tests_support::gauss;
    use crate::random::Random;

    /// Returns a walk of 20 s: cameras every 0.4 s in the scene's frame, the track at 100 Hz in the world.
    fn walk(truth: &Similarity, offset_s: f64, beside_m: DVec3) -> (Vec<CameraPose>, Vec<Tracked>) {
        let pose = |t: f64| {
            let p_m = DVec3::new(
                2.0 * (0.5 * t).cos(),
                1.5 * (0.7 * t).sin(),
                1.4 + 0.2 * (1.1 * t).sin(),
            );
            let q = DQuat::from_rotation_z(0.6 * t) * DQuat::from_rotation_x(0.4 * (0.9 * t).sin());
            (p_m, q)
        };
        let cameras = (1..49).map(|k| {
            let t = f64::from(k) * 0.4;
            let (p_m, q) = pose(t);
            let back = truth.rotation.conjugate();
            CameraPose {
                at_s: t,
                position: back * (p_m - truth.translation_m) / truth.scale,
                rotation: back * q,
            }
        });
        let track = (0..2000).map(|k| {
            let t = f64::from(k) * 0.01;
            let (p_m, q) = pose(t);
            Tracked { at_s: t + offset_s, position_m: p_m + q * beside_m }
        });
        (cameras.collect(), track.collect())
    }

    fn truth() -> Similarity {
        Similarity {
            scale: 0.21,
            rotation: DQuat::from_scaled_axis(DVec3::new(1.2, -0.4, 0.7)),
            translation_m: DVec3::new(0.5, -1.0, 0.2),
        }
    }

    #[test]
    fn finds_alignment_clock_offset_and_tracked_point() {
        let truth = truth();
        let beside_m = DVec3::new(0.02, -0.08, -0.03);
        for offset_s in [0.0, 0.137, -1.42] {
            let (mut cameras, track) = walk(&truth, offset_s, beside_m);
            let mut random = Random::new(8);
            for camera in &mut cameras {
                camera.position += gauss(&mut random) * (0.005 / truth.scale);
            }
            let found = fit(&cameras, &track, 2.0, 0.002, None).unwrap();
            assert!((found.offset_s - offset_s).abs() < 0.01, "{found:?}");
            assert!(found.point_in_cam_m.distance(beside_m) < 0.01, "{found:?}");
            let scale = found.fit.world_from_scene.scale / truth.scale;
            assert!((scale - 1.0).abs() < 0.003, "{scale}");
            assert!(found.fit.rms_m < 0.012, "{found:?}");
            let p = DVec3::new(3.0, 1.0, -2.0);
            let off_m =
                found.fit.world_from_scene.transform_point(p).distance(truth.transform_point(p));
            assert!(off_m < 0.02, "{off_m}");
        }
    }

    #[test]
    fn rejects_walks_that_determine_nothing() {
        let (mut cameras, track) = walk(&truth(), 0.0, DVec3::ZERO);
        let few = fit(&cameras[..4], &track, 1.0, 0.002, None);
        assert_eq!(few, Err(AlignError::TooFew { given: 4, needed: 6 }));
        for camera in &mut cameras {
            camera.rotation = DQuat::IDENTITY;
        }
        let still = fit(&cameras, &track, 1.0, 0.002, None);
        assert!(matches!(still, Err(AlignError::HardlyMoved(_))));
        let (cameras, _) = walk(&truth(), 0.0, DVec3::ZERO);
        let short = fit(&cameras, &track[..20], 0.0, 0.002, None);
        assert!(matches!(short, Err(AlignError::TooFew { .. })));
        let nowhere = fit(&cameras, &track, 0.0, 0.002, Some(DVec3::NAN));
        assert!(matches!(nowhere, Err(AlignError::BadNumber(_))));
    }

    /// The camera is carried level, as people do: only a measurement gives the height of the marker above the lens.
    #[test]
    fn level_camera_needs_a_measured_point() {
        let truth = truth();
        let beside_m = DVec3::new(0.02, -0.08, -0.03);
        let (mut cameras, mut track) = walk(&truth, 0.3, DVec3::ZERO);
        for (k, camera) in (1..).zip(&mut cameras) {
            let level = DQuat::from_rotation_z(0.6 * f64::from(k) * 0.4);
            camera.rotation = truth.rotation.conjugate() * level;
        }
        for tracked in &mut track {
            let level = DQuat::from_rotation_z(0.6 * (tracked.at_s - 0.3));
            tracked.position_m += level * beside_m;
        }
        let unmeasured = fit(&cameras, &track, 1.0, 0.002, None);
        assert!(matches!(unmeasured, Err(AlignError::HardlyMoved(_))), "{unmeasured:?}");
        let found = fit(&cameras, &track, 1.0, 0.002, Some(beside_m)).unwrap();
        assert!(found.point_in_cam_m.distance(beside_m) < 1e-6, "{found:?}");
        let p = DVec3::new(3.0, 1.0, -2.0);
        let found_m = found.fit.world_from_scene.transform_point(p);
        assert!(found_m.distance(truth.transform_point(p)) < 0.002, "{found:?}");
    }
}
