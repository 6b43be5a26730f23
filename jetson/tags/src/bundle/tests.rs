use super::*;
use crate::synth::Random;
use vizflyt_protocol::geometry::Distortion;

fn rigid(random: &mut Random, position_m: f64, turn_rad: f64) -> Rigid {
    let mut vector = || DVec3::new(random.normal(), random.normal(), random.normal());
    Rigid { t_m: vector() * position_m, q: DQuat::from_scaled_axis(vector() * turn_rad) }
}

/// Cameras that look down at tags on the floor, with `noise_px` on the corners.
fn floor(noise_px: f64) -> (Bundle, Bundle) {
    let mut random = Random::new(5);
    let lens = Intrinsics {
        distortion: Distortion::BrownConrady { k1: -0.1, k2: 0.02, p1: 0.0, p2: 0.001, k3: 0.0 },
        ..Intrinsics::from_horizontal_fov(1280, 720, 1.2)
    };
    let mut truth = Bundle { lenses: vec![(lens, false)], loss_px: 2.0, ..Bundle::default() };
    let tags: Vec<usize> = (0..9)
        .map(|i| {
            let t_m = DVec3::new(f64::from(i % 3) * 0.3, f64::from(i / 3) * 0.3, 0.0);
            let role = if i == 0 { Parameter::Fixed } else { Parameter::Shared };
            truth.pose(Rigid { t_m, q: DQuat::from_rotation_z(f64::from(i)) }, role)
        })
        .collect();
    for _ in 0..12 {
        let shake = rigid(&mut random, 0.1, 0.25);
        let down = Rigid {
            t_m: DVec3::new(-0.3, 0.3, 1.2),
            q: DQuat::from_rotation_x(std::f64::consts::PI),
        };
        let view =
            truth.pose(Rigid { t_m: down.t_m + shake.t_m, q: shake.q * down.q }, Parameter::View);
        for &tag in &tags {
            for corner in crate::layout::CORNERS {
                let mut seen = CornerObservation {
                    lens: 0,
                    left: view,
                    right: tag,
                    point_m: (corner * 0.16).extend(0.0),
                    pixel: DVec2::ZERO,
                };
                let exact = truth.residual(&seen).unwrap();
                seen.pixel = exact + DVec2::new(random.normal(), random.normal()) * noise_px;
                truth.seen.push(seen);
            }
        }
    }
    let mut start = truth.clone();
    for (pose, role) in &mut start.poses {
        if *role != Parameter::Fixed {
            let off = rigid(&mut random, 0.03, 0.05);
            *pose = Rigid { t_m: pose.t_m + off.t_m, q: pose.q * off.q };
        }
    }
    (truth, start)
}

#[test]
fn exact_corners_give_the_true_poses() {
    let (truth, mut start) = floor(0.0);
    let solution = start.solve().unwrap();
    assert!(solution.rms_px < 1e-5, "{}", solution.rms_px);
    for (found, expected) in start.poses.iter().zip(&truth.poses) {
        assert!((found.0.t_m - expected.0.t_m).length() < 1e-6);
        assert!(found.0.q.angle_between(expected.0.q) < 1e-5);
    }
}

#[test]
fn the_reported_covariance_matches_the_error() {
    let (truth, mut start) = floor(0.3);
    let solution = start.solve().unwrap();
    // 0.3 px on each of two axes, minus the share absorbed by the parameters.
    assert!((0.3..0.45).contains(&solution.rms_px), "{}", solution.rms_px);
    let mut square = 0.0;
    let mut count = 0.0;
    for (i, (pose, role)) in start.poses.iter().enumerate() {
        if *role == Parameter::Shared {
            let z = (pose.t_m - truth.poses[i].0.t_m) / solution.position_sigma_m(i);
            square += z.length_squared();
            count += 3.0;
        }
    }
    let ratio: f64 = square / count;
    assert!((0.3..2.5).contains(&ratio), "errors are {} of the predicted", ratio.sqrt());
}

#[test]
fn a_misread_tag_has_little_influence() {
    let (truth, mut start) = floor(0.05);
    for seen in &mut start.seen[40..44] {
        seen.pixel += DVec2::new(60.0, -25.0);
    }
    start.solve().unwrap();
    for (found, expected) in start.poses.iter().zip(&truth.poses) {
        assert!((found.0.t_m - expected.0.t_m).length() < 1e-3);
    }
}

#[test]
fn rejects_a_problem_with_an_unseen_tag() {
    let (_, mut start) = floor(0.1);
    start.pose(Rigid::IDENTITY, Parameter::Shared);
    assert!(start.solve().is_none());
}
