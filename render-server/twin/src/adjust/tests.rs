//! Adjustment of a synthetic hall: exact input gives exact results, and the bounds hold for noisy input.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Distortion, Pose};

use super::normal::normal;
use super::solve::Problem;
use super::start::start;
use super::state::{State, TagPlace};
use super::synthetic::{Hall, Shutter, filmed, hall};
use super::*;
use crate::align::points::{self, Pair};

/// Returns the scale error of the adjusted walk, its tilt [rad], and the RMS position error of the cameras [m].
fn errors(hall: &Hall, adjusted: &Adjusted) -> (f64, f64, f64) {
    let pairs: Vec<Pair> = adjusted
        .world_from_cam
        .iter()
        .zip(&hall.poses)
        .map(|(found, truth)| Pair { scene: truth.translation_m, world_m: found.translation_m })
        .collect();
    let to = points::fit(&pairs, 1e3).unwrap().world_from_scene;
    let off2: f64 = pairs.iter().map(|pair| pair.scene.distance_squared(pair.world_m)).sum();
    // Mean rotation of the cameras: on a walk of a few metres, their positions determine it less accurately.
    let turns = adjusted.world_from_cam.iter().zip(&hall.poses).map(|(found, truth)| {
        let turn = found.rotation * truth.rotation.conjugate();
        (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis()
    });
    let tilt = (turns.sum::<DVec3>() / pairs.len() as f64).truncate().length();
    (to.scale - 1.0, tilt, (off2 / pairs.len() as f64).sqrt())
}

#[test]
fn exact_sightings_give_exact_results() {
    let hall = hall(1, 24, 2500, 0.0).found(2, 0.02);
    let adjusted = adjust(&hall.capture, Options::default()).unwrap();
    let (scale, tilt, off_m) = errors(&hall, &adjusted);
    assert!(scale.abs() < 1e-6 && tilt < 1e-6 && off_m < 1e-5, "{scale} {tilt} {off_m}");
    assert!((adjusted.lens.fx_px / hall.lens.fx_px - 1.0).abs() < 1e-6, "{:?}", adjusted.lens);
    let Distortion::BrownConrady { k1, k2, .. } = adjusted.lens.distortion else { panic!() };
    assert!((k1 + 0.06).abs() < 1e-5 && (k2 - 0.02).abs() < 1e-5, "{k1} {k2}");
    assert_eq!(adjusted.known, Known { scale: true, up: true, place: true });
    for tag in adjusted.tags.iter().flatten() {
        let held = tag.held_out.unwrap();
        assert!(held.off_m.unwrap() < 1e-4 && tag.contradicting == 0, "{tag:?}");
    }
}

#[test]
fn bounds_hold_under_noise() {
    let (mut outside, mut scales, mut sigmas) = (0, 0.0, 0.0);
    for seed in 0..12 {
        let hall = hall(seed, 24, 2000, 0.6).found(seed + 50, 0.01);
        let adjusted = adjust(&hall.capture, Options::default()).unwrap();
        let (scale, tilt, off_m) = errors(&hall, &adjusted);
        let (by_scale, by_tilt) = (adjusted.scale_sigma.unwrap(), adjusted.tilt_sigma_rad.unwrap());
        outside += usize::from(scale.abs() > 3.0 * by_scale || tilt > 3.0 * by_tilt);
        println!("{seed}: {:.2} {:.2}", scale / by_scale, tilt / by_tilt);
        (scales, sigmas) = (scales + scale * scale, sigmas + by_scale * by_scale);
        assert!(off_m < 0.02, "{seed}: {off_m}");
        assert!((0.5..1.1).contains(&adjusted.points_rms_px), "{}", adjusted.points_rms_px);
    }
    assert!(outside <= 1, "{outside} of 12 beyond three sigmas");
    // The bounds must not hold only because they are far too large.
    assert!(sigmas < 50.0 * scales, "sigma^2 {sigmas} for error^2 {scales}");
}

/// White that bleeds into black shortens every edge of a tag; distances between tags determine by how much.
#[test]
fn inset_corners_do_not_bias_the_scale() {
    let mut hall = hall(13, 24, 2500, 0.2).found(14, 0.01);
    for seen in hall.capture.images.iter_mut().flat_map(|image| &mut image.tags) {
        let middle = seen.corners_px.iter().sum::<glam::DVec2>() / 4.0;
        seen.corners_px = seen.corners_px.map(|px| px + (middle - px).normalize() * 0.3);
    }
    let adjusted = adjust(&hall.capture, Options::default()).unwrap();
    let (scale, _, off_m) = errors(&hall, &adjusted);
    assert!(scale.abs() < 2e-3 && off_m < 0.01, "{scale} {off_m}");
    assert!((adjusted.inset_px - 0.3).abs() < 0.05, "{}", adjusted.inset_px);
    let held = adjusted.tags.iter().flatten().filter_map(|tag| tag.held_out);
    let sizes: Vec<f64> = held.map(|held| held.size_error).collect();
    assert!(sizes.iter().sum::<f64>().abs() / (sizes.len() as f64) < 3e-3, "{sizes:?}");
}

#[test]
fn tag_sizes_determine_scale_but_not_the_vertical() {
    let mut hall = hall(3, 24, 2500, 0.3).found(4, 0.01);
    hall.capture.tags.iter_mut().for_each(|tag| tag.corners_m = None);
    let adjusted = adjust(&hall.capture, Options::default()).unwrap();
    assert_eq!(adjusted.known, Known { scale: true, up: false, place: false });
    let (scale, _, _) = errors(&hall, &adjusted);
    assert!(scale.abs() < 3.0 * adjusted.scale_sigma.unwrap() && scale.abs() < 0.01, "{scale}");
    assert_eq!(adjusted.tilt_sigma_rad, None);
    assert!(adjusted.tags.iter().flatten().all(|tag| tag.held_out.unwrap().off_m.is_none()));
}

#[test]
fn uses_measured_vertical_and_positions() {
    let mut upright = hall(3, 24, 2500, 0.3).found(4, 0.01);
    upright.capture.tags.iter_mut().for_each(|tag| tag.corners_m = None);
    for (image, pose) in upright.capture.images.iter_mut().zip(&upright.poses) {
        let direction = pose.rotation.conjugate() * DVec3::Z;
        image.up = Some(Up { direction, sigma_rad: 0.01 });
    }
    let adjusted = adjust(&upright.capture, Options::default()).unwrap();
    assert_eq!(adjusted.known, Known { scale: true, up: true, place: false });
    let (_, tilt, _) = errors(&upright, &adjusted);
    assert!(tilt < 3.0 * adjusted.tilt_sigma_rad.unwrap() && tilt < 0.01, "{tilt}");

    let mut tracked = hall(3, 24, 2500, 0.3).found(4, 0.01);
    tracked.capture.tags.clear();
    tracked.capture.tracked_in_cam_m = DVec3::new(0.05, -0.1, 0.02);
    let lever_m = tracked.capture.tracked_in_cam_m;
    for (number, (image, pose)) in tracked.capture.images.iter_mut().zip(&tracked.poses).enumerate()
    {
        image.tags.clear();
        let mut position_m = pose.transform_point(lever_m);
        // An outlier of the motion capture.
        position_m.x += if number == 7 { 0.5 } else { 0.0 };
        image.place = Some(Place { position_m, sigma_m: 0.002 });
    }
    let adjusted = adjust(&tracked.capture, Options::default()).unwrap();
    assert_eq!(adjusted.known, Known { scale: true, up: true, place: true });
    let (scale, tilt, off_m) = errors(&tracked, &adjusted);
    assert!(scale.abs() < 2e-3 && tilt < 2e-3 && off_m < 0.01, "{scale} {tilt} {off_m}");
}

#[test]
fn has_no_metric_scale_without_measurements() {
    let mut hall = hall(5, 24, 2500, 0.2).found(6, 0.01);
    hall.capture.tags.clear();
    hall.capture.images.iter_mut().for_each(|image| image.tags.clear());
    let adjusted = adjust(&hall.capture, Options::default()).unwrap();
    assert_eq!(adjusted.known, Known::default());
    assert_eq!((adjusted.scale_sigma, adjusted.tilt_sigma_rad), (None, None));
    assert!(adjusted.points_rms_px < 0.4, "{}", adjusted.points_rms_px);
}

/// A mismatch may put a point a millimetre in front of a camera. Its strong influence on that camera must not spoil the
/// other unknowns.
#[test]
fn point_close_to_a_camera_keeps_the_problem_determined() {
    for before_m in [1e-2, 1e-4, 1e-6, 1e-9] {
        let mut hall = hall(5, 24, 1000, 0.2);
        hall.capture.tags.clear();
        hall.capture.images.iter_mut().for_each(|image| image.tags.clear());
        // Put a camera where another looks.
        let far = hall.poses[3];
        let ahead = far.rotation * DVec3::Z;
        let near = Pose::new(far.translation_m + ahead, far.rotation);
        let nose = near.translation_m + ahead * before_m;
        let mut image = hall.capture.images[3].clone();
        image.scene_from_cam = near;
        image.seen.retain_mut(|seen| {
            let p_cam = near.inverse().transform_point(hall.capture.points[seen.point]);
            let pixel = hall.lens.project(p_cam).filter(|_| p_cam.z > 0.3);
            seen.pixel = pixel.unwrap_or_default();
            pixel.is_some()
        });
        hall.capture.images.push(image);
        hall.capture.points.push(nose);
        let point = hall.capture.points.len() - 1;
        for at in [3, 24] {
            let pixel = hall.lens.project(DVec3::Z).unwrap();
            hall.capture.images[at].seen.push(Sighting { point, pixel });
        }
        let adjusted = adjust(&hall.capture, Options::default());
        let adjusted = adjusted.unwrap_or_else(|error| panic!("{before_m} m: {error}"));
        assert!(adjusted.points_rms_px < 0.4, "{before_m} m: {}", adjusted.points_rms_px);
    }
}

/// Rows exposed over a fiftieth of a second by a hand that pitches: a global shutter cannot explain the images.
#[test]
fn estimates_a_rolling_shutter_without_position_errors() {
    let shutter = Shutter { readout_s: 0.022, hand_rad: 0.015 };
    for seed in [21, 22] {
        let hall = filmed(seed, 36, 2500, 0.3, shutter).found(seed + 10, 0.01);
        let off = |rolling| {
            let adjusted =
                adjust(&hall.capture, Options { rolling, ..Options::default() }).unwrap();
            let (scale, _, off_m) = errors(&hall, &adjusted);
            println!(
                "rolling {rolling}: scale {scale:.5}, {:.1} mm, {:.2} px, readout {:?}, scale sigma {:.5}",
                off_m * 1e3,
                adjusted.points_rms_px,
                adjusted.readout,
                adjusted.scale_sigma.unwrap()
            );
            (adjusted, scale, off_m)
        };
        let (_, _, unmodelled_m) = off(false);
        let (adjusted, scale, off_m) = off(true);
        assert!(
            unmodelled_m > 0.01 && off_m < 0.4 * unmodelled_m,
            "{unmodelled_m} m, then {off_m}"
        );
        assert!(scale.abs() < 2e-3 && adjusted.points_rms_px < 0.5, "{scale}");
        let Readout { seconds, sigma_s } = adjusted.readout.unwrap();
        let off_s = (seconds - 0.022).abs();
        assert!(off_s < 3.0 * sigma_s && sigma_s < 2e-3, "{seconds} {sigma_s}");
    }
}

#[test]
fn estimates_zero_readout_of_a_global_shutter() {
    for seed in 0..3 {
        let shutter = Shutter { readout_s: 0.0, hand_rad: 0.02 };
        let hall = filmed(seed, 36, 2500, 0.5, shutter).found(seed + 30, 0.01);
        let off = |rolling| {
            let adjusted =
                adjust(&hall.capture, Options { rolling, ..Options::default() }).unwrap();
            let (_, _, off_m) = errors(&hall, &adjusted);
            (adjusted, off_m)
        };
        let ((_, without_m), (adjusted, off_m)) = (off(false), off(true));
        let Readout { seconds, sigma_s } = adjusted.readout.unwrap();
        println!("{:.2} mm, then {:.2}; {seconds} +- {sigma_s}", without_m * 1e3, off_m * 1e3);
        assert!(seconds.abs() < 3.0 * sigma_s && sigma_s < 2e-3, "{seconds} {sigma_s}");
        assert!(off_m < 1.1 * without_m + 5e-4, "{without_m} {off_m}");
    }
}

#[test]
fn result_does_not_depend_on_the_number_of_threads() {
    let hall = hall(7, 20, 600, 0.5).found(8, 0.01);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| adjust(&hall.capture, Options::default()).unwrap())
    };
    assert_eq!(with(1), with(5));
}

#[test]
fn rejects_invalid_captures() {
    let good = hall(9, 20, 600, 0.2).found(10, 0.01).capture;
    let refused = |change: &dyn Fn(&mut Capture)| {
        let mut capture = good.clone();
        change(&mut capture);
        adjust(&capture, Options::default()).unwrap_err()
    };
    let bad = |error| matches!(error, AdjustError::BadNumber(_));
    assert!(bad(refused(&|c| c.points[3].x = f64::NAN)));
    assert!(bad(refused(&|c| c.images[2].seen[0].point = 600)));
    assert!(bad(refused(&|c| c.images[2].seen[0].pixel.y = f64::INFINITY)));
    assert!(bad(refused(
        &|c| c.images[1].scene_from_cam.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0)
    )));
    assert!(bad(refused(&|c| c.tags[0].size_m = 0.0)));
    assert!(bad(refused(&|c| c.lens.fx_px = -1.0)));
    let few = refused(&|c| c.images.truncate(2));
    assert!(matches!(few, AdjustError::TooLittle { images: 2, .. }), "{few}");
    let empty = refused(&|c| c.images.iter_mut().for_each(|image| image.seen.clear()));
    assert_eq!(empty, AdjustError::TooLittle { images: 20, points: 0 });
}

#[test]
fn pose_derivatives_match_finite_differences() {
    let hall = hall(11, 20, 300, 0.0);
    let (begin, _) = start(&hall.capture).unwrap();
    let mut state = State::new(&hall.capture, &begin);
    state.rolling.readout_s = 0.03;
    state.rolling.follow(&hall.capture, &state.cameras);
    for (camera, bend) in state.rolling.bends_rad.iter_mut().enumerate() {
        *bend = DVec3::new(0.01, -0.02, 0.015) * (1.0 + 0.1 * camera as f64);
    }
    let h = 1e-6;
    for (camera, image) in hall.capture.images.iter().enumerate() {
        for seen in image.seen.iter().take(5) {
            let p = state.points[seen.point];
            let px = seen.pixel;
            let (here, in_row) = state.see(camera, p, px).unwrap();
            let found = in_row.slopes(&state.cameras[camera], &here.by_point);
            let at_readout = |readout_s: f64| {
                let mut state = state.clone();
                state.rolling.readout_s = readout_s;
                state.see(camera, p, px).unwrap().0.pixel
            };
            let slope = (at_readout(0.03 + h) - at_readout(0.03 - h)) / (2.0 * h);
            assert!((slope - found.by_readout).length() < 1e-3, "{slope} {}", found.by_readout);
            for axis in 0..3 {
                let by = DVec3::AXES[axis] * h;
                let along = |p: DVec3| state.see(camera, p, px).unwrap().0.pixel;
                let slope = (along(p + by) - along(p - by)) / (2.0 * h);
                assert!((slope - found.by_point[axis]).length() < 1e-3);
                let moved = |shift: DVec3, turn: DVec3| {
                    let mut state = state.clone();
                    let pose = &mut state.cameras[camera];
                    let q = pose.rotation * DQuat::from_scaled_axis(turn);
                    *pose = Pose::new(pose.translation_m + shift, q);
                    state.see(camera, p, px).unwrap().0.pixel
                };
                let zero = DVec3::ZERO;
                let shift = (moved(by, zero) - moved(-by, zero)) / (2.0 * h);
                assert!((shift - found.by_camera[axis]).length() < 1e-3);
                let turn = (moved(zero, by) - moved(zero, -by)) / (2.0 * h);
                assert!((turn - found.by_camera[3 + axis]).length() < 1e-3);
                let bent = |bend: DVec3| {
                    let mut state = state.clone();
                    state.rolling.bends_rad[camera] += bend;
                    state.see(camera, p, px).unwrap().0.pixel
                };
                let bend = (bent(by) - bent(-by)) / (2.0 * h);
                assert!((bend - found.by_camera[6 + axis]).length() < 1e-3);
            }
        }
    }
}

/// Compares the gradient of tags, positions and verticals by every unknown with differences of the cost.
#[test]
fn gradient_matches_differences_of_the_cost() {
    let mut hall = hall(12, 16, 300, 2.0);
    hall.capture.tags.iter_mut().step_by(2).for_each(|tag| tag.corners_m = None);
    hall.capture.tracked_in_cam_m = DVec3::new(0.1, 0.05, -0.2);
    for image in &mut hall.capture.images {
        image.place = Some(Place {
            position_m: image.scene_from_cam.translation_m + DVec3::new(0.1, -0.02, 0.05),
            sigma_m: 0.05,
        });
        let direction =
            (image.scene_from_cam.rotation.conjugate() * DVec3::new(0.1, -0.05, 1.0)).normalize();
        image.up = Some(Up { direction, sigma_rad: 0.05 });
    }
    let (begin, _) = start(&hall.capture).unwrap();
    // Remove the sightings of points, so that no points are eliminated.
    hall.capture.images.iter_mut().for_each(|image| image.seen.clear());
    let mut state = State::new(&hall.capture, &begin);
    state.inset_px = 0.2;
    state.rolling.readout_s = 0.02;
    state.rolling.follow(&hall.capture, &state.cameras);
    state.rolling.bends_rad.iter_mut().for_each(|bend| *bend = DVec3::new(2e-3, -1e-3, 3e-3));
    for tag in &mut state.tags {
        if let TagPlace::Found(t, q) = tag {
            *t += DVec3::new(0.01, -0.02, 0.01);
            *q *= DQuat::from_scaled_axis(DVec3::new(0.05, 0.1, -0.1));
        }
    }
    let problem = Problem::new(&hall.capture, &state, true, true, &[]);
    let found = normal(&problem, &state, 0.0).gradient;
    assert!(problem.layout.tags.iter().any(Option::is_some));
    let no_points = vec![DVec3::ZERO; state.points.len()];
    let h = 1e-6;
    for unknown in 0..problem.layout.size {
        let cost = |by: f64| {
            let mut change = vec![0.0; problem.layout.size];
            change[unknown] = by;
            problem.cost(&super::solve::stepped(&state, &problem.layout, &change, &no_points))
        };
        let slope = (cost(h) - cost(-h)) / (4.0 * h);
        let off = (slope - found[unknown]).abs();
        assert!(off < 1e-4 * (1.0 + slope.abs()), "{unknown}: {slope} {}", found[unknown]);
    }
}
