//! The exposure: how much light counts, by which shutter and gain, and the automatic one with its lag.

/// How one image is exposed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// How long each row is exposed. [s]
    pub shutter_s: f64,
    /// The sensor's analogue gain; 1 is where a full well fills the converter.
    pub gain: f64,
}

/// What decides the exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ExposureControl {
    /// Always the same.
    Fixed(Exposure),
    /// Follows the light.
    Auto {
        /// Mean linear light that is aimed at, 0 to 1 of full scale.
        aim: f64,
        /// Time constant of the lag: 63 % of a step are followed by then. [s]
        lag_s: f64,
        /// Shortest shutter. [s]
        least_shutter_s: f64,
        /// Longest shutter. [s]
        most_shutter_s: f64,
        /// Greatest gain.
        most_gain: f64,
    },
}

impl ExposureControl {
    /// Returns the exposure of an image `dt_s` after the last one. `mean` is the mean linear light of what is seen, `full_s`
    /// how long a light of 1 takes to fill the sensor at gain 1.
    ///
    /// Light counts `m = shutter gain / full_s` times; the automatic exposure wants `m = aim / mean`, follows with its lag, takes
    /// the longest shutter that it may and then the gain that it needs, as cameras do indoors; in bright light gain 1 and a
    /// shorter shutter.
    pub fn next(&self, follow: &mut Follow, mean: f64, full_s: f64, dt_s: f64) -> Exposure {
        match *self {
            Self::Fixed(exposure) => exposure,
            Self::Auto { aim, lag_s, least_shutter_s, most_shutter_s, most_gain } => {
                let limits = [least_shutter_s / full_s, most_shutter_s * most_gain / full_s];
                let times = follow.next(aim / mean.max(1e-6), limits, lag_s, dt_s);
                // Shutter and gain multiplied. [s]
                let both_s = times * full_s;
                let gain = (both_s / most_shutter_s).clamp(1.0, most_gain);
                let shutter_s = (both_s / gain).clamp(least_shutter_s, most_shutter_s);
                Exposure { shutter_s, gain }
            }
        }
    }
}

/// A factor that follows what is wanted, exponentially in its logarithm, as an automatic exposure does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Follow {
    /// Natural logarithm; absent before the first image.
    log: Option<f64>,
}

impl Follow {
    /// Returns the factor `dt_s` after the last one, wanted to be `wanted` within `limits`; the first is at once right.
    pub fn next(&mut self, wanted: f64, limits: [f64; 2], lag_s: f64, dt_s: f64) -> f64 {
        let wanted = libm::log(wanted.clamp(limits[0], limits[1]));
        let log = match self.log {
            None => wanted,
            Some(last) => last + (wanted - last) * (1.0 - libm::exp(-dt_s.max(0.0) / lag_s)),
        };
        self.log = Some(log);
        libm::exp(log)
    }
}

/// Returns how a lens darkens a place of the image, from -0.5 to 0.5 on both axes: 1 in the middle, `1 - vignette` in the corners.
#[inline]
pub fn vignetting(vignette: f32, u: f32, v: f32) -> f32 {
    1.0 - 2.0 * vignette * (u * u + v * v)
}

#[cfg(test)]
mod tests {
    use super::*;

    const AUTO: ExposureControl = ExposureControl::Auto {
        aim: 0.18,
        lag_s: 0.3,
        least_shutter_s: 1e-5,
        most_shutter_s: 0.01,
        most_gain: 8.0,
    };

    #[test]
    fn lag_is_its_time_constant_whatever_the_rate() {
        for rate_hz in [10.0, 30.0, 120.0] {
            let mut follow = Follow::default();
            let first = AUTO.next(&mut follow, 0.1, 0.01, 0.0);
            assert!((first.shutter_s * first.gain - 1.8 * 0.01).abs() < 1e-12, "{first:?}");
            // The light doubles; after a time constant 1 - 1/e of the step is done, in stops.
            let images = (0.3 * rate_hz) as u32;
            let last = (0..images)
                .map(|_| AUTO.next(&mut follow, 0.2, 0.01, 1.0 / rate_hz))
                .last()
                .unwrap();
            let stops = libm::log2(last.shutter_s * last.gain / (1.8 * 0.01));
            let expected = -(1.0 - libm::exp(-f64::from(images) / rate_hz / 0.3));
            assert!((stops - expected).abs() < 1e-9, "{rate_hz} Hz: {stops} stops, not {expected}");
        }
    }

    #[test]
    fn dark_takes_gain_and_bright_a_short_shutter() {
        let settled = |mean| AUTO.next(&mut Follow::default(), mean, 0.01, 0.0);
        let dim = settled(0.06);
        assert!(dim.shutter_s == 0.01 && (dim.gain - 3.0).abs() < 1e-12, "{dim:?}");
        let bright = settled(18.0);
        assert!(bright.gain == 1.0 && (bright.shutter_s - 1e-4).abs() < 1e-12, "{bright:?}");
        // Out of reach of both.
        for dark in [0.0, f64::NAN] {
            let Exposure { shutter_s, gain } = settled(dark);
            assert!((shutter_s - 0.01).abs() < 1e-12 && (gain - 8.0).abs() < 1e-9, "{gain}");
        }
        assert!((settled(1e9).shutter_s - 1e-5).abs() < 1e-15);
    }

    #[test]
    fn corners_lose_the_vignette() {
        assert_eq!(vignetting(0.3, 0.0, 0.0), 1.0);
        assert!((vignetting(0.3, 0.5, -0.5) - 0.7).abs() < 1e-6);
    }
}
