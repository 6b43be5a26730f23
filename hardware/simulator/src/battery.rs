//! Flight battery: four lithium cells in series, discharged by the rotors.

use crate::motor::thrust_n;

const CELLS: f64 = 4.0;
/// Capacity of the published vehicle's battery [Ah].
const CAPACITY_AH: f64 = 0.85;
/// Internal resistance of the battery [Ohm].
const RESISTANCE_OHM: f64 = 0.04;
/// Electrical power per thrust [W / N^1.5]. Ideal hover power of one 102 mm propeller is T^1.5 / sqrt(2 rho A) with A =
/// 0.0081 m^2; the efficiency from the battery is one half.
const POWER_PER_THRUST: f64 = 1.0 / (0.141 * 0.5);
/// Power of autopilot, companion computer and radio [W].
const ELECTRONICS_W: f64 = 8.0;

/// Charge and current of the battery.
#[derive(Clone, Copy, Debug)]
pub struct Battery {
    left_ah: f64,
    current_a: f64,
}

impl Default for Battery {
    fn default() -> Self {
        Self { left_ah: CAPACITY_AH, current_a: 0.0 }
    }
}

impl Battery {
    /// Returns a battery charged to a share, 0 to 1.
    pub fn charged(share: f64) -> Self {
        Self { left_ah: CAPACITY_AH * share.clamp(0.0, 1.0), current_a: 0.0 }
    }

    /// Discharges the battery for `dt_s` with rotors at fractions of full speed.
    pub fn tick(&mut self, rotor_speed: [f64; 4], dt_s: f64) {
        let lift_w: f64 =
            rotor_speed.iter().map(|&s| POWER_PER_THRUST * thrust_n(s).max(0.0).powf(1.5)).sum();
        self.current_a = (lift_w + ELECTRONICS_W) / self.open_voltage_v();
        self.left_ah = (self.left_ah - self.current_a * dt_s / 3600.0).max(0.0);
    }

    /// Returns the voltage without load [V]: 4.2 V a cell if full, 3.3 V if empty.
    fn open_voltage_v(&self) -> f64 {
        CELLS * (3.3 + 0.9 * self.left_ah / CAPACITY_AH)
    }

    /// Returns the voltage under the present load [V].
    pub fn voltage_v(&self) -> f64 {
        self.open_voltage_v() - self.current_a * RESISTANCE_OHM
    }

    /// Returns the current [A].
    pub fn current_a(&self) -> f64 {
        self.current_a
    }
}

/// Returns the charge estimated from a voltage without load, 0 to 1.
pub fn fraction_of(voltage_v: f64) -> f64 {
    ((voltage_v / CELLS - 3.3) / 0.9).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motor::THRUST_TO_WEIGHT;

    #[test]
    fn hovers_for_some_minutes() {
        let mut battery = Battery::default();
        assert!((battery.voltage_v() - 16.8).abs() < 1e-9 && fraction_of(16.8) > 0.999);
        let hover = [(1.0 / THRUST_TO_WEIGHT).sqrt(); 4];
        let mut minutes = 0.0;
        while fraction_of(battery.voltage_v()) > 0.1 && minutes < 60.0 {
            battery.tick(hover, 1.0);
            minutes += 1.0 / 60.0;
        }
        assert!((5.0..20.0).contains(&minutes), "{minutes}");
    }
}
