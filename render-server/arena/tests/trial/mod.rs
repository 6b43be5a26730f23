//! Simulated flight with known truth and noisy measurements: error of images rendered with and without
//! prediction. Seeds are fixed.
//!
//! The vehicle flies a horizontal figure of eight, with 8 m/s^2 in the sharpest corner, like the demo's limits.
//! It leans into its corners, nose ahead. Images are rendered at 60 Hz and seen `pipeline_s` later; their error
//! is relative to the vehicle's true pose at that time.

use glam::{DMat3, DQuat, DVec3};
use vizflyt_arena::pose::{ImuReading, Measured, PoseFilter, PoseSigma};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

/// Parameters of flight and measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trial {
    /// Mean speed. [m/s]
    pub(crate) speed_mps: f64,
    /// Rate of poses. [Hz]
    pub(crate) rate_hz: f64,
    /// Position noise per axis. [m]
    pub(crate) sigma_m: f64,
    /// Attitude noise per axis. [deg]
    pub(crate) sigma_deg: f64,
    /// Time from a measurement to its arrival. [s]
    pub(crate) latency_s: f64,
    /// Time from the start of rendering until the image is seen. [s]
    pub(crate) pipeline_s: f64,
    /// Share of lost poses.
    pub(crate) dropout: f64,
    /// Whether to simulate the autopilot's IMU: 100 Hz, four readings per batch, 30 ms late.
    pub(crate) imu: bool,
}

impl Default for Trial {
    fn default() -> Self {
        Self {
            speed_mps: 5.0,
            rate_hz: 200.0,
            sigma_m: 0.000_3,
            sigma_deg: 0.1,
            latency_s: 0.005,
            pipeline_s: 0.03,
            dropout: 0.0,
            imu: false,
        }
    }
}

/// Errors of the images' poses, root mean square.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Errors {
    /// Rendered from the newest measurement. [m]
    pub(crate) measured_m: f64,
    /// Rendered from the prediction to the time at which the image is seen. [m]
    pub(crate) predicted_m: f64,
    /// Attitude error of the newest measurement. [deg]
    pub(crate) measured_deg: f64,
    /// Attitude error of the prediction. [deg]
    pub(crate) predicted_deg: f64,
    /// Share of the poses that were accepted.
    pub(crate) accepted: f64,
}

impl Errors {
    /// Returns the factor by which prediction reduces the position error.
    pub(crate) fn gain(&self) -> f64 {
        self.measured_m / self.predicted_m
    }
}

/// Path of the vehicle.
struct Path {
    half_m: f64,
    rate_radps: f64,
}

impl Path {
    fn new(speed_mps: f64) -> Self {
        // Mean speed and maximum acceleration of a horizontal eight (sin, 0.375 sin 2) of unit size and rate,
        // by numerical integration.
        let (mean, most) = (1..=10_000).fold((0.0, 0.0f64), |(sum, most), k| {
            let t = f64::from(k) * std::f64::consts::TAU / 10_000.0;
            let v = DVec3::new(t.cos(), 0.75 * (2.0 * t).cos(), 0.0).length();
            let a = DVec3::new(-t.sin(), -1.5 * (2.0 * t).sin(), 0.0).length();
            (sum + v / 10_000.0, most.max(a))
        });
        // v = mean s w, a = most s w^2.
        let rate_radps = 8.0 / most * mean / speed_mps;
        Self { half_m: speed_mps / (mean * rate_radps), rate_radps }
    }

    fn place(&self, t: f64) -> (DVec3, DVec3, DVec3) {
        let (w, a) = (self.rate_radps, self.rate_radps * t);
        let p = DVec3::new(a.sin(), 0.375 * (2.0 * a).sin(), 0.0);
        let v = DVec3::new(a.cos(), 0.75 * (2.0 * a).cos(), 0.0);
        let acceleration = DVec3::new(-a.sin(), -1.5 * (2.0 * a).sin(), 0.0);
        (p * self.half_m + DVec3::Z * 1.2, v * self.half_m * w, acceleration * self.half_m * w * w)
    }

    fn pose(&self, t: f64) -> Pose<World, Body> {
        let (p, v, a) = self.place(t);
        let up = (a + DVec3::Z * 9.80665).normalize();
        let left = up.cross(v).normalize();
        let ahead = left.cross(up);
        Pose::new(p, DQuat::from_mat3(&DMat3::from_cols(ahead, left, up)).normalize())
    }

    fn imu(&self, t: f64) -> (DVec3, DVec3) {
        let (before, after) = (self.pose(t - 1e-4).rotation, self.pose(t + 1e-4).rotation);
        let turn = before.conjugate() * after;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let (_, _, a) = self.place(t);
        let accel_mps2 = self.pose(t).rotation.conjugate() * (a + DVec3::Z * 9.80665);
        (accel_mps2, turn.to_scaled_axis() / 2e-4)
    }
}

/// Generator of noise: Knuth's, twelve uniform numbers for a Gaussian one.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 33) as f64 / f64::from(1u32 << 31)
    }

    fn gaussian3(&mut self) -> DVec3 {
        let mut one = || (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0;
        DVec3::new(one(), one(), one())
    }
}

enum Arrival {
    Pose(Measured),
    Imu(ImuReading),
    Draw,
}

fn at(t: f64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000).plus_seconds(t)
}

impl Trial {
    /// Flies for 20 s; the first second does not count.
    pub(crate) fn fly(&self, seed: u64) -> Errors {
        let path = Path::new(self.speed_mps);
        let mut arrivals = self.arrivals(&path, &mut Noise(seed));
        arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut filter = PoseFilter::default();
        let mut newest: Option<Pose<World, Body>> = None;
        let (mut came, mut accepted, mut images) = (0.0, 0.0, 0.0);
        let mut sums = [0.0; 4];
        for (t, arrival) in arrivals {
            match arrival {
                Arrival::Pose(measured) => {
                    came += 1.0;
                    if filter.handle_pose(&measured).is_ok() {
                        accepted += 1.0;
                        newest = Some(measured.world_from_body);
                    }
                }
                Arrival::Imu(reading) => filter.handle_imu(&reading),
                Arrival::Draw => {
                    let (Some(newest), true) = (newest, t > 1.0) else { continue };
                    let seen = t + self.pipeline_s;
                    let truth = path.pose(seen);
                    let predicted = filter.predict(at(seen)).expect("it has poses");
                    images += 1.0;
                    for (k, pose) in [newest, predicted].iter().enumerate() {
                        sums[k] += (pose.translation_m - truth.translation_m).length_squared();
                        let off_rad = pose.rotation.angle_between(truth.rotation);
                        sums[2 + k] += off_rad.to_degrees().powi(2);
                    }
                }
            }
        }
        let [measured_m, predicted_m, measured_deg, predicted_deg] =
            sums.map(|sum| (sum / images).sqrt());
        Errors { measured_m, predicted_m, measured_deg, predicted_deg, accepted: accepted / came }
    }

    fn arrivals(&self, path: &Path, noise: &mut Noise) -> Vec<(f64, Arrival)> {
        let mut arrivals = Vec::new();
        let sigma = PoseSigma {
            position_m: DVec3::splat(self.sigma_m),
            rotation_rad: DVec3::splat(self.sigma_deg.to_radians()),
        };
        for k in 0..(20.0 * self.rate_hz) as u32 {
            let t = f64::from(k) / self.rate_hz;
            if noise.uniform() < self.dropout {
                continue;
            }
            let truth = path.pose(t);
            let turned = DQuat::from_scaled_axis(noise.gaussian3() * self.sigma_deg.to_radians());
            let world_from_body = Pose::new(
                truth.translation_m + noise.gaussian3() * self.sigma_m,
                truth.rotation * turned,
            );
            let arrival = at(t + self.latency_s);
            let sigma = Some(sigma);
            let measured = Measured { arrival, sigma, ..Measured::new(at(t), world_from_body) };
            arrivals.push((t + self.latency_s, Arrival::Pose(measured)));
        }
        if self.imu {
            let (gyro_bias, accel_bias) =
                (DVec3::new(0.01, -0.01, 0.02), DVec3::new(0.1, 0.1, -0.2));
            for k in 0..2000u32 {
                let t = f64::from(k) * 0.01;
                let (true_accel_mps2, turn) = path.imu(t);
                let accel_mps2 = true_accel_mps2 + accel_bias + noise.gaussian3() * 0.3;
                let gyro_radps = turn + gyro_bias + noise.gaussian3() * 0.01;
                let reading = ImuReading { stamp: at(t), accel_mps2, gyro_radps };
                // Arrival of the last reading of its batch, plus transmission.
                let sent = f64::from(k / 4 * 4 + 3) * 0.01 + 0.03;
                arrivals.push((sent, Arrival::Imu(reading)));
            }
        }
        arrivals.extend((0..20 * 60).map(|k| (f64::from(k) / 60.0, Arrival::Draw)));
        arrivals
    }
}
