//! Messages for people: why the vehicle cannot be armed, and why a command was rejected.

use std::borrow::Cow;

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::mavlink::dialect::{EkfStatusFlags, MavSysStatusSensor};
use vizflyt_protocol::time::HostTime;

use super::commands::Command;
use super::dialect::Rise;
use super::{Link, events};

/// Maximum age of an autopilot's text that explains a rejection. [s]
const TEXT_WINDOW_S: f64 = 3.0;
/// Maximum age of a valid pre-arm text: ArduCopter repeats them every 30 s. [s]
const PREARM_TEXT_S: f64 = 35.0;

impl Link {
    /// Returns the condition that arming waits for.
    pub(super) fn missing(&self, now: HostTime) -> Option<Cow<'static, str>> {
        if self.autopilot.is_none() {
            let refused = self.signatures.as_ref().map_or(0, super::Signatures::refused);
            return Some(if let Some(wrong) = self.wrong_vehicle(now) {
                wrong.into()
            } else if refused > 0 {
                "packets arrive, but not signed with our key; run `vizflyt vehicle sign`".into()
            } else {
                "no heartbeat from an autopilot; check power, link and --mavlink".into()
            });
        }
        if let Some(several) = self.several(now) {
            return Some(several.into());
        }
        if let Some(other) = self.companions.other(now) {
            let text = format!("{other} commands this vehicle too; stop one of the two");
            return Some(text.into());
        }
        if let Some(component) = self.companions.station(now) {
            let text = format!(
                "a ground station (component {component}) has system id 255, as this runtime: give it another, else \
                 the autopilot does not notice when the runtime is gone"
            );
            return Some(text.into());
        }
        if let Some(missing) = self.navigation_missing() {
            return Some(missing);
        }
        if self.fence.is_under_way() {
            return Some("the arena's fence is being uploaded to the autopilot".into());
        }
        match self.prearm.ok {
            Some(true) => None,
            Some(false) => Some(self.prearm_message(now).into()),
            None => Some("the autopilot has not reported its pre-arm checks yet".into()),
        }
    }

    /// Returns why the autopilot has no position.
    fn navigation_missing(&self) -> Option<Cow<'static, str>> {
        if self.dialect.needs_origin() && self.origin.is_none() {
            // An autopilot that signs accepts unsigned packets only over USB.
            let is_deaf = self.autopilot_signs && self.signatures.is_none();
            return Some(if is_deaf { UNCONFIRMED_TO_UNSIGNED } else { UNCONFIRMED }.into());
        }
        // In PX4, a position from external navigation is relative.
        let position = if self.dialect.rise() == Rise::BySetpoint {
            EkfStatusFlags::EKF_POS_HORIZ_ABS | EkfStatusFlags::EKF_POS_HORIZ_REL
        } else {
            EkfStatusFlags::EKF_POS_HORIZ_ABS
        };
        let has_position =
            self.ekf.intersects(position) && !self.ekf.contains(EkfStatusFlags::EKF_CONST_POS_MODE);
        if has_position {
            return None;
        }
        let mut text = "the autopilot's estimator has no position yet; ".to_owned();
        // A known wrong setting has priority over general advice.
        let off = |name: &str, right: f64| {
            let value = self.params().get(name)?.value;
            (value != right).then(|| format!("{name} is {value}, it must be {right}"))
        };
        let wrong = off("VISO_TYPE", 1.0).or_else(|| off("EK3_SRC1_POSXY", 6.0));
        text += &wrong.unwrap_or_else(|| self.dialect.navigation_advice().to_owned());
        Some(text.into())
    }

    fn prearm_message(&self, now: HostTime) -> String {
        let fresh = |(at, _): &&(HostTime, String)| now.seconds_since(*at) < PREARM_TEXT_S;
        let reason = |(_, why): &(HostTime, String)| match events::advice(why) {
            Some(advice) => format!("\"{why}\" ({advice})"),
            None => format!("\"{why}\""),
        };
        let reasons: Vec<String> = self.prearm.texts.iter().filter(fresh).map(reason).collect();
        let unhealthy: Vec<&str> = SENSORS
            .iter()
            .filter(|(sensor, _)| self.prearm.unhealthy.contains(*sensor))
            .map(|&(_, name)| name)
            .collect();
        let colon = if reasons.is_empty() { "" } else { ": " };
        let also = if unhealthy.is_empty() { "" } else { "; not healthy: " };
        format!(
            "the autopilot's pre-arm checks fail{colon}{}{also}{}",
            reasons.join("; "),
            unhealthy.join(", ")
        )
    }

    /// Returns the message for a command that was given up.
    pub(super) fn refusal(&self, now: HostTime, command: Command, why: &str) -> String {
        let texts: Vec<&str> = self
            .texts
            .iter()
            .filter(|(at, _)| now.seconds_since(*at) <= TEXT_WINDOW_S)
            .map(|(_, text)| text.as_str())
            .collect();
        let guess = if texts.is_empty() { self.cause(command) } else { None };
        events::refusal(command.name(), why, &texts, guess)
    }

    /// Returns the cause of a rejection as far as the autopilot's state shows it: ArduCopter rejects some commands
    /// without a text.
    fn cause(&self, command: Command) -> Option<Cow<'static, str>> {
        let guided = self.state.mode == CopterMode::Guided as u32;
        match command {
            Command::TakeOff(height_m) if !(height_m > 0.0) => Some(
                format!("{height_m} m is not a valid height; set takeoff_height_m of the arena")
                    .into(),
            ),
            Command::TakeOff(_) if self.dialect.needs_origin() && self.origin.is_none() => Some(
                "no EKF origin; SET_GPS_GLOBAL_ORIGIN was not confirmed, so check the link to the \
                 autopilot, or set AHRS_OPTIONS=16 and AHRS_ORIGIN_*"
                    .into(),
            ),
            Command::TakeOff(_) if !guided => {
                let follow = self.dialect.follow();
                Some(
                    format!("it is not in {follow}; a pilot or a failsafe changed the mode").into(),
                )
            }
            Command::TakeOff(_) if !self.state.armed => {
                Some("it is disarmed; DISARM_DELAY passed, or a pilot disarmed it".into())
            }
            Command::Mode(_) | Command::Arm | Command::TakeOff(_) => self.navigation_missing(),
            Command::Land | Command::Interval(..) | Command::Message(_) => None,
        }
    }
}

const UNCONFIRMED: &str = "the autopilot has not confirmed its origin yet";
const UNCONFIRMED_TO_UNSIGNED: &str = "the autopilot has not confirmed its origin yet; it signs its \
    packets and we do not, so it may refuse ours: set `signing_key` (`vizflyt vehicle sign`)";

const SENSORS: [(MavSysStatusSensor, &str); 13] = [
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_3D_GYRO, "gyroscope"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_3D_ACCEL, "accelerometer"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_3D_MAG, "compass"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE, "barometer"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_GPS, "GPS"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_VISION_POSITION, "external navigation"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS, "motor outputs or safety switch"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_RC_RECEIVER, "RC receiver"),
    (MavSysStatusSensor::MAV_SYS_STATUS_GEOFENCE, "fence"),
    (MavSysStatusSensor::MAV_SYS_STATUS_AHRS, "attitude"),
    (MavSysStatusSensor::MAV_SYS_STATUS_LOGGING, "logging"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_BATTERY, "battery"),
    (MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_PROPULSION, "motors"),
];
