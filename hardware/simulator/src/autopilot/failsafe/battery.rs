//! Readings of the power module, and the failsafe for a low battery (BATT_*).
//!
//! ArduCopter counts charge from boot, so a half-empty battery is reported as 100 %. Only the voltage is reliable.

use vizflyt_protocol::time::AutopilotTime;

use super::super::dialect::MavSeverity;
use super::super::{Autopilot, Param};
use super::Action;

/// Used charge, and the times since which the voltage is low.
#[derive(Clone, Copy, Debug, Default)]
pub(in super::super) struct Gauge {
    /// Charge used since boot [mAh].
    pub(in super::super) used_mah: f64,
    low_since: Option<AutopilotTime>,
    critical_since: Option<AutopilotTime>,
}

/// Stages of a low battery.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd)]
pub(in super::super) enum Stage {
    Low,
    Critical,
}

impl Autopilot {
    /// Whether there is a power module (BATT_MONITOR).
    pub(in super::super) fn has_gauge(&self) -> bool {
        self.params.value(Param::BattMonitor) != 0.0
    }

    /// Returns the remaining charge, computed from the charge used since boot [%]; -1 if not measured.
    pub(in super::super) fn battery_percent(&self) -> i8 {
        let capacity = self.params.value(Param::BattCapacity);
        if !self.has_gauge() || capacity <= 0.0 {
            return -1;
        }
        (100.0 * (1.0 - self.gauge.used_mah / capacity)).clamp(0.0, 100.0) as i8
    }

    pub(in super::super) fn below_arming_voltage(&self) -> bool {
        self.has_gauge() && self.sample.battery_v < self.params.value(Param::BattArmVolt)
    }

    pub(in super::super) fn gauge_charge(&mut self, dt_s: f64) {
        if self.has_gauge() {
            self.gauge.used_mah += self.sample.battery_a * dt_s / 3.6;
        }
    }

    pub(super) fn check_battery(&mut self, now: AutopilotTime) {
        if !self.has_gauge() {
            return;
        }
        let value = |param| self.params.value(param);
        let (volts, timer_s) = (self.sample.battery_v, value(Param::BattLowTimer));
        let left_mah = value(Param::BattCapacity) - self.gauge.used_mah;
        let long_below = |since: &mut Option<AutopilotTime>, limit_v: f64| {
            if limit_v <= 0.0 || volts >= limit_v {
                *since = None;
                return false;
            }
            now.seconds_since(*since.get_or_insert(now)) >= timer_s
        };
        let critical = long_below(&mut self.gauge.critical_since, value(Param::BattCrtVolt))
            || value(Param::BattCrtMah) > 0.0 && left_mah < value(Param::BattCrtMah);
        let low = long_below(&mut self.gauge.low_since, value(Param::BattLowVolt))
            || value(Param::BattLowMah) > 0.0 && left_mah < value(Param::BattLowMah);
        let stage = if critical { Some(Stage::Critical) } else { low.then_some(Stage::Low) };
        // The stage never decreases: without load, the voltage rises, but the battery stays empty.
        if stage <= self.failsafe.battery {
            return;
        }
        self.failsafe.battery = stage;
        let (name, action) = if stage == Some(Stage::Critical) {
            ("critical", value(Param::BattFsCrtAct))
        } else {
            ("low", value(Param::BattFsLowAct))
        };
        let used_mah = self.gauge.used_mah;
        let text = format!("Battery 1 is {name} {volts:.2}V used {used_mah:.0} mAh");
        self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, &text);
        if !self.armed {
            return;
        }
        if self.landed {
            self.disarm();
            return;
        }
        let action = match action as u8 {
            1 | 4 => Action::Land,
            2 | 3 | 6 => Action::Return,
            5 => Action::Terminate,
            7 => Action::Brake,
            _ => Action::Nothing,
        };
        self.act_with_pause(now, action);
    }
}
