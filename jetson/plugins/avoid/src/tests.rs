use vizflyt_sdk::protocol::messages::bounded;
use vizflyt_sdk::{CameraInfo, ImageStamps, Intrinsics, Limits, ObservationBuffer, Volume};

use super::*;

fn arena(goal_m: Option<DVec3>) -> ArenaInfo {
    let intrinsics = Intrinsics::from_horizontal_fov(64, 48, 90_f64.to_radians());
    let front = CameraInfo::forward("front", intrinsics);
    let geofence = Volume::Sphere { center_m: DVec3::ZERO, radius_m: 60.0 };
    ArenaInfo {
        body_radius_m: 0.12,
        takeoff_height_m: 1.2,
        goal_m,
        cameras: [front].into_iter().collect(),
        ..ArenaInfo::new("test", geofence, Limits::new(6.0, 8.0))
    }
}

const GOAL_M: DVec3 = DVec3::new(30.0, 0.0, 1.2);

fn vehicle(p_m: DVec3, ms: u64) -> Vehicle {
    Vehicle {
        stamp: HostTime::from_ns(ms * 1_000_000),
        attitude: DQuat::IDENTITY,
        omega_body_radps: DVec3::ZERO,
        world_from_body: Some(Pose::new(p_m, DQuat::IDENTITY)),
        v_world_mps: Some(DVec3::ZERO),
    }
}

/// Passes one observation with a depth of `depth_mm` in all pixels.
fn see(plugin: &mut Avoid, vehicle: Option<Vehicle>, depth_mm: u16) -> Option<Setpoint> {
    let mut buffer = ObservationBuffer::new(&arena(None).cameras);
    let stamp = vehicle.map_or(HostTime::ZERO, |vehicle| vehicle.stamp);
    if let Some(vehicle) = vehicle {
        buffer.set_vehicle(&vehicle);
    }
    let stamps = ImageStamps { seq: 1, pose: stamp, ready: stamp, ahead_ns: 0 };
    buffer.set_image(0, stamps, |planes| planes.depth_mm.fill(depth_mm));
    plugin.on_image(&buffer.observation())
}

fn started(goal_m: Option<DVec3>) -> Avoid {
    let mut plugin = Avoid::default();
    plugin.on_start(&arena(goal_m));
    plugin
}

/// Returns velocity and heading after 1 s of images with a depth of `depth_mm`. [m/s, rad, world]
fn after_a_second(plugin: &mut Avoid, from_ms: u64, depth_mm: u16) -> (DVec3, f64) {
    let mut last = None;
    for ms in (from_ms..=from_ms + 1000).step_by(20) {
        last = see(plugin, Some(vehicle(DVec3::new(0.0, 0.0, 1.0), ms)), depth_mm);
    }
    match last {
        Some(Setpoint::Velocity { v_mps, yaw: YawTarget::Angle(yaw_rad), .. }) => (v_mps, yaw_rad),
        other => panic!("expected a velocity with a heading, got {other:?}"),
    }
}

#[test]
fn flies_and_looks_towards_the_goal() {
    let (v_mps, yaw_rad) = after_a_second(&mut started(Some(GOAL_M)), 1000, 20_000);
    assert!(v_mps.x > 1.0 && v_mps.y.abs() < 0.1 && yaw_rad.abs() < 0.05, "{v_mps} {yaw_rad}");
    assert!((v_mps.z - CLIMB_PER_S * 0.2).abs() < 1e-9, "climbs to the goal's height");
}

#[test]
fn stops_without_returns_and_continues_with_them() {
    let mut plugin = started(Some(GOAL_M));
    after_a_second(&mut plugin, 1000, 20_000);
    let (v_mps, _) = after_a_second(&mut plugin, 2020, 0);
    assert!(v_mps.truncate().length() < 0.05, "{v_mps}");
    let (v_mps, _) = after_a_second(&mut plugin, 3040, 20_000);
    assert!(v_mps.x > 1.0, "{v_mps}");
}

#[test]
fn holds_at_the_goal() {
    let p_m = GOAL_M + DVec3::new(0.2, 0.1, 0.0);
    let answer = see(&mut started(Some(GOAL_M)), Some(vehicle(p_m, 1000)), 20_000);
    assert!(matches!(answer, Some(Setpoint::Position { p_world_m: GOAL_M, .. })), "{answer:?}");
}

#[test]
fn holds_without_a_goal_and_after_the_finish() {
    let here = Some(vehicle(DVec3::Z, 1000));
    assert_eq!(see(&mut started(None), here, 20_000), Some(Setpoint::Hold));
    let mut plugin = started(Some(GOAL_M));
    plugin.on_event(&Event {
        stamp: vizflyt_sdk::protocol::time::ServerTime::ZERO,
        kind: EventKind::Finished { seconds: 9.0 },
        text: bounded("finished"),
    });
    assert_eq!(see(&mut plugin, here, 20_000), Some(Setpoint::Hold));
}

#[test]
fn returns_nothing_without_a_valid_pose() {
    let mut plugin = started(Some(GOAL_M));
    assert_eq!(see(&mut plugin, None, 20_000), None);
    let lost = vehicle(DVec3::new(f64::NAN, 0.0, 0.0), 1000);
    assert_eq!(see(&mut plugin, Some(lost), 20_000), None);
}

/// An image that is rendered ahead of a late vehicle state shows obstacles from the image's pose. With the state
/// extrapolated over 0.25 s of a turn at 2 rad/s, the error of a trunk 4 m ahead would be 2 m.
#[test]
fn places_obstacles_by_the_pose_of_the_image() {
    let turning = Vehicle { omega_body_radps: DVec3::Z * 2.0, ..vehicle(DVec3::Z, 1000) };
    let rendered_from = Pose::new(DVec3::new(0.4, -0.1, 1.0), DQuat::IDENTITY);
    let shown = HostTime::from_ns(1_250_000_000);
    let mut buffer = ObservationBuffer::new(&arena(None).cameras);
    buffer.set_vehicle(&turning);
    let stamps = ImageStamps { seq: 1, pose: shown, ready: shown, ahead_ns: 0 };
    buffer.set_image(0, stamps, |planes| planes.depth_mm.fill(4000));
    let place = |buffer: &ObservationBuffer| {
        let observation = buffer.observation();
        let located = Located::of(&observation.vehicle().unwrap()).unwrap();
        view_of(&located, &observation.camera("front").unwrap()).world_from_cam
    };
    // Without a pose in the image, the vehicle's state is extrapolated.
    let ahead = place(&buffer).rotate(DVec3::Z);
    assert!((ahead.y.atan2(ahead.x) - 0.5).abs() < 1e-9, "{ahead}");
    buffer.set_pose_at_image(0, &rendered_from);
    let mount = arena(None).cameras[0].body_from_cam;
    let expected = rendered_from * mount;
    let found = place(&buffer);
    assert!(found.translation_m.distance(expected.translation_m) < 1e-6, "{found:?}");
    assert!(found.rotation.angle_between(expected.rotation) < 1e-6, "{found:?}");
}
