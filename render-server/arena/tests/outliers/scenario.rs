//! Simulated flight with known truth, measured with outliers: accepted poses and resulting error. Seeds are
//! fixed.

use glam::{DQuat, DVec3};
use vizflyt_arena::pose::{ImuReading, Measured, PoseChange, PoseFilter, PoseSigma, Rejected};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::time::ServerTime;

/// Parameters of flight and measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scenario {
    pub(crate) seed: u64,
    /// Rate of poses. [Hz]
    pub(crate) rate_hz: f64,
    /// Noise of positions; attitudes have 0.5 degrees for 5 mm. [m]
    pub(crate) noise_m: f64,
    /// Whether measurements contain their sigma.
    pub(crate) sent: bool,
    /// Number of consecutive outliers.
    pub(crate) burst: usize,
    /// Whether the outliers of a burst are at the same false position.
    pub(crate) agree: bool,
    pub(crate) flight: Flight,
    /// Whether to simulate the autopilot's IMU: 100 Hz, four readings per batch, 30 ms late.
    pub(crate) imu: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Flight {
    Hover,
    /// A figure of eight at up to 1.5 m/s.
    Eight,
    /// Back and forth by 1.5 m in a second, at up to 8.7 m/s^2 and 90 m/s^3, with a second of hover in between.
    Dashes,
}

/// A measurement and its result.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Taken {
    /// Time of the measurement. [s]
    pub(crate) t: f64,
    /// True pose, in the frame of the measurements.
    pub(crate) truth: Pose<World, Body>,
    /// Size of the outlier; 0 for a true pose. [m]
    pub(crate) off_m: f64,
    pub(crate) result: Result<PoseSample, Rejected>,
}

/// Result of a scenario.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    pub(crate) taken: Vec<Taken>,
    /// Changes reported during the run.
    pub(crate) changes: Vec<PoseChange>,
}

pub(crate) struct Noise(pub(crate) u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }

    pub(crate) fn normal3(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }

    /// Returns an outlier of 0.05 to 5 m in any direction, each decade equally likely.
    fn outlier(&mut self) -> DVec3 {
        self.normal3().normalize_or(DVec3::X) * 0.05 * 100f64.powf(self.uniform())
    }
}

fn at(seconds: f64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000).plus_seconds(seconds)
}

impl Scenario {
    fn truth(&self, t: f64) -> Pose<World, Body> {
        let dash = |s: f64| {
            let u = s.clamp(0.0, 1.0);
            1.5 * u.powi(3) * (10.0 - 15.0 * u + 6.0 * u * u)
        };
        match self.flight {
            Flight::Hover => return Pose::new(DVec3::Z, DQuat::IDENTITY),
            Flight::Dashes => {
                let s = t.rem_euclid(4.0);
                let p = DVec3::new(dash(s - 1.0) - dash(s - 3.0), 0.0, 1.0);
                return Pose::new(p, DQuat::IDENTITY);
            }
            Flight::Eight => {}
        }
        let p = DVec3::new((0.9 * t).sin(), 0.5 * (1.8 * t).sin(), 1.0 + 0.2 * (0.7 * t).cos());
        Pose::new(p, DQuat::from_rotation_z(0.6 * (0.5 * t).sin()))
    }

    /// Returns IMU readings with the noise and biases of a flight controller, and the arrival time of each. [s]
    fn readings(&self, noise: &mut Noise) -> Vec<(f64, ImuReading)> {
        let count = if self.imu { (POSES as f64 / self.rate_hz * 100.0) as u32 } else { 0 };
        let read = |k: u32| {
            const H: f64 = 1e-3;
            let t = 0.01 * f64::from(k);
            let [before, now, after] = [-H, 0.0, H].map(|h| self.truth(t + h));
            let bent_m = before.translation_m + after.translation_m - 2.0 * now.translation_m;
            let felt_mps2 = now.rotation.conjugate() * (bent_m / (H * H) + DVec3::Z * 9.80665);
            let turned = (before.rotation.conjugate() * after.rotation).to_scaled_axis();
            let reading = ImuReading {
                stamp: at(t),
                accel_mps2: felt_mps2 + DVec3::new(0.1, 0.1, -0.2) + noise.normal3() * 0.3,
                gyro_radps: turned / (2.0 * H)
                    + DVec3::new(0.01, -0.01, 0.02)
                    + noise.normal3() * 0.01,
            };
            // Arrival of the last reading of its batch, plus transmission.
            (f64::from(k / 4 * 4 + 3) * 0.01 + 0.03, reading)
        };
        (0..count).map(read).collect()
    }

    /// Runs [`POSES`] poses, of which `share` start a burst of outliers; `jump_m` moves the origin after
    /// [`JUMP_AT`].
    pub(crate) fn run(&self, share: f64, jump_m: DVec3) -> Outcome {
        let mut noise = Noise(self.seed);
        let mut faults = Noise(self.seed ^ 0x9e37_79b9_7f4a_7c15);
        let readings = self.readings(&mut Noise(self.seed ^ 0x2545_f491_4f6c_dd1d));
        let mut readings = readings.iter().peekable();
        let mut filter = PoseFilter::default();
        let mut outcome = Outcome::default();
        let (mut left, mut pause, mut off) = (0, 0u32, DVec3::ZERO);
        for i in 0..POSES {
            let t = i as f64 / self.rate_hz;
            while let Some((_, reading)) = readings.next_if(|(arrives, _)| *arrives <= t) {
                filter.handle_imu(reading);
            }
            let truth = self.truth(t);
            let rotation_rad = self.noise_m * 1.75;
            let turned = DQuat::from_scaled_axis(noise.normal3() * rotation_rad);
            let moved = if i >= JUMP_AT { jump_m } else { DVec3::ZERO };
            let truth = Pose::new(truth.translation_m + moved, truth.rotation);
            let p = truth.translation_m + noise.normal3() * self.noise_m;
            if left == 0 && pause == 0 && i >= SETTLED && faults.uniform() < share {
                (left, pause, off) = (self.burst, 3, faults.outlier());
            }
            let false_m = if left > 0 { off } else { DVec3::ZERO };
            if left > 0 {
                left -= 1;
                off = if self.agree { off } else { faults.outlier() };
            } else {
                pause = pause.saturating_sub(1);
            }
            let sigma = PoseSigma {
                position_m: DVec3::splat(self.noise_m),
                rotation_rad: DVec3::splat(rotation_rad),
            };
            let sent = Pose::new(p + false_m, truth.rotation * turned);
            let measured =
                Measured { sigma: self.sent.then_some(sigma), ..Measured::new(at(t), sent) };
            filter.handle_timeout(at(t));
            let result = filter.handle_pose(&measured);
            outcome.changes.extend(std::iter::from_fn(|| filter.poll_change()));
            outcome.taken.push(Taken { t, truth, off_m: false_m.length(), result });
        }
        outcome
    }
}

impl Outcome {
    /// Returns the number of outliers.
    pub(crate) fn outliers(&self) -> usize {
        self.taken.iter().filter(|taken| taken.off_m > 0.0).count()
    }

    /// Returns the sizes of the outliers that were accepted. [m]
    pub(crate) fn accepted_outliers(&self) -> impl Iterator<Item = f64> {
        let accepted = self.taken.iter().filter(|taken| taken.off_m > 0.0 && taken.result.is_ok());
        accepted.map(|taken| taken.off_m)
    }

    /// Returns the number of rejected true poses.
    pub(crate) fn left_out(&self) -> usize {
        self.taken.iter().filter(|taken| taken.off_m == 0.0 && taken.result.is_err()).count()
    }

    pub(crate) fn resets(&self) -> u8 {
        self.taken
            .iter()
            .filter_map(|taken| taken.result.ok())
            .next_back()
            .map_or(0, |last| last.resets)
    }

    pub(crate) fn lost(&self) -> usize {
        self.changes.iter().filter(|change| matches!(change, PoseChange::Lost(..))).count()
    }

    /// Returns the fused poses after the filter has settled, with their time and the true pose.
    pub(crate) fn fused(&self) -> impl Iterator<Item = (f64, PoseSample, Pose<World, Body>)> {
        let settled = self.taken.iter().skip(SETTLED);
        settled.filter_map(|taken| Some((taken.t, taken.result.ok()?, taken.truth)))
    }

    /// Returns the absolute trajectory error: root of the mean square, of positions. [m]
    pub(crate) fn ate_m(&self) -> f64 {
        let off = |(_, sample, truth): (f64, PoseSample, Pose<World, Body>)| {
            (sample.world_from_body.translation_m - truth.translation_m).length_squared()
        };
        let (sum, count) = self.fused().map(off).fold((0.0, 0.0), |(s, n), o| (s + o, n + 1.0));
        (sum / f64::max(count, 1.0)).sqrt()
    }
}

/// Number of poses per run: two seconds at 200 Hz.
pub(crate) const POSES: usize = 400;
/// Number of poses before the first outlier.
pub(crate) const SETTLED: usize = 40;
/// Index of the pose at which the origin moves.
pub(crate) const JUMP_AT: usize = 200;
