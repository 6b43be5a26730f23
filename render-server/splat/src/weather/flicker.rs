//! Flicker of lamps on mains power, at twice the mains frequency, averaged over the exposure.

/// Flicker of lamps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flicker {
    /// Frequency of the mains, half of that of the light. [Hz]
    pub mains_hz: f32,
    /// Amplitude of the light as a share of its mean: about 0.3 for fluorescent tubes with a choke.
    pub depth: f32,
    /// Time from the first row's exposure to that of the last row; 0 for a global shutter. [s]
    pub readout_s: f32,
}

impl Flicker {
    /// Returns the light as a share of its mean, averaged over an exposure centred at an instant.
    /// [ns] [s]
    ///
    /// The mean of `1 + depth cos(2 pi f t)` over an exposure T is `1 + depth sinc(f T) cos(2 pi f
    /// t)`. An exposure of whole periods shows no flicker, which is why cameras expose for 10 ms
    /// where the mains have 50 Hz.
    pub fn light(&self, at_ns: i64, exposure_s: f32) -> f32 {
        let f_hz = 2.0 * f64::from(self.mains_hz);
        let half_turn = std::f64::consts::PI * f_hz * f64::from(exposure_s);
        let sinc = if half_turn > 1e-9 { half_turn.sin() / half_turn } else { 1.0 };
        let turns = (at_ns as f64 * 1e-9 * f_hz).rem_euclid(1.0);
        (1.0 + f64::from(self.depth) * sinc * (std::f64::consts::TAU * turns).cos()) as f32
    }

    /// Returns the light, as [`Self::light`] does, for a row of an image whose middle row is
    /// exposed at `at_ns`.
    pub(super) fn of_row(&self, at_ns: i64, exposure_s: f32, y: usize, height: usize) -> f32 {
        let later = ((y as f32 + 0.5) / height as f32 - 0.5) * self.readout_s;
        self.light(at_ns.wrapping_add((f64::from(later) * 1e9) as i64), exposure_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the power at a frequency of one second of light, sampled every millisecond.
    fn power(flicker: &Flicker, exposure_s: f32, f_hz: f64) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for ms in 0..1000_i64 {
            let light =
                f64::from(flicker.light(1_700_000_000_000_000_000 + ms * 1_000_000, exposure_s))
                    - 1.0;
            let turn = std::f64::consts::TAU * f_hz * ms as f64 * 1e-3;
            re += light * turn.cos();
            im += light * turn.sin();
        }
        (re * re + im * im).sqrt() / 500.0
    }

    #[test]
    fn flickers_at_twice_the_mains_frequency() {
        for mains_hz in [50.0, 60.0] {
            let flicker = Flicker { mains_hz, depth: 0.3, readout_s: 0.0 };
            let at = |f_hz: f64| power(&flicker, 1e-4, f_hz);
            assert!((at(2.0 * f64::from(mains_hz)) - 0.3).abs() < 1e-3);
            for other in [37.0, 50.0, 60.0, 150.0, 200.0] {
                assert!(at(other) < 1e-3, "{mains_hz}: {} at {other} Hz", at(other));
            }
        }
    }

    #[test]
    fn an_exposure_of_a_whole_period_shows_no_flicker() {
        let flicker = Flicker { mains_hz: 50.0, depth: 0.3, readout_s: 0.0 };
        assert!(power(&flicker, 0.010, 100.0) < 1e-4);
        // For half a period, the amplitude is sinc(1/2) = 2 / pi.
        assert!((power(&flicker, 0.005, 100.0) - 0.3 * std::f64::consts::FRAC_2_PI).abs() < 1e-3);
    }

    #[test]
    fn later_rows_have_the_light_of_a_later_instant() {
        let flicker = Flicker { readout_s: 0.010, mains_hz: 50.0, depth: 0.3 };
        let row = |y| flicker.of_row(3_141_592, 1e-4, y, 100);
        assert!((row(99) - row(0)).abs() < 0.05, "a readout of one period ends as it began");
        assert!((row(0) + row(50) - 2.0).abs() < 0.02, "half a period later it is the other way");
    }
}
