//! How good the localization is at this moment, for people: page, `/api`, reports.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::time::ServerTime;

use super::{MAX_SOURCES, Rejected};

/// Measurements turned away, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rejects {
    /// Numbers that are no pose.
    pub invalid: u64,
    /// Not newer than the last one of their source, or too old to be fused.
    pub stale: u64,
    /// Stamps that cannot be: a clock jumped.
    pub clock: u64,
    /// Beyond the gate, once.
    pub outlier: u64,
    /// Teleports.
    pub jump: u64,
    /// Attitude flips: swapped markers.
    pub flip: u64,
    /// The same numbers again while the vehicle moved.
    pub frozen: u64,
    /// Against another source that is accepted.
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
            Rejected::Frozen(_) => &mut self.frozen,
            Rejected::Disagree { .. } => &mut self.disagree,
        } += 1;
    }

    /// Returns the sum over all reasons.
    pub fn total(&self) -> u64 {
        let Self { invalid, stale, clock, outlier, jump, flip, frozen, disagree } = *self;
        invalid + stale + clock + outlier + jump + flip + frozen + disagree
    }

    /// Returns both together.
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

/// How good one vehicle's localization is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseQuality {
    /// Since the newest accepted pose was measured; absent before the first. [ms]
    pub age_ms: Option<f64>,
    /// Believed poses. [Hz]
    pub rate_hz: f64,
    /// How far the pose may be off, one standard deviation, of the worst axis. [mm]
    pub position_sigma_mm: f64,
    /// The same of the attitude. [deg]
    pub rotation_sigma_deg: f64,
    /// How far measurements are from what was expected of them, in standard deviations: about 1.7
    /// where sigmas and the motion model are right.
    pub innovation_sigmas: f64,
    /// Speed over ground and up. [m/s]
    pub speed_mps: f64,
    /// Whether the autopilot's IMU takes part.
    pub imu: bool,
    /// Times that the pose jumped for another reason than motion.
    pub resets: u8,
    /// What each source delivered, by its index.
    pub sources: Vec<SourceQuality>,
}

/// What one source delivered.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SourceQuality {
    /// Its index, in the order in which sources were set up.
    pub source: u8,
    /// What it is called; empty if unnamed.
    pub name: String,
    /// Measurements. [Hz]
    pub rate_hz: f64,
    /// From the measurement to its arrival, by its stamps. [ms]
    pub latency_ms: f64,
    /// Believed so far.
    #[serde(rename = "believed")]
    pub accepted: u64,
    /// Turned away so far.
    pub rejected: Rejects,
}

/// A rate and a mean that forget within a second or so.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Fading {
    last: Option<ServerTime>,
    interval_s: f64,
    value: f64,
}

impl Fading {
    /// Takes a value at a time.
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

    /// Returns how often values came lately; what is overdue counts as its interval. [Hz]
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

/// Half the difference is forgotten after 0.35 s. [s]
const FADES_S: f64 = 0.5;
/// A source without a measurement for so long has no rate. [s]
const SILENT_S: f64 = 1.0;
/// A pause does not make the rate of what comes after it. [s]
const MAX_INTERVAL_S: f64 = 1.0;

const _: () = assert!(MAX_SOURCES <= u8::MAX as usize);
