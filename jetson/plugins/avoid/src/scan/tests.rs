use proptest::prelude::*;
use vizflyt_sdk::Body;
use vizflyt_sdk::glam::{DQuat, DVec2};
use vizflyt_sdk::protocol::geometry::body_from_forward_cam;

use super::*;

const FLIGHT_Z_M: f64 = 1.2;

fn camera(pitch_rad: f64, roll_rad: f64) -> Pose<World, Cam> {
    let tilt = DQuat::from_rotation_y(pitch_rad) * DQuat::from_rotation_x(roll_rad);
    let world_from_body: Pose<World, Body> = Pose::new(DVec3::new(0.0, 0.0, FLIGHT_Z_M), tilt);
    world_from_body * body_from_forward_cam(DVec3::ZERO, 0.0)
}

fn intrinsics() -> Intrinsics {
    Intrinsics::from_horizontal_fov(320, 240, 90_f64.to_radians())
}

/// Draws the floor z = 0 and a vertical trunk at `trunk_m` with a radius of 0.2 m; sky is 0.
fn picture(world_from_cam: &Pose<World, Cam>, trunk_m: Option<DVec2>) -> Vec<u16> {
    let k = intrinsics();
    let origin = world_from_cam.translation_m;
    let mut depth_mm = Vec::with_capacity(k.pixels());
    for y in 0..k.height_px {
        for x in 0..k.width_px {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let ray = world_from_cam.rotate(k.unproject(pixel, 1.0).unwrap());
            let floor_m = if ray.z < 0.0 { -origin.z / ray.z } else { f64::INFINITY };
            let bark_m = trunk_m.map_or(f64::INFINITY, |trunk_m| {
                let (d, w) = (ray.truncate(), origin.truncate() - trunk_m);
                let (a, b, c) = (d.length_squared(), w.dot(d), w.length_squared() - 0.04);
                let root = b * b - a * c;
                if root < 0.0 || b > 0.0 { f64::INFINITY } else { (-b - root.sqrt()) / a }
            });
            let depth_m = floor_m.min(bark_m);
            depth_mm.push(if depth_m < 60.0 { (depth_m * 1000.0) as u16 } else { 0 });
        }
    }
    depth_mm
}

fn scan(depth_mm: &[u16], world_from_cam: Pose<World, Cam>) -> Scan {
    let mut scan = Scan::default();
    scan.update(&View { depth_mm, intrinsics: intrinsics(), world_from_cam }, FLIGHT_Z_M);
    scan
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn floor_is_not_an_obstacle_at_any_tilt(pitch in -0.6..0.6f64, roll in -0.5..0.5f64) {
        let world_from_cam = camera(pitch, roll);
        let found = scan(&picture(&world_from_cam, None), world_from_cam);
        prop_assert!(found.points_m.is_empty(), "{:?}", found.points_m);
    }

    #[test]
    fn finds_a_trunk_at_its_position(
        pitch in -0.4..0.4f64, roll in -0.3..0.3f64, x in 1.0..9.0f64, slope in -0.5..0.5f64,
    ) {
        let trunk_m = DVec2::new(x, slope * x);
        // Trunks beyond the maximum range are ignored.
        prop_assume!(trunk_m.length() < f64::from(FAR_M));
        let world_from_cam = camera(pitch, roll);
        let found = scan(&picture(&world_from_cam, Some(trunk_m)), world_from_cam);
        prop_assert!(!found.points_m.is_empty());
        for point_m in found.points_m {
            let off_m = (point_m.truncate().distance(trunk_m) - 0.2).abs();
            prop_assert!(off_m < 0.06, "{point_m} is {off_m} m off the bark");
        }
    }

    #[test]
    fn any_pixels_give_finite_points(depth_mm in prop::collection::vec(any::<u16>(), 64 * 48)) {
        let k = Intrinsics::from_horizontal_fov(64, 48, 1.5);
        let view = View { depth_mm: &depth_mm, intrinsics: k, world_from_cam: camera(0.1, 0.0) };
        let mut found = Scan::default();
        found.update(&view, FLIGHT_Z_M);
        prop_assert!(found.points_m.len() <= COLUMNS);
        prop_assert!(found.points_m.iter().all(|p| p.is_finite()));
    }
}

#[test]
fn image_without_returns_is_blind() {
    let found = scan(&vec![0; intrinsics().pixels()], camera(0.0, 0.0));
    assert!(found.is_blind() && found.points_m.is_empty());
    assert!(!scan(&picture(&camera(-0.4, 0.0), None), camera(-0.4, 0.0)).is_blind());
}

#[test]
fn speckle_is_not_an_obstacle() {
    let mut depth_mm = picture(&camera(0.0, 0.0), None);
    for strip in 0..COLUMNS {
        depth_mm[120 * 320 + 4 * strip] = 1500;
    }
    assert!(scan(&depth_mm, camera(0.0, 0.0)).points_m.is_empty());
}

#[test]
fn too_short_buffer_is_blind() {
    assert!(scan(&[1000; 7], camera(0.0, 0.0)).is_blind());
}

#[test]
fn only_returns_prove_free_space() {
    let k = intrinsics();
    let world_from_cam = camera(0.0, 0.0);
    let at_m = DVec3::new(3.0, 0.2, 1.2);
    let sees_through = |depth_mm: u16| {
        let depth_mm = vec![depth_mm; k.pixels()];
        View { depth_mm: &depth_mm, intrinsics: k, world_from_cam }.sees_through(at_m)
    };
    assert!(sees_through(8000));
    assert!(!sees_through(3000) && !sees_through(1000) && !sees_through(0));
    let depth_mm = vec![8000; k.pixels()];
    let view = View { depth_mm: &depth_mm, intrinsics: k, world_from_cam };
    assert!(!view.sees_through(DVec3::new(-3.0, 0.0, 1.2)), "behind the camera");
    assert!(!view.sees_through(DVec3::new(1.0, 3.0, 1.2)), "beside the image");
}
