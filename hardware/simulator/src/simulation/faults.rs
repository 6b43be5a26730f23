//! Simulated failures. Times count from take-off, so that a slow start changes nothing.

/// Failures, with times from take-off [s].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Faults {
    /// Failure of a motor.
    pub motor: Option<MotorFault>,
    /// The transmitter of the radio control falls silent.
    pub radio_lost_after_s: Option<f64>,
    /// The autopilot reboots.
    pub reboot_after_s: Option<f64>,
}

/// Failure of a motor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorFault {
    /// Number of the motor, from 0 in ArduCopter's order.
    pub motor: usize,
    /// Remaining share of its thrust, 0 to 1.
    pub share: f64,
    /// Time of the failure [s].
    pub after_s: f64,
}

/// Failure that is due.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Due {
    /// See [`MotorFault`].
    Motor { motor: usize, share: f64 },
    /// The transmitter falls silent.
    Radio,
    /// The autopilot reboots.
    Reboot,
}

impl Faults {
    /// Returns a due failure, each only once; `since_take_off_s` is 0 before the flight.
    pub(super) fn due(&mut self, since_take_off_s: f64) -> Option<Due> {
        let is_due = |after_s: &mut f64| since_take_off_s > 0.0 && since_take_off_s >= *after_s;
        if let Some(fault) = self.motor.take_if(|fault| is_due(&mut fault.after_s)) {
            return Some(Due::Motor { motor: fault.motor, share: fault.share });
        }
        if self.radio_lost_after_s.take_if(is_due).is_some() {
            return Some(Due::Radio);
        }
        self.reboot_after_s.take_if(is_due).map(|_| Due::Reboot)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_failure_occurs_once_and_only_in_flight() {
        let motor = MotorFault { motor: 2, share: 0.5, after_s: 2.0 };
        let mut faults =
            Faults { motor: Some(motor), radio_lost_after_s: Some(0.0), reboot_after_s: Some(2.0) };
        assert_eq!(faults.due(0.0), None);
        assert_eq!((faults.due(0.1), faults.due(0.1)), (Some(Due::Radio), None));
        assert_eq!(faults.due(2.5), Some(Due::Motor { motor: 2, share: 0.5 }));
        assert_eq!((faults.due(2.5), faults.due(9.0)), (Some(Due::Reboot), None));
    }
}
