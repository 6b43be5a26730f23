//! IMU samples: their stamps, and the choice between two messages.

use glam::DVec3;
use vizflyt_protocol::mavlink::dialect::{ATTITUDE_DATA, HIGHRES_IMU_DATA, RAW_IMU_DATA};
use vizflyt_protocol::packet::MAX_IMU;

use super::*;

/// Offset of the autopilot's clock from ours. [ns]
const AHEAD_NS: i64 = 77_000_000_000;

fn boot_us(now: HostTime) -> u64 {
    now.plus_ns(AHEAD_NS).as_ns() / 1000
}

/// Answers the next clock request after a round trip of 2 ms.
fn relate_clocks(script: &mut Script) {
    let newest = |script: &Script| {
        script.sent.iter().rev().find_map(|message| match message {
            MavMessage::TIMESYNC(m) if m.tc1 == 0 => Some(m.ts1),
            _ => None,
        })
    };
    while newest(script) != Some(script.now.as_ns() as i64) {
        script.run(0.02);
    }
    let asked = script.now.as_ns() as i64;
    script.now = script.now.plus_ns(2_000_000);
    let tc1 = asked + AHEAD_NS + 1_000_000;
    script.inject(&MavMessage::TIMESYNC(TIMESYNC_DATA { tc1, ts1: asked, ..Default::default() }));
}

fn raw(script: &mut Script, time_usec: u64, zacc: i16) {
    script.inject(&MavMessage::RAW_IMU(RAW_IMU_DATA { time_usec, zacc, ..Default::default() }));
}

fn newest(script: &Script) -> ImuSample {
    *script.link.imu().back().unwrap()
}

#[test]
fn stamps_samples_with_their_measurement_time() {
    let mut script = Script::ready();
    let before = script.now;
    raw(&mut script, 12_345, -1000);
    assert_eq!(newest(&script).stamp, before, "unknown clock: time of arrival");
    assert_eq!(newest(&script).accel_mps2, DVec3::Z * 9.80665);

    relate_clocks(&mut script);
    script.now = script.now.plus_seconds(0.5);
    let taken = script.now.plus_ns(-4_000_000);
    raw(&mut script, boot_us(taken), -1000);
    let error_s = newest(&script).stamp.seconds_since(taken).abs();
    assert!(error_s < 2e-3, "{error_s}");
    // A stamp in the future becomes `now`. A stamp of another clock becomes the time of arrival.
    script.now = script.now.plus_seconds(0.1);
    let future = boot_us(script.now.plus_seconds(0.3));
    raw(&mut script, future, -1000);
    assert_eq!(newest(&script).stamp, script.now);
    script.now = script.now.plus_seconds(0.1);
    raw(&mut script, 5, -1000);
    assert_eq!(newest(&script).stamp, script.now);
}

#[test]
fn stamps_increase_and_the_newest_samples_are_kept() {
    let mut script = Script::ready();
    relate_clocks(&mut script);
    let start = script.now.plus_seconds(0.2);
    script.now = start.plus_seconds(0.5);
    for ms in [0, 10, 5, 20, 20, 30] {
        raw(&mut script, boot_us(start.plus_ns(ms * 1_000_000)), ms as i16);
    }
    let seen = |script: &Script| -> Vec<i64> {
        script.link.imu().iter().map(|s| (s.accel_mps2.z / -9.80665e-3).round() as i64).collect()
    };
    assert_eq!(seen(&script), [0, 10, 20, 30], "late and repeated samples are dropped");
    for ms in 40..140 {
        raw(&mut script, boot_us(start.plus_ns(ms * 1_000_000)), ms as i16);
    }
    let last: Vec<i64> = (140 - MAX_IMU as i64..140).collect();
    assert_eq!(seen(&script), last);
    let poison = HIGHRES_IMU_DATA { xacc: f32::NAN, ..Default::default() };
    script.inject(&MavMessage::HIGHRES_IMU(poison));
    assert_eq!(seen(&script), last);
}

#[test]
fn highres_imu_is_preferred_until_a_restart() {
    let mut script = Script::ready();
    let fine = |script: &mut Script| {
        script.now = script.now.plus_ns(10_000_000);
        script.inject(&MavMessage::HIGHRES_IMU(HIGHRES_IMU_DATA {
            zacc: -5.0,
            zgyro: -0.25,
            ..Default::default()
        }));
    };
    raw(&mut script, 1, -1000);
    fine(&mut script);
    assert_eq!(
        (newest(&script).accel_mps2, newest(&script).gyro_radps),
        (DVec3::Z * 5.0, DVec3::Z * 0.25)
    );
    script.now = script.now.plus_ns(10_000_000);
    raw(&mut script, 2, -1000);
    assert_eq!(newest(&script).accel_mps2, DVec3::Z * 5.0, "RAW_IMU is ignored");
    assert_eq!(script.link.imu().len(), 2);
    for time_boot_ms in [90_000, 10] {
        script.inject(&MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms, ..Default::default() }));
    }
    assert!(script.link.imu().is_empty(), "their clock has restarted");
    script.now = script.now.plus_ns(10_000_000);
    raw(&mut script, 3, -1000);
    assert_eq!(
        newest(&script).accel_mps2,
        DVec3::Z * 9.80665,
        "the autopilot may no longer send HIGHRES_IMU"
    );
}
