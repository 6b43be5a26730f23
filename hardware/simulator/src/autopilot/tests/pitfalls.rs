//! Pitfalls of a real ArduCopter 4.8 without GPS and compass, one test for each. The figures are those of the real one.

use super::*;
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_protocol::mavlink::dialect::{
    MavFrame, PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA,
};

fn config(params: &[(&str, f32)]) -> SimulationConfig {
    let params = params.iter().map(|&(name, value)| (name.to_owned(), value)).collect();
    SimulationConfig { params, ..Default::default() }
}

impl Companion {
    /// Sends a setpoint with explicit fields: mask, frame, position, velocity, acceleration, yaw [NED].
    fn raw(&mut self, mask: u16, frame: MavFrame, p: [f32; 3], v: [f32; 3], a: [f32; 3], yaw: f32) {
        self.send(&MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
            type_mask: PositionTargetTypemask::from_bits_retain(mask),
            coordinate_frame: frame,
            target_system: 1,
            target_component: 1,
            x: p[0],
            y: p[1],
            z: p[2],
            vx: v[0],
            vy: v[1],
            vz: v[2],
            afx: a[0],
            afy: a[1],
            afz: a[2],
            yaw,
            ..Default::default()
        }));
    }

    fn yaw(&self) -> f64 {
        yaw_of(self.lab.state().world_from_body)
    }
}

const LOCAL: MavFrame = MavFrame::MAV_FRAME_LOCAL_NED;
const NONE: [f32; 3] = [0.0; 3];

/// Pitfall 1: no origin, see `without_an_origin_arms_but_refuses_take_off`. The alternative is an origin recorded in
/// the parameters.
#[test]
fn p1_uses_a_recorded_origin() {
    let recorded =
        [("AHRS_OPTIONS", 16.0), ("AHRS_ORIGIN_LAT", 42.25), ("AHRS_ORIGIN_LON", -71.75)];
    let mut c = Companion::new(config(&recorded));
    c.until(8.0, "a position", |c| c.lab.autopilot().estimator().health(c.lab.now()).position);
    c.command(MavCmd::MAV_CMD_REQUEST_MESSAGE, [49.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let Some(MavMessage::GPS_GLOBAL_ORIGIN(m)) = c.newest.get(&49) else { panic!("no origin") };
    assert_eq!((m.latitude, m.longitude), (422_500_000, -717_500_000));
    c.set_mode(CopterMode::Guided);
    assert_eq!((c.arm(), c.take_off(1.0)), (ACCEPTED, ACCEPTED));
    // Without the option, the recorded origin is ignored.
    let mut c = Companion::new(config(&recorded[1..]));
    c.wait(8.0);
    assert!(!c.lab.autopilot().estimator().health(c.lab.now()).origin);
}

/// Pitfall 2: height datum, see `resets_the_height_datum_once`. Vision that begins after the text, or at z = 0, is not
/// changed.
#[test]
fn p2_vision_after_the_datum_reset_keeps_its_height() {
    let mut c = Companion::new(SimulationConfig::default());
    c.prepare();
    c.until(5.0, "the text", |c| c.texts_contain("Field Elevation Set"));
    c.vision_shift = (DVec3::Z * 0.59, 1);
    c.wait(2.0);
    let z = c.lab.autopilot().estimator().estimate().p_world_m.z;
    assert!((z - 0.59).abs() < 0.03, "{z}");
    assert_eq!(c.texts.iter().filter(|text| text.contains("Field Elevation")).count(), 1);
}

/// Pitfall 3: masks. Common masks are accepted; one ignored axis drops its group; position and acceleration without
/// velocity hold.
#[test]
fn p3_unsupported_masks_hold() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    let north = [1.0, 0.0, -1.2];
    let goes = |c: &mut Companion, mask: u16, p: [f32; 3], v: [f32; 3]| {
        c.set_once(GuidedMotion::Position(DVec3::new(0.0, 0.0, 1.2)), YawTarget::Angle(0.0));
        c.until(20.0, "the start", |c| c.p().truncate().length() < 0.1 && c.v().length() < 0.05);
        c.raw(mask, LOCAL, p, v, NONE, 0.0);
        c.wait(1.5);
        c.p().y > 0.3
    };
    for mask in [0xDF8, 0x9F8] {
        assert!(goes(&mut c, mask, north, NONE), "{mask:#x}");
    }
    for mask in [0x9C7, 0x5C7] {
        assert!(goes(&mut c, mask, NONE, [0.6, 0.0, 0.0]), "{mask:#x}");
    }
    assert!(goes(&mut c, 0x9C0, [0.0, 0.0, -1.2], [0.6, 0.0, 0.0]));
    // One axis of the group is ignored, so no motion is left.
    assert!(!goes(&mut c, 0x9F8 | 1, north, NONE));
    assert!(!goes(&mut c, 0x9C7 | 0x20, NONE, [0.6, 0.0, 0.0]));
    // Position and acceleration with ignored velocity: hold, also in full flight.
    assert!(!goes(&mut c, 0x838, north, NONE));
    c.raw(0x9C7, LOCAL, NONE, [1.0, 0.0, 0.0], NONE, 0.0);
    c.wait(1.5);
    assert!(c.v().length() > 0.8);
    c.raw(0x838, LOCAL, north, NONE, NONE, 0.0);
    c.wait(2.0);
    assert!(c.v().length() < 0.1, "{:?}", c.v());
}

/// Frames other than LOCAL_NED, as ground stations use them: offsets and body axes are supported, other frames are
/// ignored.
#[test]
fn p3_supports_offset_and_body_frames() {
    let spawn_yaw_rad = 0.5;
    let mut c = Companion::hovering(SimulationConfig { spawn_yaw_rad, ..Default::default() }, 1.2);
    let ahead = DVec3::new(spawn_yaw_rad.cos(), spawn_yaw_rad.sin(), 0.0);
    // One metre ahead; a zero yaw rate holds the yaw.
    c.raw(0x5F8, MavFrame::MAV_FRAME_BODY_NED, [1.0, 0.0, 0.0], NONE, NONE, 0.0);
    c.wait(6.0);
    assert!((c.p() - ahead - DVec3::Z * 1.2).length() < 0.12, "{:?}", c.p());
    // Half a metre east of there, and up.
    c.raw(0x5F8, MavFrame::MAV_FRAME_LOCAL_OFFSET_NED, [0.0, 0.5, -0.3], NONE, NONE, 0.0);
    c.wait(6.0);
    let expected = ahead + DVec3::new(0.5, 0.0, 1.5);
    assert!((c.p() - expected).length() < 0.12, "{:?} {expected}", c.p());
    c.raw(0x5F8, MavFrame::MAV_FRAME_GLOBAL, [9.0, 9.0, -9.0], NONE, NONE, 0.0);
    c.wait(3.0);
    assert!((c.p() - expected).length() < 0.12, "{:?}", c.p());
}

/// Pitfall 4: with ignored yaw, the nose turned by 180 degrees into the direction of travel, above 5 % of WP_SPD.
#[test]
fn p4_ignored_yaw_follows_travel_above_a_twentieth_of_the_speed() {
    let turned = |speed: f32| {
        let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
        // Fly west, with the nose to the east.
        for _ in 0..40 {
            c.raw(0xDC7, LOCAL, NONE, [0.0, -speed, 0.0], NONE, 0.0);
            c.wait(0.1);
        }
        wrap_pi(c.yaw()).abs()
    };
    assert!(turned(1.0) > 3.0);
    assert!(turned(0.04) < 0.1, "below 5 cm/s the yaw stays");
}

/// Pitfall 5: GUID_TIMEOUT is a parameter; it does not apply to positions.
#[test]
fn p5_the_setpoint_timeout_is_a_parameter() {
    let mut c = Companion::hovering(config(&[("GUID_TIMEOUT", 1.0)]), 1.2);
    let start = c.p();
    c.raw(0x9C7, LOCAL, NONE, [0.5, 0.0, 0.0], NONE, 0.0);
    c.wait(3.0);
    let way = (c.p() - start).length();
    assert!((0.3..0.8).contains(&way) && c.v().length() < 0.1, "{way}");
}

/// Pitfall 6: lost vision, see `detects_lost_vision_after_seven_seconds_and_lands`. Nothing is reported before that.
#[test]
fn p6_does_not_report_lost_vision_for_seven_seconds() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    c.vision = false;
    c.texts.clear();
    c.wait(6.9);
    assert_eq!((c.texts.len(), c.mode()), (0, CopterMode::Guided), "{:?}", c.texts);
}

/// Pitfall 7: only heartbeats of MAV_GCS_SYSID count.
#[test]
fn p7_ignores_heartbeats_of_other_systems() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    c.system_id = 42;
    let seconds = c.until(8.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!((4.0..6.1).contains(&seconds), "{seconds}");
    // With the system ID configured, the heartbeats count.
    let mut c = Companion::new(config(&[("MAV_GCS_SYSID", 42.0)]));
    c.system_id = 42;
    c.prepare();
    c.set_mode(CopterMode::Guided);
    c.arm();
    c.take_off(1.0);
    c.wait(10.0);
    assert_eq!(c.mode(), CopterMode::Guided);
}

/// Pitfall 8: no radio control.
#[test]
fn p8_does_not_arm_without_a_receiver_by_default() {
    let armed = |throttle: f32, radio: bool| {
        let mut c =
            Companion::new(SimulationConfig { radio, ..config(&[("FS_THR_ENABLE", throttle)]) });
        c.prepare();
        let result = c.arm();
        (result == ACCEPTED, c.texts_contain("RC not found"))
    };
    assert_eq!(armed(1.0, false), (false, true));
    assert_eq!(armed(0.0, false), (true, false));
    assert_eq!(armed(1.0, true), (true, false));
}

/// Pitfall 9: jumps of the vision. With a new reset counter, the jump is adopted, and the vehicle flies the difference.
/// Without, it is rejected as an outlier, unless it lasts longer than the estimator's timeout.
#[test]
fn p9_follows_only_announced_jumps() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    c.set_once(GuidedMotion::Position(DVec3::new(0.0, 0.0, 1.2)), YawTarget::Angle(0.0));
    c.wait(3.0);
    let start = c.p();
    c.vision_shift = (DVec3::X * 3.0, 0);
    c.wait(2.0);
    assert!((c.p() - start).length() < 0.3, "{:?}", c.p());
    c.vision_shift = (DVec3::ZERO, 0);
    c.wait(2.0);
    c.vision_shift = (DVec3::X * 0.8, 1);
    c.wait(6.0);
    assert!((c.p() - start + DVec3::X * 0.8).length() < 0.15, "{:?}", c.p());
}

/// The estimator's sources decide: vision that is not a source is received but not used.
#[test]
fn vision_counts_only_if_it_is_a_source() {
    let mut c = Companion::new(config(&[("EK3_SRC1_POSXY", 3.0)]));
    c.wait(3.0);
    c.set_origin();
    c.wait(6.0);
    assert!(!c.flags().contains(EkfStatusFlags::EKF_POS_HORIZ_ABS));
    c.set_mode(CopterMode::Guided);
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("Need Position Estimate"));
    let mut c = Companion::new(config(&[("GPS1_TYPE", 1.0)]));
    c.prepare();
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("GPS 1: not healthy"));
    let mut c = Companion::new(config(&[("GPS1_TYPE", 1.0), ("ARMING_SKIPCHK", -1.0)]));
    c.prepare();
    assert_eq!(c.arm(), ACCEPTED);
}
