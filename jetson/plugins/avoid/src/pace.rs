//! How far apart images come, and how fast one may fly by them.
//!
//! Between two images the last answer stands: the vehicle flies on by what it saw before. A server that is short of its
//! processor sends a few images and then none for a tenth of a second; at 3.6 m/s that is 0.4 m, more than the way to
//! the next trunk.

/// The longest gap of late.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pace {
    longest_s: f64,
}

impl Pace {
    /// Takes the time since the last image. [s]
    pub fn add(&mut self, gap_s: f64) {
        let gap_s = gap_s.clamp(0.0, LONGEST_S);
        self.longest_s = gap_s.max(self.longest_s - FORGOTTEN_PER_S * gap_s);
    }

    /// Returns how much longer than usual an answer may stand before the next. [s]
    pub fn late_s(&self) -> f64 {
        (self.longest_s - USUAL_S).max(0.0)
    }

    /// Returns the speed at which the vehicle gets no further than [`WAY_M`] in that time. [m/s]
    pub fn limit_mps(&self) -> f64 {
        WAY_M / self.late_s()
    }
}

/// Gaps up to this are in [`crate::steer`]'s latency: a camera of 25 Hz. [s]
const USUAL_S: f64 = 0.04;
/// Beyond it the plugin is blind, and stops. [s]
const LONGEST_S: f64 = 0.3;
/// A gap is forgotten over seconds: what starves once does so again. [s/s]
const FORGOTTEN_PER_S: f64 = 0.1;
/// Two thirds of the clearance that is asked for at rest. [m]
const WAY_M: f64 = 0.2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_slow_down_and_are_forgotten() {
        let mut pace = Pace::default();
        for _ in 0..100 {
            pace.add(0.033);
        }
        assert_eq!((pace.late_s(), pace.limit_mps()), (0.0, f64::INFINITY));
        // A burst after a gap does not hide it.
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
