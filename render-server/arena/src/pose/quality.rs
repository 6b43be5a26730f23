//! Quality of the localization, for display: page, `/api`, reports.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::time::ServerTime;

use super::{MAX_SOURCES, Rejected};

/// Number of rejected measurements by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rejects {
    /// Invalid numbers.
    pub invalid: u64,
    /// Not newer than the last measurement of their source, or too old to be fused.
    pub stale: u64,
    /// Impossible stamps: a clock jumped.
    pub clock: u64,
    /// Single measurements outside of the gate.
    pub outlier: u64,
    /// Jumps of the position.
    pub jump: u64,
    /// Attitude flips: swapped markers.
    pub flip: u64,
    /// Repeated poses in flight or while the vehicle moved, and poses of an object that is not visible.
    pub frozen: u64,
    /// Measurements that contradict an accepted source.
    pub disagree: u64,
}

impl Rejects {
    pub(super) fn count(&mut self, reason: &Rejected) {
        *match reason {
            Rejected::Invalid => &mut self.invalid,
            Rejected::Stale => &mut self.stale,
            Rejected::Clock(_) | Rejected::ClockJump(_) => &mut self.clock,
            Rejected::Outlier(_) => &mut self.outlier,
            Rejected::Jump { .. } => &mut self.jump,
            Rejected::Flip { .. } => &mut self.flip,
            Rejected::Frozen(_) | Rejected::Repeated(_) | Rejected::NotVisible => &mut self.frozen,
            Rejected::Disagree { .. } => &mut self.disagree,
        } += 1;
    }

    /// Returns the sum over all reasons.
    pub fn total(&self) -> u64 {
        let Self { invalid, stale, clock, outlier, jump, flip, frozen, disagree } = *self;
        invalid + stale + clock + outlier + jump + flip + frozen + disagree
    }

    /// Returns the sum of both.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            invalid: self.invalid + other.invalid,
            stale: self.stale + other.stale,
            clock: self.clock + other.clock,
            outlier: self.outlier + other.outlier,
            jump: self.jump + other.jump,
            flip: self.flip + other.flip,
            frozen: self.frozen + other.frozen,
            disagree: self.disagree + other.disagree,
        }
    }
}

/// Quality of one vehicle's localization.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseQuality {
    /// Age of the newest accepted pose; `None` before the first. [ms]
    pub age_ms: Option<f64>,
    /// Rate of accepted poses. [Hz]
    pub rate_hz: f64,
    /// Standard deviation of the position on the worst axis. [mm]
    pub position_sigma_mm: f64,
    /// Standard deviation of the attitude on the worst axis. [deg]
    pub rotation_sigma_deg: f64,
    /// Mean innovation in standard deviations: about 1.7 if sigmas and motion model are right.
    pub innovation_sigmas: f64,
    /// Speed in all three axes. [m/s]
    pub speed_mps: f64,
    /// Whether the autopilot's IMU is used.
    pub imu: bool,
    /// Number of resets: jumps of the pose for a reason other than motion.
    pub resets: u8,
    /// Quality of each source, by its index.
    pub sources: Vec<SourceQuality>,
}

/// Quality of one source.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SourceQuality {
    /// Index in the order of setup.
    pub source: u8,
    /// Name; empty if unnamed.
    pub name: String,
    /// Rate of measurements. [Hz]
    pub rate_hz: f64,
    /// Time from the stamp of a measurement to its arrival. [ms]
    pub latency_ms: f64,
    /// Number of accepted measurements.
    #[serde(rename = "believed")]
    pub accepted: u64,
    /// Number of rejected measurements.
    pub rejected: Rejects,
}

/// Rate and moving average over about a second.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Fading {
    last: Option<ServerTime>,
    interval_s: f64,
    value: f64,
}

impl Fading {
    /// Adds a value at a time.
    pub(super) fn add(&mut self, at: ServerTime, value: f64) {
        if let Some(last) = self.last.replace(at) {
            let dt_s = at.seconds_since(last).clamp(0.0, MAX_INTERVAL_S);
            if self.interval_s == 0.0 {
                (self.interval_s, self.value) = (dt_s, value);
            } else {
                let share = (dt_s / FADES_S).min(0.5);
                self.interval_s += (dt_s - self.interval_s) * share;
                self.value += (value - self.value) * share;
            }
        } else {
            self.value = value;
        }
    }

    pub(super) fn value(&self) -> f64 {
        self.value
    }

    /// Returns the recent rate of values; an overdue value counts with its waiting time. [Hz]
    pub(super) fn rate_hz(&self, now: ServerTime) -> f64 {
        let Some(last) = self.last else { return 0.0 };
        let waited_s = now.seconds_since(last);
        if waited_s > SILENT_S || !(self.interval_s > 0.0) {
            return 0.0;
        }
        let overdue = waited_s > 2.0 * self.interval_s;
        1.0 / if overdue { waited_s } else { self.interval_s }
    }
}

/// Time constant: half of a difference is left after 0.35 s. [s]
const FADES_S: f64 = 0.5;
/// After a longer silence, the rate is 0. [s]
const SILENT_S: f64 = 1.0;
/// Maximum interval that counts, so that a pause does not determine the rate after it. [s]
const MAX_INTERVAL_S: f64 = 1.0;

const _: () = assert!(MAX_SOURCES <= u8::MAX as usize);
