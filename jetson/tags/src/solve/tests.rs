use super::*;
use crate::layout::CORNERS;
use crate::synth::webcam;
use proptest::prelude::*;

const SIZE_M: f64 = 0.16;

/// A face of a cube of 0.2 m around the vehicle's origin; its printed side points along `normal`.
fn face(normal: DVec3) -> Pose<Body, Square> {
    Pose::new(normal * 0.1, DQuat::from_rotation_arc(DVec3::Z, normal))
}

/// A camera at `from` that looks at `at`, with its x axis level.
fn looking(from: DVec3, at: DVec3) -> Pose<World, Cam> {
    let z = (at - from).normalize();
    let x = z.cross(DVec3::Z).normalize();
    Pose::new(from, DQuat::from_mat3(&glam::DMat3::from_cols(x, z.cross(x), z)))
}

fn seen<'a>(
    camera: &'a Intrinsics,
    sight: Geometry,
    truth: &Pose<World, Body>,
    noise_px: impl FnMut() -> DVec2,
) -> Option<Sighting<'a>> {
    let cam_from_tag = match sight {
        Geometry::OutsideIn { world_from_cam, body_from_tag } => {
            world_from_cam.inverse() * *truth * body_from_tag
        }
        Geometry::InsideOut { body_from_cam, world_from_tag } => {
            body_from_cam.inverse() * truth.inverse() * world_from_tag
        }
    };
    let mut noise_px = noise_px;
    // A tag is invisible from behind.
    let away = cam_from_tag.rotation * DVec3::Z;
    if away.dot(cam_from_tag.translation_m) > -0.2 * cam_from_tag.translation_m.length() {
        return None;
    }
    let mut corners_px = [DVec2::ZERO; 4];
    for (corner, c) in corners_px.iter_mut().zip(CORNERS) {
        let p = cam_from_tag.transform_point((c * SIZE_M).extend(0.0));
        *corner = camera.project(p)? + noise_px();
    }
    Some(Sighting {
        camera,
        sight,
        size_m: SIZE_M,
        corners_px,
        sigma_px: 0.2,
        lag_s: 0.0,
        readout_s: 0.0,
    })
}

fn error(a: &Pose<World, Body>, b: &Pose<World, Body>) -> (f64, f64) {
    (a.translation_m.distance(b.translation_m), a.rotation.angle_between(b.rotation))
}

fn noise(seed: u64, sigma_px: f64) -> impl FnMut() -> DVec2 {
    // xorshift and the sum of twelve uniform values: close to a normal distribution.
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut uniform = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let mut normal = move || (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
    move || DVec2::new(normal(), normal()) * sigma_px
}

const FACES: [DVec3; 5] = [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y, DVec3::Z];

fn cube_seen<'a>(
    camera: &'a Intrinsics,
    cameras: &[Pose<World, Cam>],
    truth: &Pose<World, Body>,
    noise_px: &mut impl FnMut() -> DVec2,
) -> Vec<Sighting<'a>> {
    let mut all = Vec::new();
    for &world_from_cam in cameras {
        for normal in FACES {
            let sight = Geometry::OutsideIn { world_from_cam, body_from_tag: face(normal) };
            all.extend(seen(camera, sight, truth, &mut *noise_px));
        }
    }
    all
}

proptest! {
    #[test]
    fn one_of_the_two_poses_of_a_square_is_true(
        x in -1.0..1.0f64, y in -0.6..0.6f64, z in 0.5..8.0f64,
        axis in prop::array::uniform3(-1.0..1.0f64),
    ) {
        let camera = webcam();
        let towards = DQuat::from_rotation_x(std::f64::consts::PI);
        let tilt = DQuat::from_scaled_axis(DVec3::from(axis) * 0.6);
        let truth: Pose<Cam, Square> = Pose::new(DVec3::new(x * z * 0.6, y * z * 0.5, z), towards * tilt);
        let corners = CORNERS.map(|c| camera.project(truth.transform_point((c * SIZE_M).extend(0.0))));
        prop_assume!(corners.iter().all(Option::is_some));
        let found = plane::poses(&camera, SIZE_M, &corners.map(Option::unwrap));
        prop_assert_eq!(found.len(), 2);
        let nearest = found.iter().map(|pose| pose.rotation.angle_between(truth.rotation)).fold(9.0, f64::min);
        prop_assert!(nearest < 1e-4, "{} rad off, {:?}", nearest, found);
    }

    #[test]
    fn exact_corners_give_the_exact_pose(
        p in prop::array::uniform3(-1.0..1.0f64), yaw in -3.1..3.1f64, tilt in prop::array::uniform2(-0.4..0.4f64),
    ) {
        let camera = webcam();
        let truth = Pose::new(
            DVec3::from(p) * DVec3::new(3.0, 1.5, 0.8) + DVec3::Z * 1.5,
            DQuat::from_rotation_z(yaw) * DQuat::from_scaled_axis(DVec3::new(tilt[0], tilt[1], 0.0)),
        );
        let cameras = [
            looking(DVec3::new(-5.2, 2.0, 3.3), DVec3::new(0.0, 0.0, 1.2)),
            looking(DVec3::new(5.2, -2.0, 3.3), DVec3::new(0.0, 0.0, 1.2)),
        ];
        let all = cube_seen(&camera, &cameras, &truth, &mut || DVec2::ZERO);
        prop_assume!(all.len() > 1);
        let solved = solve(&all, &VehicleTwist::default(), None).unwrap();
        let (off_m, off_rad) = error(&solved.best.world_from_body, &truth);
        prop_assert!(off_m < 1e-6 && off_rad < 1e-6, "{} m, {} rad", off_m, off_rad);
    }

    #[test]
    fn invalid_corners_give_no_pose_or_a_valid_one(
        corners in prop::array::uniform8(prop_oneof![Just(f64::NAN), Just(f64::INFINITY), -1e9..1e9f64, 0.0..1280.0f64]),
    ) {
        let camera = webcam();
        let [a, b, c, d, e, f, g, h] = corners;
        let corners_px = [DVec2::new(a, b), DVec2::new(c, d), DVec2::new(e, f), DVec2::new(g, h)];
        let sight = Geometry::OutsideIn { world_from_cam: Pose::IDENTITY, body_from_tag: Pose::IDENTITY };
        let sighting = Sighting { camera: &camera, sight, size_m: SIZE_M, corners_px, sigma_px: 0.2, lag_s: 0.0, readout_s: 0.0 };
        if let Some(solved) = solve(&[sighting], &VehicleTwist::default(), None) {
            prop_assert!(solved.best.world_from_body.is_valid());
            prop_assert!(solved.best.covariance.iter().flatten().all(|v| v.is_finite()));
        }
    }
}

#[test]
fn inside_out_estimates_the_same_pose() {
    let camera = webcam();
    let truth = Pose::new(
        DVec3::new(0.3, -0.2, 1.1),
        DQuat::from_euler(glam::EulerRot::ZYX, 0.7, 0.1, -0.08),
    );
    // The camera looks straight down; the top of the image points to the nose.
    let body_from_cam = Pose::new(
        DVec3::new(0.05, 0.0, -0.03),
        DQuat::from_mat3(&glam::DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_X, DVec3::NEG_Z)),
    );
    let mut all = Vec::new();
    let mut noise_px = noise(3, 0.1);
    for (x, y) in [(0.0, 0.0), (0.3, 0.0), (0.3, -0.3), (0.6, -0.3)] {
        let world_from_tag = Pose::new(DVec3::new(x, y, 0.0), DQuat::from_rotation_z(x));
        let sight = Geometry::InsideOut { body_from_cam, world_from_tag };
        all.extend(seen(&camera, sight, &truth, &mut noise_px));
    }
    assert!(all.len() >= 3, "{} tags are in the picture", all.len());
    let solved = solve(&all, &VehicleTwist::default(), None).unwrap();
    let (off_m, off_rad) = error(&solved.best.world_from_body, &truth);
    assert!(off_m < 0.004 && off_rad < 0.004, "{off_m} m, {off_rad} rad");
    assert!(solved.other.is_none());
}

#[test]
fn covariance_matches_the_actual_errors() {
    let camera = webcam();
    let cameras = [
        looking(DVec3::new(-5.2, 2.0, 3.3), DVec3::new(0.0, 0.0, 1.2)),
        looking(DVec3::new(5.2, -2.0, 3.3), DVec3::new(0.0, 0.0, 1.2)),
    ];
    let truth = Pose::new(
        DVec3::new(1.0, 0.4, 1.5),
        DQuat::from_euler(glam::EulerRot::ZYX, 0.4, 0.1, 0.05),
    );
    let mut noise_px = noise(11, 0.2);
    let (mut sum, n) = (0.0, 300);
    for _ in 0..n {
        let all = cube_seen(&camera, &cameras, &truth, &mut noise_px);
        let fit = solve(&all, &VehicleTwist::default(), None).unwrap().best;
        let p = fit.world_from_body.translation_m - truth.translation_m;
        let turn = truth.rotation.conjugate() * fit.world_from_body.rotation;
        let turn = (turn * turn.w.signum()).to_scaled_axis();
        let (sigma_m, sigma_rad) = fit.sigmas();
        sum += (p / sigma_m).length_squared() + (turn / sigma_rad).length_squared();
    }
    // Expected: six squares of one sigma each; slightly less, because sigma only grows with the scatter.
    let mean = sum / f64::from(n);
    assert!((3.0..7.5).contains(&mean), "{mean} squared sigmas of 6");
}

#[test]
fn keeps_both_poses_of_a_far_square_seen_from_the_front() {
    let camera = webcam();
    let truth = Pose::new(DVec3::new(6.0, 0.0, 0.0), DQuat::from_rotation_y(0.12));
    let world_from_cam = looking(DVec3::ZERO, DVec3::X);
    let sight = Geometry::OutsideIn { world_from_cam, body_from_tag: face(DVec3::NEG_X) };
    let both = (0..50).filter(|&seed| {
        let one = seen(&camera, sight, &truth, noise(seed + 1, 0.1)).unwrap();
        let solved = solve(&[one], &VehicleTwist::default(), None).unwrap();
        let Some(other) = solved.other else { return false };
        let nearest = [solved.best, other]
            .map(|fit| error(&fit.world_from_body, &truth).1)
            .into_iter()
            .fold(9.0, f64::min);
        nearest < 0.2
    });
    let both = both.count();
    assert!(both > 25, "{both} of 50 keep both");
}

#[test]
fn a_misread_corner_has_little_influence() {
    let camera = webcam();
    let cameras = [looking(DVec3::new(-4.0, 1.5, 3.0), DVec3::new(0.0, 0.0, 1.2))];
    let truth = Pose::new(DVec3::new(0.0, 0.0, 1.5), DQuat::from_rotation_z(0.5));
    let mut all = cube_seen(&camera, &cameras, &truth, &mut noise(5, 0.1));
    assert!(all.len() >= 3);
    // One corner is covered by a cable: 6 pixels off.
    all[0].corners_px[2] += DVec2::new(5.0, -3.0);
    let solved = solve(&all, &VehicleTwist::default(), None).unwrap();
    let (off_m, off_rad) = error(&solved.best.world_from_body, &truth);
    assert!(off_m < 0.02 && off_rad < 0.03, "{off_m} m, {off_rad} rad");
}

#[test]
fn combines_images_of_different_exposure_times() {
    let camera = webcam();
    let cameras = [
        looking(DVec3::new(-5.2, 2.0, 3.3), DVec3::new(0.0, 0.0, 1.2)),
        looking(DVec3::new(5.2, -2.0, 3.3), DVec3::new(0.0, 0.0, 1.2)),
    ];
    let motion = VehicleTwist {
        a_world_mps2: DVec3::ZERO,
        v_world_mps: DVec3::new(2.0, -1.0, 0.3),
        omega_body_radps: DVec3::new(0.1, 0.2, 1.0),
    };
    let truth = Pose::new(DVec3::new(0.5, 0.2, 1.5), DQuat::from_rotation_z(0.5));
    let before = motion.carry(&truth, -0.016);
    let mut exact = || DVec2::ZERO;
    let mut all = cube_seen(&camera, &cameras[..1], &truth, &mut exact);
    let mut earlier = cube_seen(&camera, &cameras[1..], &before, &mut exact);
    for sighting in &mut earlier {
        sighting.lag_s = 0.016;
    }
    all.extend(earlier);
    let solved = solve(&all, &motion, None).unwrap();
    let (off_m, off_rad) = error(&solved.best.world_from_body, &truth);
    assert!(off_m < 1e-6 && off_rad < 1e-6, "{off_m} m, {off_rad} rad");
    let still = solve(&all, &VehicleTwist::default(), None).unwrap();
    assert!(error(&still.best.world_from_body, &truth).0 > 0.005);
}
