//! Wind: a steady part, and gusts as first-order Gauss-Markov noise per axis. For a hovering vehicle, that is Dryden's
//! longitudinal spectrum (MIL-F-8785C, 3.7.2.2).

use glam::DVec3;

use crate::noise::Noise;

/// Correlation time of gusts [s]: fans and doors in a hall, not weather.
const CORRELATION_S: f64 = 0.8;
/// Ratio of vertical to horizontal gusts: floor and ceiling are near.
const VERTICAL_SHARE: f64 = 0.5;

/// Wind at the vehicle.
#[derive(Clone, Debug)]
pub struct Wind {
    steady_world_mps: DVec3,
    gust_sigma_mps: f64,
    gust_world_mps: DVec3,
    noise: Noise,
}

impl Wind {
    /// Returns a wind with a steady velocity [m/s, world] and gusts of a standard deviation along each horizontal axis
    /// [m/s].
    pub fn new(seed: u64, steady_world_mps: DVec3, gust_sigma_mps: f64) -> Self {
        Self {
            steady_world_mps,
            gust_sigma_mps,
            gust_world_mps: DVec3::ZERO,
            noise: Noise::new(seed, 3),
        }
    }

    /// Changes the steady part [m/s, world].
    pub fn set_steady(&mut self, steady_world_mps: DVec3) {
        self.steady_world_mps = steady_world_mps;
    }

    /// Returns the wind `dt_s` later [m/s, world].
    pub fn tick(&mut self, dt_s: f64) -> DVec3 {
        if self.gust_sigma_mps > 0.0 {
            let kept = (-dt_s / CORRELATION_S).exp();
            let sigma = DVec3::new(1.0, 1.0, VERTICAL_SHARE) * self.gust_sigma_mps;
            // Keeps the variance for every step size.
            let push = self.noise.gaussian3() * sigma * (1.0 - kept * kept).sqrt();
            self.gust_world_mps = self.gust_world_mps * kept + push;
        }
        self.steady_world_mps + self.gust_world_mps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gusts_have_the_configured_deviation_and_correlation() {
        let mut wind = Wind::new(1, DVec3::new(1.0, 0.0, 0.0), 2.0);
        let samples: Vec<DVec3> = (0..400_000).map(|_| wind.tick(0.01)).collect();
        let mean = samples.iter().sum::<DVec3>() / samples.len() as f64;
        let about = |lag: usize| {
            let pairs = samples.iter().zip(&samples[lag..]);
            let sum: DVec3 = pairs.map(|(a, b)| (*a - mean) * (*b - mean)).sum();
            sum / (samples.len() - lag) as f64
        };
        assert!((mean - DVec3::X).length() < 0.2, "{mean}");
        let (variance, after_one) = (about(0), about(80));
        assert!((variance.x.sqrt() / 2.0 - 1.0).abs() < 0.05, "{variance}");
        assert!((variance.z.sqrt() - 1.0).abs() < 0.05, "{variance}");
        // After one correlation time, the correlation is 1/e.
        assert!((after_one.x / variance.x - (-1f64).exp()).abs() < 0.06, "{after_one}");
    }

    #[test]
    fn wind_without_gusts_is_steady() {
        let mut wind = Wind::new(1, DVec3::Y, 0.0);
        assert!((0..100).all(|_| wind.tick(0.0025) == DVec3::Y));
    }
}
