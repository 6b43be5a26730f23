//! Arming, disarming and take-off: checks and status texts as in ArduCopter.

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::{MavResult, MavSeverity};
use super::failsafe::needs_position;
use super::flight::FlightState;
use super::{Autopilot, Guided, Param, Radio, name_of};
use crate::startup::Startup;

impl Autopilot {
    /// Returns why arming is refused; `None` if it is allowed.
    pub(super) fn arming_refusal(&self, now: AutopilotTime) -> Option<&'static str> {
        let health = self.estimator.health(now);
        let value = |param| self.params.value(param);
        if !health.attitude {
            return Some("PreArm: AHRS: not healthy");
        }
        // Any bit skips all checks: individual bits are not simulated.
        if value(Param::ArmingSkipChecks) != 0.0 {
            return None;
        }
        if value(Param::FsThrEnable) != 0.0 && self.radio == Radio::Absent {
            Some("PreArm: RC not found")
        } else if value(Param::FsThrEnable) != 0.0 && self.failsafe.radio {
            Some("PreArm: Radio failsafe on")
        } else if value(Param::VisoType) != 0.0 && !health.vision {
            Some("PreArm: VisOdom: not healthy")
        } else if value(Param::GpsType) != 0.0 {
            // There is no GPS receiver on board.
            Some("PreArm: GPS 1: not healthy")
        } else if self.failsafe.battery.is_some() {
            Some("PreArm: Battery 1 low voltage failsafe")
        } else if self.below_arming_voltage() {
            Some("PreArm: Battery 1 below minimum arming voltage")
        } else if self.is_fenced() && health.origin && !health.position {
            Some("PreArm: Fence requires position")
        } else if self.is_fenced() && self.fence_breaches(now).any() {
            Some("PreArm: Vehicle breaching Fence")
        } else if needs_position(self.mode) && health.origin && !health.position {
            // Without an origin, a real ArduCopter arms but refuses the take-off.
            Some("PreArm: Need Position Estimate")
        } else {
            None
        }
    }

    pub(super) fn arm(&mut self, now: AutopilotTime, force: bool) -> MavResult {
        if self.armed {
            return MavResult::MAV_RESULT_ACCEPTED;
        }
        if matches!(self.mode, CopterMode::Land | CopterMode::Rtl | CopterMode::Brake) {
            let text = format!("Arm: {} mode not armable", name_of(self.mode));
            self.send_status_text(MavSeverity::MAV_SEVERITY_CRITICAL, &text);
            return MavResult::MAV_RESULT_FAILED;
        }
        if let Some(reason) = self.arming_refusal(now)
            && !(force && self.estimator.health(now).attitude)
        {
            self.send_status_text(MavSeverity::MAV_SEVERITY_CRITICAL, reason);
            return MavResult::MAV_RESULT_FAILED;
        }
        self.armed = true;
        self.landed = true;
        self.home = Some(self.estimator.estimate().p_world_m);
        self.flight = FlightState::default();
        self.send_status_text(MavSeverity::MAV_SEVERITY_INFO, "Arming motors");
        self.streams.heartbeat_now();
        MavResult::MAV_RESULT_ACCEPTED
    }

    pub(super) fn disarm_on_command(&mut self, force: bool) -> MavResult {
        if self.armed && !self.landed && !force {
            self.send_status_text(MavSeverity::MAV_SEVERITY_CRITICAL, "Disarm: not landed");
            return MavResult::MAV_RESULT_FAILED;
        }
        self.disarm();
        MavResult::MAV_RESULT_ACCEPTED
    }

    /// Disarms: stops the motors.
    pub(super) fn disarm(&mut self) {
        if self.armed {
            self.armed = false;
            self.landed = true;
            self.guided = Guided::Hold;
            self.flight = FlightState::default();
            self.send_status_text(MavSeverity::MAV_SEVERITY_INFO, "Disarming motors");
            if self.startup == Startup::Quick {
                self.streams.heartbeat_now();
            }
        }
    }

    pub(super) fn take_off(&mut self, now: AutopilotTime, height_m: f64) -> MavResult {
        let health = self.estimator.health(now);
        let refusal = if self.mode != CopterMode::Guided {
            Some("Takeoff refused: not in GUIDED")
        } else if !self.armed {
            Some("Takeoff refused: not armed")
        } else if !self.landed {
            Some("Takeoff refused: already flying")
        } else if !health.origin || !health.position {
            Some("Takeoff refused: no EKF origin")
        } else if !(height_m > 0.0 && height_m < 1000.0) {
            Some("Takeoff refused: height out of range")
        } else {
            None
        };
        if let Some(text) = refusal {
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, text);
            return MavResult::MAV_RESULT_FAILED;
        }
        let ground_m = self.home.map_or(0.0, |home| home.z);
        self.guided = Guided::TakeOff { z_m: ground_m + height_m };
        self.landed = false;
        MavResult::MAV_RESULT_ACCEPTED
    }

    /// PREFLIGHT_REBOOT_SHUTDOWN: 1 reboots; while armed only if forced.
    pub(super) fn reboot_on_command(&mut self, what: f32, force: bool) -> MavResult {
        if what != 1.0 {
            MavResult::MAV_RESULT_UNSUPPORTED
        } else if self.armed && !force {
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, "Reboot refused: armed");
            MavResult::MAV_RESULT_FAILED
        } else {
            self.wants_reboot = true;
            MavResult::MAV_RESULT_ACCEPTED
        }
    }
}
