//! Exposure: shutter, gain, and automatic exposure with its lag.

/// Exposure of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Exposure time of each row. [s]
    pub shutter_s: f64,
    /// Analogue gain of the sensor; at 1, a full well fills the range of the converter.
    pub gain: f64,
}

/// Exposure control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ExposureControl {
    /// Constant exposure.
    Fixed(Exposure),
    /// Automatic exposure.
    Auto {
        /// Target mean linear light, 0 to 1 of full scale.
        aim: f64,
        /// Time constant of the lag, after which 63 % of a step are reached. [s]
        lag_s: f64,
        /// Minimum shutter time. [s]
        least_shutter_s: f64,
        /// Maximum shutter time. [s]
        most_shutter_s: f64,
        /// Maximum gain.
        most_gain: f64,
    },
}

impl ExposureControl {
    /// Returns the exposure of an image `dt_s` after the last one. `mean` is the mean linear light of the scene,
    /// `full_s` the time in which a light of 1 fills the sensor at gain 1.
    ///
    /// Light is multiplied by `m = shutter gain / full_s`. Automatic exposure aims at `m = aim / mean` and follows
    /// with its lag. Like cameras indoors, it prefers the longest shutter and then increases the gain; in bright
    /// light it uses gain 1 and a shorter shutter.
    pub fn next(&self, follow: &mut Follow, mean: f64, full_s: f64, dt_s: f64) -> Exposure {
        match *self {
            Self::Fixed(exposure) => exposure,
            Self::Auto { aim, lag_s, least_shutter_s, most_shutter_s, most_gain } => {
                let limits = [least_shutter_s / full_s, most_shutter_s * most_gain / full_s];
                let times = follow.next(aim / mean.max(1e-6), limits, lag_s, dt_s);
                // Product of shutter and gain. [s]
                let both_s = times * full_s;
                let gain = (both_s / most_shutter_s).clamp(1.0, most_gain);
                let shutter_s = (both_s / gain).clamp(least_shutter_s, most_shutter_s);
                Exposure { shutter_s, gain }
            }
        }
    }
}

/// Factor that follows a target exponentially in its logarithm, like automatic exposure.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Follow {
    /// Natural logarithm; `None` before the first image.
    log: Option<f64>,
}

impl Follow {
    /// Returns the factor `dt_s` after the last one. The target is `wanted`, clamped to `limits`; the first call
    /// returns it without lag.
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

/// Returns the relative light at a place of the image, from -0.5 to 0.5 on both axes: 1 in the middle, `1 - vignette`
/// in the corners.
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
    fn lag_does_not_depend_on_the_frame_rate() {
        for rate_hz in [10.0, 30.0, 120.0] {
            let mut follow = Follow::default();
            let first = AUTO.next(&mut follow, 0.1, 0.01, 0.0);
            assert!((first.shutter_s * first.gain - 1.8 * 0.01).abs() < 1e-12, "{first:?}");
            // The light doubles; after one time constant, 1 - 1/e of the step is reached, in stops.
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
    fn raises_gain_in_the_dark_and_shortens_the_shutter_in_bright_light() {
        let settled = |mean| AUTO.next(&mut Follow::default(), mean, 0.01, 0.0);
        let dim = settled(0.06);
        assert!(dim.shutter_s == 0.01 && (dim.gain - 3.0).abs() < 1e-12, "{dim:?}");
        let bright = settled(18.0);
        assert!(bright.gain == 1.0 && (bright.shutter_s - 1e-4).abs() < 1e-12, "{bright:?}");
        // Beyond the limits of both.
        for dark in [0.0, f64::NAN] {
            let Exposure { shutter_s, gain } = settled(dark);
            assert!((shutter_s - 0.01).abs() < 1e-12 && (gain - 8.0).abs() < 1e-9, "{gain}");
        }
        assert!((settled(1e9).shutter_s - 1e-5).abs() < 1e-15);
    }

    #[test]
    fn corners_are_darker_by_the_vignette() {
        assert_eq!(vignetting(0.3, 0.0, 0.0), 1.0);
        assert!((vignetting(0.3, 0.5, -0.5) - 0.7).abs() < 1e-6);
    }
}
