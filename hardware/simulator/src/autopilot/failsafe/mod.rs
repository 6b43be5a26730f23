//! Failsafes of the autopilot: loss of position, ground station or radio control, low battery, fence, crash.

mod battery;
mod fence;

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::MavSeverity;
use super::{Autopilot, Param, Radio};
use crate::estimator::EstimatorHealth;
pub(super) use battery::{Gauge, Stage};

/// Delay from a lost position to the action (ArduCopter counts ten checks at 10 Hz) [s].
const EKF_S: f64 = 0.9;
/// Delay from the first position to "Field Elevation Set" [s].
const DATUM_S: f64 = 1.0;
/// Tilt [rad], and its duration [s], at which the vehicle counts as crashed.
const TOPPLED_RAD: f64 = 1.3;
const TOPPLED_S: f64 = 2.0;

/// Bits of FS_OPTIONS.
const CONTINUE_GUIDED_WITHOUT_RADIO: u8 = 4;
const CONTINUE_LANDING: u8 = 8;
const CONTINUE_BY_HAND: u8 = 16;

/// Action of a failsafe.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Action {
    Nothing,
    Land,
    /// RTL, or LAND without a position.
    Return,
    /// BRAKE, or LAND without a position.
    Brake,
    /// Motors off, also in the air.
    Terminate,
}

/// State of all failsafes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Failsafe {
    position_lost_at: Option<AutopilotTime>,
    /// Whether the failsafe has acted; it acts only once.
    pub(super) ekf: bool,
    pub(super) gcs: bool,
    pub(super) radio: bool,
    radio_lost_at: Option<AutopilotTime>,
    pub(super) battery: Option<Stage>,
    fence: fence::Fence,
    position_since: Option<AutopilotTime>,
    checked_at: Option<AutopilotTime>,
}

impl Autopilot {
    pub(super) fn check_failsafes(&mut self, now: AutopilotTime) {
        let health = self.estimator.health(now);
        self.check_position(now, health);
        self.check_ground_station(now);
        self.check_radio(now);
        self.check_battery(now);
        self.check_fence(now);
        self.check_crash(now);
        self.restore_origin(health);
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
            let (mode, name) = match self.params.value(Param::FsEkfAction) as u8 {
                2 => (CopterMode::AltHold, "ALT_HOLD"),
                _ => (CopterMode::Land, "LAND"),
            };
            let text = format!("EKF Failsafe: changed to {name} Mode");
            self.send_status_text(MavSeverity::MAV_SEVERITY_CRITICAL, &text);
            self.enter(mode);
            self.landing.pauses = mode == CopterMode::Land;
        }
    }

    fn check_ground_station(&mut self, now: AutopilotTime) {
        let action = self.params.value(Param::FsGcsEnable) as u8;
        // Active only after the first heartbeat of a ground station.
        let Some(received_at) = self.last_ground_station else { return };
        if action == 0 || now.seconds_since(received_at) <= self.params.value(Param::FsGcsTimeout) {
            if self.failsafe.gcs {
                self.failsafe.gcs = false;
                self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, "GCS Failsafe Cleared");
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
        let by_hand =
            matches!(self.mode, CopterMode::Stabilize | CopterMode::AltHold | CopterMode::Loiter);
        let options = self.params.value(Param::FsOptions) as u8;
        if by_hand && !self.landed && options & CONTINUE_BY_HAND != 0 {
            let text = "GCS Failsafe - Continuing Pilot Control";
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, text);
            return;
        }
        let action = match action {
            1..=3 | 6 => Action::Return,
            7 => Action::Brake,
            _ => Action::Land,
        };
        self.failsafe("GCS", now, action);
    }

    /// Checks for a silent receiver (FS_THR_ENABLE). Without a receiver, this failsafe cannot trigger.
    fn check_radio(&mut self, now: AutopilotTime) {
        let setting = self.params.value(Param::FsThrEnable) as u8;
        let lost = self.radio == Radio::Lost && setting != 0;
        if !lost {
            self.failsafe.radio_lost_at = None;
            if self.failsafe.radio {
                self.failsafe.radio = false;
                self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, "Radio Failsafe Cleared");
            }
            return;
        }
        let since = *self.failsafe.radio_lost_at.get_or_insert(now);
        if self.failsafe.radio || now.seconds_since(since) < self.params.value(Param::RcFsTimeout) {
            return;
        }
        self.failsafe.radio = true;
        if !self.armed {
            return;
        }
        let options = self.params.value(Param::FsOptions) as u8;
        let in_guided = self.mode == CopterMode::Guided && !self.landed;
        if in_guided && options & CONTINUE_GUIDED_WITHOUT_RADIO != 0 {
            let text = "Radio Failsafe - Continuing Guided Mode";
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, text);
            return;
        }
        let action = match setting {
            3 | 5 => Action::Land,
            7 => Action::Brake,
            _ => Action::Return,
        };
        self.failsafe("Radio", now, action);
    }

    /// Announces the loss and the action, and executes it.
    fn failsafe(&mut self, what: &str, now: AutopilotTime, action: Action) {
        let words = match action {
            _ if self.landed => "Disarming",
            _ if self.is_to_continue() => "Continuing Landing",
            Action::Return => "RTL",
            Action::Brake => "Brake",
            Action::Terminate => "Terminating",
            Action::Land | Action::Nothing => "Landing",
        };
        self.send_status_text(
            MavSeverity::MAV_SEVERITY_WARNING,
            &format!("{what} Failsafe - {words}"),
        );
        if self.landed {
            self.disarm();
        } else {
            self.act_with_pause(now, action);
        }
    }

    /// Executes an action. A landing by failsafe hovers first, so that a pilot can take over; this also delays a
    /// landing that continues.
    fn act_with_pause(&mut self, now: AutopilotTime, action: Action) {
        self.act(now, action);
        if self.mode == CopterMode::Land && action != Action::Nothing {
            self.landing.pauses = true;
        }
    }

    /// Whether a landing continues despite further failsafes (FS_OPTIONS).
    fn is_to_continue(&self) -> bool {
        let options = self.params.value(Param::FsOptions) as u8;
        self.mode == CopterMode::Land && options & CONTINUE_LANDING != 0
    }

    pub(super) fn act(&mut self, now: AutopilotTime, action: Action) {
        if self.is_to_continue() {
            return;
        }
        let has_position = self.estimator.health(now).position;
        match action {
            Action::Nothing => {}
            Action::Return if has_position => self.enter(CopterMode::Rtl),
            Action::Brake if has_position => self.enter(CopterMode::Brake),
            Action::Land | Action::Return | Action::Brake => self.enter(CopterMode::Land),
            Action::Terminate => self.disarm(),
        }
    }

    /// AHRS_OPTIONS bit 4: sets the origin recorded in the parameters at boot, so that no ground station must set it.
    fn restore_origin(&mut self, health: EstimatorHealth) {
        const USE_RECORDED_ORIGIN: u16 = 16;
        let value = |param| self.params.value(param);
        let on = value(Param::AhrsOptions) as u16 & USE_RECORDED_ORIGIN != 0;
        let place = (value(Param::AhrsOriginLat), value(Param::AhrsOriginLon));
        if on && !health.origin && place != (0.0, 0.0) && self.estimator.set_origin() {
            let altitude_mm = value(Param::AhrsOriginAlt) * 1000.0;
            self.origin =
                Some(((place.0 * 1e7) as i32, (place.1 * 1e7) as i32, altitude_mm as i32));
            self.send_status_text(MavSeverity::MAV_SEVERITY_INFO, "EKF3 IMU0 origin set");
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
            self.send_status_text(MavSeverity::MAV_SEVERITY_EMERGENCY, "Crash: Disarming");
            self.disarm();
        }
    }

    /// Resets the height datum once; see [`crate::estimator::Estimator::reset_height_datum`].
    fn reset_datum_once(&mut self, now: AutopilotTime, health: EstimatorHealth) {
        if !health.position || self.armed || self.datum_reset {
            return;
        }
        let since = *self.failsafe.position_since.get_or_insert(now);
        if now.seconds_since(since) > DATUM_S {
            self.datum_reset = true;
            self.estimator.reset_height_datum();
            self.send_status_text(MavSeverity::MAV_SEVERITY_INFO, "Field Elevation Set: 0m");
        }
    }
}

/// Whether a mode needs a position.
pub(super) fn needs_position(mode: CopterMode) -> bool {
    matches!(mode, CopterMode::Guided | CopterMode::Loiter | CopterMode::Rtl | CopterMode::Brake)
}
