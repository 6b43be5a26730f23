//! Computes VIBRATION like ArduPilot (AP_InertialSensor, calc_vibration_and_clipping): the deviation from a 5 Hz
//! low-pass, squared, through a 2 Hz low-pass.

use glam::DVec3;
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::{self, MavMessage};
use crate::imu::ACCEL_RANGE_MPS2;

const FLOOR_HZ: f64 = 5.0;
const MEAN_HZ: f64 = 2.0;

/// State of the filters.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Vibration {
    floor: DVec3,
    square: DVec3,
    clipped: u32,
    started: bool,
}

impl Vibration {
    pub(super) fn handle_accel(&mut self, accel_body_mps2: DVec3, dt_s: f64) {
        if !accel_body_mps2.is_finite() {
            return;
        }
        let share = |hz: f64| 1.0 - (-std::f64::consts::TAU * hz * dt_s).exp();
        if !self.started {
            self.started = true;
            self.floor = accel_body_mps2;
        }
        self.floor += (accel_body_mps2 - self.floor) * share(FLOOR_HZ);
        let off = accel_body_mps2 - self.floor;
        self.square += (off * off - self.square) * share(MEAN_HZ);
        if accel_body_mps2.abs().max_element() > 0.98 * ACCEL_RANGE_MPS2 {
            self.clipped = self.clipped.wrapping_add(1);
        }
    }

    pub(super) fn message(&self, now: AutopilotTime) -> MavMessage {
        let level = self.square.max(DVec3::ZERO).to_array().map(|v| v.sqrt() as f32);
        MavMessage::VIBRATION(dialect::VIBRATION_DATA {
            time_usec: now.as_ns() / 1000,
            vibration_x: level[0],
            vibration_y: level[1],
            vibration_z: level[2],
            clipping_0: self.clipped,
            ..Default::default()
        })
    }
}
