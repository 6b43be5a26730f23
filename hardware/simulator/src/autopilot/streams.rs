//! Schedule of sent messages: intervals of SET_MESSAGE_INTERVAL, and the older stream groups.

use vizflyt_protocol::time::AutopilotTime;

use super::Autopilot;
use super::dialect::MavDataStream;
use crate::startup::Startup;

pub(super) const HEARTBEAT: u32 = 0;
pub(super) const SYS_STATUS: u32 = 1;
pub(super) const SYSTEM_TIME: u32 = 2;
pub(super) const SCALED_IMU: u32 = 26;
pub(super) const RAW_IMU: u32 = 27;
pub(super) const ATTITUDE: u32 = 30;
pub(super) const ATTITUDE_QUATERNION: u32 = 31;
pub(super) const LOCAL_POSITION_NED: u32 = 32;
pub(super) const GPS_GLOBAL_ORIGIN: u32 = 49;
pub(super) const GLOBAL_POSITION_INT: u32 = 33;
pub(super) const FENCE_STATUS: u32 = 162;
pub(super) const VIBRATION: u32 = 241;
pub(super) const VFR_HUD: u32 = 74;
pub(super) const BATTERY_STATUS: u32 = 147;
pub(super) const AUTOPILOT_VERSION: u32 = 148;
pub(super) const EKF_STATUS_REPORT: u32 = 193;
pub(super) const HOME_POSITION: u32 = 242;
pub(super) const EXTENDED_SYS_STATE: u32 = 245;

/// All streams with their interval at boot [us]; 0 is off.
const DEFAULTS: [(u32, i32); 17] = [
    (HEARTBEAT, 1_000_000),
    (SYS_STATUS, 250_000),
    (SYSTEM_TIME, 1_000_000),
    (SCALED_IMU, 0),
    (RAW_IMU, 250_000),
    (ATTITUDE, 250_000),
    (ATTITUDE_QUATERNION, 0),
    (LOCAL_POSITION_NED, 250_000),
    (GLOBAL_POSITION_INT, 250_000),
    (FENCE_STATUS, 1_000_000),
    (VIBRATION, 500_000),
    (GPS_GLOBAL_ORIGIN, 0),
    (VFR_HUD, 250_000),
    (BATTERY_STATUS, 1_000_000),
    (EKF_STATUS_REPORT, 250_000),
    (HOME_POSITION, 0),
    (EXTENDED_SYS_STATE, 500_000),
];

/// Minimum interval: the period of the main loop [us].
const MIN_INTERVAL_US: i32 = 2_500;

/// Streams with their due times.
#[derive(Clone, Debug)]
pub(super) struct Streams {
    rows: [Stream; DEFAULTS.len()],
    readiness: Readiness,
}

/// Conditions that a companion waits for before it arms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Readiness {
    checks_pass: bool,
    position: bool,
}

#[derive(Clone, Copy, Debug)]
struct Stream {
    id: u32,
    /// Interval [us]; 0 is off.
    interval_us: i32,
    due: AutopilotTime,
}

impl Default for Streams {
    fn default() -> Self {
        let rows =
            DEFAULTS.map(|(id, interval_us)| Stream { id, interval_us, due: AutopilotTime::ZERO });
        Self { rows, readiness: Readiness::default() }
    }
}

impl Streams {
    /// Sets an interval like SET_MESSAGE_INTERVAL [us]: 0 is the default, -1 is off.
    pub(super) fn set_interval(&mut self, id: u32, interval_us: f32) -> bool {
        let Some(index) = self.rows.iter().position(|row| row.id == id) else { return false };
        if !interval_us.is_finite() {
            return false;
        }
        let row = &mut self.rows[index];
        // Starts at once, not at the end of the old interval.
        row.due = AutopilotTime::ZERO;
        row.interval_us = if interval_us < 0.0 {
            0
        } else if interval_us == 0.0 {
            DEFAULTS[index].1
        } else {
            (interval_us as i32).max(MIN_INTERVAL_US)
        };
        true
    }

    /// Returns an interval like MESSAGE_INTERVAL [us]: -1 is off; `None` if the message is unknown.
    pub(super) fn interval_us(&self, id: u32) -> Option<i32> {
        let row = self.rows.iter().find(|row| row.id == id)?;
        Some(if row.interval_us == 0 { -1 } else { row.interval_us })
    }

    /// Sets the rate of an old stream group [Hz]; 0 is off.
    pub(super) fn request_group(&mut self, group: MavDataStream, rate_hz: u16) {
        let ids: &[u32] = match group {
            MavDataStream::MAV_DATA_STREAM_ALL => &[
                SYS_STATUS,
                SYSTEM_TIME,
                RAW_IMU,
                ATTITUDE,
                LOCAL_POSITION_NED,
                GLOBAL_POSITION_INT,
                FENCE_STATUS,
                VIBRATION,
                VFR_HUD,
                BATTERY_STATUS,
                EKF_STATUS_REPORT,
                EXTENDED_SYS_STATE,
            ],
            MavDataStream::MAV_DATA_STREAM_RAW_SENSORS => &[RAW_IMU],
            MavDataStream::MAV_DATA_STREAM_EXTENDED_STATUS => &[SYS_STATUS, FENCE_STATUS],
            MavDataStream::MAV_DATA_STREAM_POSITION => &[LOCAL_POSITION_NED, GLOBAL_POSITION_INT],
            MavDataStream::MAV_DATA_STREAM_EXTRA1 => &[ATTITUDE],
            MavDataStream::MAV_DATA_STREAM_EXTRA2 => &[VFR_HUD],
            MavDataStream::MAV_DATA_STREAM_EXTRA3 => {
                &[SYSTEM_TIME, BATTERY_STATUS, EKF_STATUS_REPORT, VIBRATION]
            }
            _ => &[],
        };
        let interval_us = if rate_hz == 0 { -1.0 } else { 1e6 / f32::from(rate_hz) };
        for &id in ids {
            self.set_interval(id, interval_us);
        }
    }

    /// Makes the next heartbeat due at once, so that a change of mode or arming is reported without delay.
    pub(super) fn heartbeat_now(&mut self) {
        self.rows[0].due = AutopilotTime::ZERO;
    }

    /// If `readiness` has changed, makes the messages that report it due at once.
    fn note_readiness(&mut self, readiness: Readiness) {
        if self.readiness != readiness {
            self.readiness = readiness;
            for row in &mut self.rows {
                if matches!(row.id, SYS_STATUS | EKF_STATUS_REPORT) {
                    row.due = AutopilotTime::ZERO;
                }
            }
        }
    }
}

impl Autopilot {
    /// Sends all due messages.
    pub(super) fn stream(&mut self, now: AutopilotTime) {
        if self.startup == Startup::Quick {
            let position = self.estimator.health(now).position;
            let checks_pass = self.arming_refusal(now).is_none();
            self.streams.note_readiness(Readiness { checks_pass, position });
        }
        for index in 0..self.streams.rows.len() {
            let row = self.streams.rows[index];
            if row.interval_us == 0 || now < row.due {
                continue;
            }
            // Keeps the grid of the interval, unless it is late by a whole interval.
            let step_ns = i64::from(row.interval_us) * 1000;
            let on_grid = row.due.plus_ns(step_ns);
            self.streams.rows[index].due =
                if on_grid > now { on_grid } else { now.plus_ns(step_ns) };
            if let Some(message) = self.message(now, row.id) {
                self.send(message);
            }
        }
    }
}
