//! What the autopilot does by itself when something is lost.

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::MavSeverity;
use super::{Autopilot, Param};
use crate::estimator::EstimatorHealth;

/// A lost position lands after this much longer (ArduCopter counts ten checks at 10 Hz). [s]
const EKF_S: f64 = 0.9;
/// "Field Elevation Set" comes this long after the position. [s]
const DATUM_S: f64 = 1.0;
/// A vehicle tilted this far for this long has crashed. [rad], [s]
const TOPPLED_RAD: f64 = 1.3;
const TOPPLED_S: f64 = 2.0;

/// What has been noticed.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Failsafe {
    position_lost_at: Option<AutopilotTime>,
    /// The failsafe has acted; it acts once.
    pub(super) ekf: bool,
    pub(super) gcs: bool,
    position_since: Option<AutopilotTime>,
    checked_at: Option<AutopilotTime>,
}

impl Autopilot {
    pub(super) fn check_failsafes(&mut self, now: AutopilotTime) {
        let health = self.estimator.health(now);
        self.check_position(now, health);
        self.check_ground_station(now);
        self.check_crash(now);
        self.reset_datum_once(now, health);
    }

    fn check_position(&mut self, now: AutopilotTime, health: EstimatorHealth) {
        if health.position {
            self.failsafe.position_lost_at = None;
            self.failsafe.ekf = false;
            return;
        }
        if !self.armed || self.landed || !needs_position(self.mode) {
            self.failsafe.position_lost_at = None;
            return;
        }
        let lost_at = *self.failsafe.position_lost_at.get_or_insert(now);
        let acts = self.params.value(Param::FsEkfAction) != 0.0 && !self.failsafe.ekf;
        if acts && now.seconds_since(lost_at) > EKF_S {
            self.failsafe.ekf = true;
            self.say(MavSeverity::MAV_SEVERITY_CRITICAL, "EKF Failsafe: changed to LAND Mode");
            self.enter(CopterMode::Land);
        }
    }

    fn check_ground_station(&mut self, now: AutopilotTime) {
        let action = self.params.value(Param::FsGcsEnable) as u8;
        // Counts only after a ground station has been heard at all.
        let Some(heard) = self.last_ground_station else { return };
        if action == 0 || now.seconds_since(heard) <= self.params.value(Param::FsGcsTimeout) {
            if self.failsafe.gcs {
                self.failsafe.gcs = false;
                self.say(MavSeverity::MAV_SEVERITY_WARNING, "GCS Failsafe Cleared");
            }
            return;
        }
        if self.failsafe.gcs {
            return;
        }
        self.failsafe.gcs = true;
        if !self.armed {
            return;
        }
        if self.landed {
            self.say(MavSeverity::MAV_SEVERITY_WARNING, "GCS Failsafe - Disarming");
            self.disarm();
        } else if matches!(action, 1 | 3) {
            self.say(MavSeverity::MAV_SEVERITY_WARNING, "GCS Failsafe - RTL");
            self.enter(CopterMode::Rtl);
        } else {
            self.say(MavSeverity::MAV_SEVERITY_WARNING, "GCS Failsafe - Landing");
            self.enter(CopterMode::Land);
        }
    }

    fn check_crash(&mut self, now: AutopilotTime) {
        let elapsed_s = self.failsafe.checked_at.map_or(0.0, |t| now.seconds_since(t));
        self.failsafe.checked_at = Some(now);
        let up = self.estimator.estimate().world_from_body * glam::DVec3::Z;
        let toppled = self.armed && up.z < TOPPLED_RAD.cos();
        self.flight.toppled_s =
            if toppled { self.flight.toppled_s + elapsed_s.max(0.0) } else { 0.0 };
        if self.flight.toppled_s > TOPPLED_S && self.params.value(Param::FsCrashCheck) != 0.0 {
            self.say(MavSeverity::MAV_SEVERITY_EMERGENCY, "Crash: Disarming");
            self.disarm();
        }
    }

    /// See [`crate::estimator::Estimator::reset_height_datum`].
    fn reset_datum_once(&mut self, now: AutopilotTime, health: EstimatorHealth) {
        if !health.position || self.armed || self.datum_reset {
            return;
        }
        let since = *self.failsafe.position_since.get_or_insert(now);
        if now.seconds_since(since) > DATUM_S {
            self.datum_reset = true;
            self.estimator.reset_height_datum();
            self.say(MavSeverity::MAV_SEVERITY_INFO, "Field Elevation Set: 0m");
        }
    }
}

/// Whether a mode flies by position.
pub(super) fn needs_position(mode: CopterMode) -> bool {
    matches!(mode, CopterMode::Guided | CopterMode::Loiter | CopterMode::Rtl | CopterMode::Brake)
}
