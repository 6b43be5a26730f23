use vizflyt_sdk::protocol::messages::bounded;
use vizflyt_sdk::protocol::time::ServerTime;
use vizflyt_sdk::{
    CameraInfo, HostTime, ImageStamps, Intrinsics, Limits, ObservationBuffer, Volume,
};

use super::*;

fn arena() -> ArenaInfo {
    let intrinsics = Intrinsics::from_horizontal_fov(64, 48, 90_f64.to_radians());
    let front = CameraInfo::forward("front", intrinsics);
    let geofence = Volume::Sphere { center_m: DVec3::ZERO, radius_m: 60.0 };
    ArenaInfo {
        body_radius_m: 0.12,
        takeoff_height_m: 1.2,
        ground_truth: false,
        cameras: [front].into_iter().collect(),
        ..ArenaInfo::new("test", geofence, Limits::new(4.0, 6.0))
    }
}

/// Passes one observation with a floor 1 m below and a wall 6.4 m ahead.
fn see(plugin: &mut Race, ms: u64, attitude: DQuat) -> Option<Setpoint> {
    see_at(plugin, ms, attitude, 32_000.0)
}

/// As [`see`], with scaled distances of floor and wall; 0 means no depth.
fn see_at(plugin: &mut Race, ms: u64, attitude: DQuat, far_mm: f64) -> Option<Setpoint> {
    let arena = arena();
    let mut buffer = ObservationBuffer::new(&arena.cameras);
    let stamp = HostTime::from_ns(ms * 1_000_000);
    buffer.set_vehicle(&Vehicle {
        stamp,
        attitude,
        omega_body_radps: DVec3::ZERO,
        world_from_body: None,
        v_world_mps: None,
    });
    let stamps = ImageStamps { seq: ms, pose: stamp, ready: stamp, ahead_ns: 0 };
    buffer.set_image(0, stamps, |planes| {
        planes.rgb.fill(120);
        for (at, depth_mm) in planes.depth_mm.iter_mut().enumerate() {
            let slope = (at / 64) as f64 + 0.5 - 24.0;
            *depth_mm = (far_mm / slope.max(5.0)) as u16;
        }
    });
    plugin.on_image(&buffer.observation())
}

#[test]
fn stays_and_looks_around_without_an_obstacle() {
    let mut plugin = Race::default();
    plugin.on_start(&arena());
    let mut looks_rad = Vec::new();
    for step in 0..150 {
        match see(&mut plugin, 1000 + 40 * step, DQuat::IDENTITY) {
            Some(Setpoint::Velocity { v_mps, yaw: YawTarget::Angle(yaw_rad), .. }) => {
                assert!(v_mps.length() < 0.05, "{v_mps}");
                looks_rad.push(yaw_rad);
            }
            other => panic!("expected a velocity with a heading, got {other:?}"),
        }
    }
    let most = looks_rad.iter().fold(0.0_f64, |most, look| most.max(*look));
    let least = looks_rad.iter().fold(0.0_f64, |least, look| least.min(*look));
    assert!(most > 0.8 && least < -0.8, "looks only from {least} to {most} rad");
}

#[test]
fn fails_on_the_ground_with_a_reason_if_there_is_no_depth() {
    let mut plugin = Race::default();
    plugin.on_start(&arena());
    for step in 0..u64::from(PATIENCE) - 1 {
        assert_eq!(see_at(&mut plugin, 1000 + 40 * step, DQuat::IDENTITY, 0.0), None);
    }
    let mut other = plugin.clone();
    let ends = std::panic::catch_unwind(move || see_at(&mut other, 9000, DQuat::IDENTITY, 0.0));
    let sentence = ends.unwrap_err();
    let sentence = sentence.downcast_ref::<&str>().expect("a sentence");
    assert!(sentence.contains("only colour (g)") && sentence.contains("--level ug"), "{sentence}");
    // If the camera is uncovered in time, the plugin flies; later the camera may be covered for any time.
    assert!(see(&mut plugin, 9000, DQuat::IDENTITY).is_some());
    for step in 0..u64::from(2 * PATIENCE) {
        assert!(see_at(&mut plugin, 9040 + 40 * step, DQuat::IDENTITY, 0.0).is_some());
    }
}

#[test]
fn replies_once_to_each_image() {
    let mut plugin = Race::default();
    plugin.on_start(&arena());
    assert!(see(&mut plugin, 1000, DQuat::IDENTITY).is_some());
    assert_eq!(see(&mut plugin, 1000, DQuat::IDENTITY), None);
    assert!(see(&mut plugin, 1040, DQuat::IDENTITY).is_some());
}

#[test]
fn holds_after_the_finish_and_ignores_an_invalid_attitude() {
    let mut plugin = Race::default();
    plugin.on_start(&arena());
    assert_eq!(see(&mut plugin, 1000, DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0)), None);
    assert_eq!(see(&mut plugin, 1010, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0)), None);
    plugin.on_event(&Event {
        stamp: ServerTime::ZERO,
        kind: EventKind::Finished { seconds: 9.0 },
        text: bounded("finished"),
    });
    assert_eq!(see(&mut plugin, 1040, DQuat::IDENTITY), Some(Setpoint::Hold));
}
