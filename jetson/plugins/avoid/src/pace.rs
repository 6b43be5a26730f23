//! Limits the speed by the intervals between images.
//!
//! Between two images the last setpoint stays in force, so the vehicle flies with old information. An overloaded server
//! sends a few images and then none for 0.1 s. At 3.6 m/s that is 0.36 m, more than the distance to the next trunk.

/// Longest recent gap between images.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pace {
    longest_s: f64,
}

impl Pace {
    /// Adds the time since the last image. [s]
    pub fn add(&mut self, gap_s: f64) {
        let gap_s = gap_s.clamp(0.0, LONGEST_S);
        self.longest_s = gap_s.max(self.longest_s - FORGOTTEN_PER_S * gap_s);
    }

    /// Returns the additional time for which a setpoint may stay in force, compared with the usual interval. [s]
    pub fn late_s(&self) -> f64 {
        (self.longest_s - USUAL_S).max(0.0)
    }

    /// Returns the speed at which the vehicle flies at most [`WAY_M`] in that time. [m/s]
    pub fn limit_mps(&self) -> f64 {
        WAY_M / self.late_s()
    }
}

/// Intervals up to this are included in the latency of [`crate::steer`]: a camera at 25 Hz. [s]
const USUAL_S: f64 = 0.04;
/// After a longer gap the plugin is blind and stops. [s]
const LONGEST_S: f64 = 0.3;
/// Decay of the longest gap, over seconds, because gaps usually come in series. [s/s]
const FORGOTTEN_PER_S: f64 = 0.1;
/// Two thirds of the desired clearance at rest. [m]
const WAY_M: f64 = 0.2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_reduce_the_speed_and_decay() {
        let mut pace = Pace::default();
        for _ in 0..100 {
            pace.add(0.033);
        }
        assert_eq!((pace.late_s(), pace.limit_mps()), (0.0, f64::INFINITY));
        // A burst after a gap does not hide the gap.
        for gap_s in [0.11, 0.01, 0.01, 0.01] {
            pace.add(gap_s);
        }
        assert!((pace.late_s() - 0.067).abs() < 1e-9, "{}", pace.late_s());
        assert!((2.9..3.1).contains(&pace.limit_mps()), "{}", pace.limit_mps());
        for _ in 0..60 {
            pace.add(0.02);
        }
        assert_eq!(pace.late_s(), 0.0);
    }
}
