use super::*;
use crate::family::TagFamily;
use crate::image::Gray;
use crate::layout::TagLayout;
use crate::print::{BAR_MM, Mat, Paper};
use crate::synth::{Light, Placed, Random, Renderer, SyntheticExposure};
use vizflyt_protocol::geometry::Pose;

fn board() -> TagLayout {
    Mat::board(TagFamily::Tag36h11, 300, 30.0, Paper::A4, BAR_MM).unwrap().print().unwrap().layout
}

fn webcam() -> Intrinsics {
    Intrinsics {
        fx_px: 912.0,
        fy_px: 909.0,
        cx_px: 655.0,
        cy_px: 349.0,
        distortion: Distortion::BrownConrady {
            k1: -0.16,
            k2: 0.06,
            p1: 0.0008,
            p2: -0.0011,
            k3: 0.0,
        },
        ..Intrinsics::from_horizontal_fov(1280, 720, 1.2)
    }
}

/// Returns the tags of a board at a pose, with `noise_px` on the corners; without tags outside the image.
fn look(
    lens: &Intrinsics,
    cam_from_board: Rigid,
    noise_px: f64,
    random: &mut Random,
) -> Vec<Detection> {
    let mut detections = Vec::new();
    for tag in &board().tags {
        let corners_px = tag.corners_m().map(|corner| {
            let noise = DVec2::new(random.normal(), random.normal()) * noise_px;
            lens.project(cam_from_board.apply(corner)).map(|pixel| pixel + noise)
        });
        let size = DVec2::new(lens.width_px.into(), lens.height_px.into());
        let inside = |p: &Option<DVec2>| {
            p.is_some_and(|p| p.cmpgt(DVec2::splat(3.0)).all() && p.cmplt(size - 3.0).all())
        };
        if corners_px.iter().all(inside) {
            let corners_px = corners_px.map(Option::unwrap);
            detections.push(Detection {
                family: tag.family,
                id: tag.id,
                corners_px,
                hamming: 0,
                margin: 60.0,
            });
        }
    }
    detections
}

/// A board in one of nine parts of the image, tilted by up to `tilt_rad`.
fn pose(lens: &Intrinsics, i: u32, tilt_rad: f64, random: &mut Random) -> Rigid {
    let place = |n: u32| f64::from(n) - 1.0;
    let depth_m = 0.32 + 0.1 * random.unit();
    let reach = DVec2::new(0.30 * f64::from(lens.width_px), 0.28 * f64::from(lens.height_px));
    let slope = DVec2::new(place(i % 3), place(i / 3 % 3)) * reach / lens.fx_px;
    let facing = DQuat::from_rotation_x(std::f64::consts::PI);
    let tilt = DVec3::new(random.unit() - 0.5, random.unit() - 0.5, 0.4 * (random.unit() - 0.5));
    Rigid {
        t_m: (slope * depth_m).extend(depth_m),
        q: DQuat::from_scaled_axis(tilt * 2.0 * tilt_rad) * facing,
    }
}

fn gather(lens: &Intrinsics, views: u32, tilt_rad: f64, noise_px: f64) -> Calibrator {
    let mut random = Random::new(11);
    let mut calibrator = Calibrator::new(board(), [lens.width_px, lens.height_px]).unwrap();
    for i in 0..views {
        let pose = pose(lens, i, tilt_rad, &mut random);
        calibrator.add(&look(lens, pose, noise_px, &mut random), false);
    }
    calibrator
}

#[test]
fn calibrates_a_lens_to_a_thousandth() {
    let truth = webcam();
    let found = gather(&truth, 45, 0.7, 0.1).finish(LensModel::BrownConrady).unwrap();
    let k = found.intrinsics;
    assert!((k.fx_px / truth.fx_px - 1.0).abs() < 1e-3, "{k:?}");
    assert!((k.fy_px / truth.fy_px - 1.0).abs() < 1e-3, "{k:?}");
    assert!((k.cx_px - truth.cx_px).abs() < 1.0 && (k.cy_px - truth.cy_px).abs() < 1.0, "{k:?}");
    // 0.1 px on each of two axes.
    assert!((0.10..0.18).contains(&found.calibration.rms_px), "{:?}", found.calibration);
    assert!((0.10..0.20).contains(&found.calibration.held_out_rms_px), "{:?}", found.calibration);
    // Rays through the whole image must match, also in the corners.
    for (x, y) in [(20.0, 20.0), (1260.0, 30.0), (640.0, 360.0), (15.0, 700.0), (1270.0, 710.0)] {
        let pixel = DVec2::new(x, y);
        let off = truth.slope(pixel).unwrap() - k.slope(pixel).unwrap();
        assert!(off.length() * truth.fx_px < 1.5, "{off} at {pixel}");
    }
}

#[test]
fn calibrates_a_lens_from_rendered_images() {
    let truth = Intrinsics {
        fx_px: 460.0,
        fy_px: 459.0,
        cx_px: 323.0,
        cy_px: 236.0,
        distortion: webcam().distortion,
        ..Intrinsics::from_horizontal_fov(640, 480, 1.2)
    };
    let renderer = Renderer::new(truth);
    let mut random = Random::new(6);
    let mut session = Session::new(board(), LensModel::BrownConrady);
    for i in 0..36 {
        let Rigid { t_m, q } = pose(&truth, i, 0.7, &mut random);
        // The board moves; the camera's frame is the world.
        let board = board();
        let placed = [Placed::anywhere(&board, Pose::new(t_m, q))];
        let light = Light { gradient: DVec2::new(0.3, -0.2), vignette: 0.2, ..Light::default() };
        let shot = SyntheticExposure {
            blur_px: 0.6,
            noise: 2.5,
            seed: i.into(),
            light,
            ..SyntheticExposure::still(&placed, Pose::IDENTITY)
        };
        session.take(renderer.render(&shot), false).unwrap();
    }
    let found = session.finish().unwrap();
    let k = found.intrinsics;
    assert!((k.fx_px / truth.fx_px - 1.0).abs() < 2e-3, "{found:?}");
    assert!(
        (k.cx_px - truth.cx_px).abs() < 1.5 && (k.cy_px - truth.cy_px).abs() < 1.5,
        "{found:?}"
    );
    assert!(found.calibration.rms_px < 0.25, "{found:?}");
    assert!(found.calibration.held_out_rms_px < 0.3, "{found:?}");
    // The error is within the returned sigmas.
    assert!((k.fx_px - truth.fx_px).abs() < 5.0 * found.sigma_px[0] + 0.2, "{found:?}");
    let other = Gray::plain(320, 240, 90);
    let mut session = Session::new(board(), LensModel::BrownConrady);
    session.take(Gray::plain(640, 480, 90), false).unwrap();
    assert!(session.take(other, false).unwrap_err().to_string().contains("320x240"));
}

#[test]
fn calibrates_a_fisheye_with_its_model() {
    let truth = Intrinsics {
        fx_px: 420.0,
        fy_px: 420.0,
        distortion: Distortion::KannalaBrandt { k1: -0.02, k2: 0.004, k3: 0.0, k4: 0.0 },
        ..Intrinsics::from_horizontal_fov(1280, 720, 1.2)
    };
    let mut random = Random::new(3);
    let mut calibrator = Calibrator::new(board(), [1280, 720]).unwrap();
    for i in 0..70 {
        let mut pose = pose(&truth, i, 0.6, &mut random);
        // Closer and further out, because a fisheye shows the board small.
        pose.t_m *= DVec3::new(0.9, 0.9, 0.6);
        calibrator.add(&look(&truth, pose, 0.1, &mut random), false);
    }
    let found = calibrator.finish(LensModel::KannalaBrandt).unwrap();
    assert!((found.intrinsics.fx_px / 420.0 - 1.0).abs() < 3e-3, "{found:?}");
    assert!(found.calibration.held_out_rms_px < 0.25, "{found:?}");
}

#[test]
fn rejects_an_insufficient_set_with_instructions() {
    let refused = |calibrator: &Calibrator, parts: &[&str]| {
        let error = calibrator.finish(LensModel::BrownConrady).unwrap_err().to_string();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    };
    // Too few views.
    refused(&gather(&webcam(), 8, 0.7, 0.1), &["more views"]);
    // Never tilted: focal length and distance cannot be separated.
    refused(&gather(&webcam(), 45, 0.02, 0.1), &["turn the board to face to the left"]);
    // Only in the middle.
    let mut random = Random::new(1);
    let mut middle = Calibrator::new(board(), [1280, 720]).unwrap();
    for _ in 0..60 {
        let mut pose = pose(&webcam(), 4, 0.7, &mut random);
        pose.t_m *= 3.0;
        middle.add(&look(&webcam(), pose, 0.1, &mut random), false);
    }
    refused(&middle, &["upper left corner", "lower edge"]);
    // Corners that scatter by pixels, as with a bent board or blur.
    refused(&gather(&webcam(), 45, 0.7, 1.5), &["px off", "flat"]);
}

#[test]
fn keeps_only_still_and_new_views() {
    let mut random = Random::new(1);
    let lens = webcam();
    let mut calibrator = Calibrator::new(board(), [1280, 720]).unwrap();
    let at = pose(&lens, 4, 0.3, &mut random);
    let view = look(&lens, at, 0.1, &mut random);
    assert_eq!(calibrator.add(&view[..3], false), ViewOutcome::TooFewTags);
    // The three tags have not moved since the previous image.
    assert_eq!(calibrator.add(&view, true), ViewOutcome::Kept);
    assert_eq!(calibrator.add(&look(&lens, at, 0.1, &mut random), true), ViewOutcome::KnownView);
    let moved = pose(&lens, 0, 0.3, &mut random);
    let view = look(&lens, moved, 0.1, &mut random);
    assert_eq!(calibrator.add(&view, true), ViewOutcome::Moving);
    assert_eq!(calibrator.add(&view, true), ViewOutcome::Kept);
    assert_eq!(calibrator.views(), 2);
}

#[test]
fn rejects_a_bent_board() {
    let mut bent = board();
    bent.tags[3].position_m.z = 0.01;
    assert!(Calibrator::new(bent, [1280, 720]).unwrap_err().to_string().contains("not flat"));
}

#[test]
fn reports_wrong_corner_counts_of_a_checkerboard() {
    use crate::checkerboard::Checkerboard;
    use crate::checkerboard::tests::{BOARD, PAINTER, pose};

    let mut random = Random::new(8);
    let mut session =
        Session::new(Checkerboard { columns: 6, rows: 7, ..BOARD }, LensModel::BrownConrady);
    let verdicts: Vec<ViewOutcome> = (0..12)
        .map(|i| {
            let at = pose(i, 0.75, DVec2::new(40.0, 30.0), &mut random);
            session.take(PAINTER.paint(&BOARD, &at, 2.0, i.into()), false).unwrap()
        })
        .collect();
    assert!(verdicts.contains(&ViewOutcome::AnotherBoard(6, 9)), "{verdicts:?}");
    let others = verdicts.iter().filter(|verdict| !matches!(verdict, ViewOutcome::NoBoard));
    assert!(
        others.clone().all(|verdict| *verdict == ViewOutcome::AnotherBoard(6, 9)),
        "{verdicts:?}"
    );
    let refused = session.finish().unwrap_err().to_string();
    assert!(refused.contains("6 by 9 inner corners"), "{refused}");
}

#[test]
fn calibrates_a_lens_from_images_of_a_checkerboard() {
    use crate::checkerboard::tests::{BOARD, PAINTER, pose, webcam};

    let truth = webcam();
    let mut random = Random::new(8);
    let mut session = Session::new(BOARD, LensModel::BrownConrady);
    assert_eq!(session.take(Gray::plain(640, 480, 90), false).unwrap(), ViewOutcome::NoBoard);
    for i in 0..45 {
        // Into the corners; a board that is cut by the image's border is not detected.
        let at = pose(i, 0.75, DVec2::new(158.0, 126.0), &mut random);
        session.take(PAINTER.paint(&BOARD, &at, 2.0, i.into()), false).unwrap();
    }
    let found = session.finish().unwrap();
    let k = found.intrinsics;
    assert!((k.fx_px / truth.fx_px - 1.0).abs() < 3e-3, "{found:?}");
    assert!((k.fy_px / truth.fy_px - 1.0).abs() < 3e-3, "{found:?}");
    assert!(
        (k.cx_px - truth.cx_px).abs() < 2.0 && (k.cy_px - truth.cy_px).abs() < 2.0,
        "{found:?}"
    );
    assert!(found.calibration.rms_px < 0.25, "{found:?}");
    assert!(found.calibration.held_out_rms_px < 0.3, "{found:?}");
}
