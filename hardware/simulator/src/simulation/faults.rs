//! What breaks in flight, and when: counted from leaving the floor, so that a slow start changes
//! nothing.

/// What breaks. Times are from leaving the floor. [s]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Faults {
    /// A motor fails.
    pub motor: Option<MotorFault>,
    /// The transmitter of the radio control falls silent.
    pub radio_lost_after_s: Option<f64>,
    /// The autopilot reboots.
    pub reboot_after_s: Option<f64>,
}

/// A motor that fails.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorFault {
    /// Which one, from 0 in ArduCopter's order.
    pub motor: usize,
    /// What it gives from then on of what it gave, 0 to 1.
    pub share: f64,
    /// When. [s]
    pub after_s: f64,
}

/// A fault whose time has come.
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
    /// Returns a fault that is due, once; 0 is before the flight.
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
    fn each_fault_comes_once_and_none_on_the_ground() {
        let motor = MotorFault { motor: 2, share: 0.5, after_s: 2.0 };
        let mut faults =
            Faults { motor: Some(motor), radio_lost_after_s: Some(0.0), reboot_after_s: Some(2.0) };
        assert_eq!(faults.due(0.0), None);
        assert_eq!((faults.due(0.1), faults.due(0.1)), (Some(Due::Radio), None));
        assert_eq!(faults.due(2.5), Some(Due::Motor { motor: 2, share: 0.5 }));
        assert_eq!((faults.due(2.5), faults.due(9.0)), (Some(Due::Reboot), None));
    }
}
