//! Error-state Kalman filter: state, covariance, prediction over time, and updates by readings. History and
//! outlier rejection are in [`super::PoseFilter`].
//!
//! State: position, velocity and acceleration in the world, attitude, angular velocity in the body, and the
//! biases of gyroscope and accelerometer. Errors are additive, except for the attitude, whose error is a
//! rotation vector about the body's axes: `true = estimate * exp(error)` (Sola, 2017, "Quaternion kinematics
//! for the error-state Kalman filter", chapter 5 with local errors).
//!
//! Inertial readings are measurements of acceleration and angular velocity, not inputs of the motion model. So
//! one filter works with and without an IMU, without a switch when the autopilot falls silent. Without
//! readings, only the model applies: a decaying acceleration (Singer, 1970) and a constant rate of turn. Its
//! noise is learnt from the innovations of poses.
//!
//! Budget: 3 us for a pose, a step and two readings of three numbers. The covariance (`covariance.rs`) is 28 blocks of
//! 3 x 3 (2 KB). `cargo bench -p vizflyt-arena --bench pose` measures it.

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};

use super::PoseSigma;
use super::covariance::{
    A, ACCEL_BIAS, Covariance, GYRO_BIAS, P, R, Reading, Slope, V, W, squares,
};
use super::motion::Decay;

/// A drone in a room seldom accelerates harder: 30 degrees of tilt. [m/s^2]
const ACCELERATION_SIGMA_MPS2: f64 = 5.0;
/// Decay time of an acceleration: the time of a gate's corner. [s]
pub(super) const ACCELERATION_LASTS_S: f64 = 0.5;
/// Angular acceleration as white noise: within 50 ms the rate of turn may change by 0.7 rad/s.
/// [rad^2/s^3]
const TURN_DENSITY: f64 = 10.0;
/// Random walk of a MEMS gyroscope's bias. [rad^2/s^3]
const GYRO_BIAS_DENSITY: f64 = 1e-8;
/// Random walk of a MEMS accelerometer's bias. [m^2/s^5]
const ACCEL_BIAS_DENSITY: f64 = 1e-5;
/// Bias of a gyroscope that was calibrated at start-up. [rad/s]
const GYRO_BIAS_SIGMA_RADPS: f64 = 0.02;
/// Bias of an accelerometer, including the effect of a body frame turned by a degree. [m/s^2]
const ACCEL_BIAS_SIGMA_MPS2: f64 = 0.3;
/// Learning rate of the manoeuvre level: half in three poses, unless noise hides it.
const LEARNS: f64 = 0.2;
/// Minimum manoeuvre level: a hovering vehicle sways by a tenth of the hardest flight.
const LEAST_SHARE: f64 = 0.01;
/// Uncertainty of the motion at the first pose: covers any flight.
const FIRST_SPEED_MPS: f64 = 10.0;
const FIRST_TURN_RADPS: f64 = 5.0;
/// Maximum prediction; beyond it, the vehicle's state is unknown. [s]
const MAX_ADVANCE_S: f64 = 5.0;
/// Maximum step of the motion model; longer times are split. [s]
const STEP_S: f64 = 0.05;
/// [m/s^2, world]
const GRAVITY_MPS2: DVec3 = DVec3::new(0.0, 0.0, 9.80665);

/// Estimate of the vehicle's motion at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Estimate {
    pub p_world_m: DVec3,
    pub v_world_mps: DVec3,
    pub a_world_mps2: DVec3,
    pub rotation: DQuat,
    pub omega_body_radps: DVec3,
    gyro_bias_radps: DVec3,
    accel_bias_mps2: DVec3,
    covariance: Covariance,
    /// Manoeuvre level, for positions and attitudes: the share of the motion model's noise (that of the hardest
    /// flight) that explains the latest poses. 1 with an IMU, which measures the motion. [share of a variance]
    pushes: f64,
    turns: f64,
}

/// Innovation of a reading: its difference from the expected value.
#[derive(Clone, Copy, Debug)]
pub(super) struct Innovation {
    /// Reading minus expected value.
    pub residual: DVec3,
    /// Mahalanobis distance in standard deviations.
    pub sigmas: f64,
}

/// A manoeuvre that the model does not predict: deviation and duration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Manoeuvre {
    pub distance_m: f64,
    pub angle_rad: f64,
    pub dt_s: f64,
}

impl Estimate {
    /// Returns an estimate from a pose, without knowledge of the motion.
    pub(super) fn new(pose: &Pose<World, Body>, sigma: &PoseSigma) -> Self {
        let covariance = Covariance::of([
            sigma.position_m,
            DVec3::splat(FIRST_SPEED_MPS),
            DVec3::splat(ACCELERATION_SIGMA_MPS2),
            sigma.rotation_rad,
            DVec3::splat(FIRST_TURN_RADPS),
            DVec3::splat(GYRO_BIAS_SIGMA_RADPS),
            DVec3::splat(ACCEL_BIAS_SIGMA_MPS2),
        ]);
        Self {
            p_world_m: pose.translation_m,
            v_world_mps: DVec3::ZERO,
            a_world_mps2: DVec3::ZERO,
            rotation: pose.rotation.normalize(),
            omega_body_radps: DVec3::ZERO,
            gyro_bias_radps: DVec3::ZERO,
            accel_bias_mps2: DVec3::ZERO,
            covariance,
            pushes: 1.0,
            turns: 1.0,
        }
    }

    /// Takes over the sensors' biases of `former`, which do not depend on the position.
    pub(super) fn with_biases_of(mut self, former: &Self) -> Self {
        self.gyro_bias_radps = former.gyro_bias_radps;
        self.accel_bias_mps2 = former.accel_bias_mps2;
        for block in [GYRO_BIAS, ACCEL_BIAS] {
            *self.covariance.at(block, block) = former.covariance.block(block, block);
        }
        self
    }

    /// Returns a gyroscope's reading without the estimated bias. [rad/s, body]
    pub(super) fn without_bias(&self, gyro_radps: DVec3) -> DVec3 {
        gyro_radps - self.gyro_bias_radps
    }

    /// Whether the biases are larger than any sensor's: its axes are probably configured wrongly.
    pub(super) fn is_biased_beyond_belief(&self) -> bool {
        !(self.gyro_bias_radps.length() < 10.0 * GYRO_BIAS_SIGMA_RADPS
            && self.accel_bias_mps2.length() < 10.0 * ACCEL_BIAS_SIGMA_MPS2)
    }

    pub(super) fn pose(&self) -> Pose<World, Body> {
        Pose::new(self.p_world_m, self.rotation)
    }

    /// Returns the standard deviations of the pose.
    pub(super) fn sigma(&self) -> PoseSigma {
        PoseSigma { position_m: self.covariance.sigma(P), rotation_rad: self.covariance.sigma(R) }
    }

    /// Predicts over `dt_s`, at most [`MAX_ADVANCE_S`]: stamps come from outside, and the steps of a year would
    /// block every reader of the pose.
    pub(super) fn advance(&mut self, dt_s: f64) {
        let dt_s = dt_s.min(MAX_ADVANCE_S);
        let steps = (dt_s / STEP_S).ceil();
        if !(steps >= 1.0) {
            return;
        }
        for _ in 0..steps as u32 {
            self.step(dt_s / steps);
        }
    }

    fn step(&mut self, dt_s: f64) {
        let decay = Decay::after(dt_s);
        self.p_world_m += self.v_world_mps * dt_s + self.a_world_mps2 * decay.twice_s2;
        self.v_world_mps += self.a_world_mps2 * decay.once_s;
        self.a_world_mps2 *= decay.share;
        let turn = DQuat::from_scaled_axis(self.omega_body_radps * dt_s);
        self.rotation = (self.rotation * turn).normalize();
        self.covariance.advance(dt_s, &decay, &DMat3::from_quat(turn.conjugate()));
        // White jerk, and white angular acceleration, over the step.
        let jerk = self.pushes * 2.0 * ACCELERATION_SIGMA_MPS2.powi(2) / ACCELERATION_LASTS_S;
        let turn = self.turns * TURN_DENSITY;
        let dt2 = dt_s * dt_s;
        let dt3 = dt2 * dt_s;
        for (i, j, variance) in [
            (P, P, jerk * dt3 * dt2 / 20.0),
            (P, V, jerk * dt2 * dt2 / 8.0),
            (P, A, jerk * dt3 / 6.0),
            (V, V, jerk * dt3 / 3.0),
            (V, A, jerk * dt2 / 2.0),
            (A, A, jerk * dt_s),
            (R, R, turn * dt3 / 3.0),
            (R, W, turn * dt2 / 2.0),
            (W, W, turn * dt_s),
            (GYRO_BIAS, GYRO_BIAS, GYRO_BIAS_DENSITY * dt_s),
            (ACCEL_BIAS, ACCEL_BIAS, ACCEL_BIAS_DENSITY * dt_s),
        ] {
            self.covariance.add(i, j, variance);
        }
    }

    /// Returns the innovation of a position. [m, world]
    pub(super) fn position_innovation(&self, p_world_m: DVec3, variance_m2: DMat3) -> Innovation {
        self.innovation(&self.position_reading(p_world_m, variance_m2))
    }

    /// Returns the innovation of an attitude, as a rotation vector. [rad, body]
    pub(super) fn attitude_innovation(&self, rotation: DQuat, variance_rad2: DMat3) -> Innovation {
        self.innovation(&self.attitude_reading(rotation, variance_rad2))
    }

    /// Updates the estimate with a position. [m, world]
    pub(super) fn read_position(&mut self, p_world_m: DVec3, variance_m2: DMat3) {
        let reading = self.position_reading(p_world_m, variance_m2);
        self.pushes = self.read(&reading, self.pushes);
    }

    /// Updates the estimate with an attitude. [rad, body]
    pub(super) fn read_attitude(&mut self, rotation: DQuat, variance_rad2: DMat3) {
        let reading = self.attitude_reading(rotation, variance_rad2);
        self.turns = self.read(&reading, self.turns);
    }

    /// Updates the estimate with a gyroscope's reading if it is within `most_sigmas`; returns whether it was.
    /// [rad/s, body]
    pub(super) fn read_gyro(
        &mut self,
        gyro_radps: DVec3,
        sigma_radps: f64,
        most_sigmas: f64,
    ) -> bool {
        self.turns = 1.0;
        self.read_within(
            &Reading {
                residual: gyro_radps - self.omega_body_radps - self.gyro_bias_radps,
                slopes: [(W, Slope::One), (GYRO_BIAS, Slope::One)],
                variance: squares(DVec3::splat(sigma_radps)),
            },
            most_sigmas,
        )
    }

    /// Updates the estimate with an accelerometer's reading if it is within `most_sigmas`; returns whether it
    /// was. [m/s^2, body]
    pub(super) fn read_accel(
        &mut self,
        accel_mps2: DVec3,
        sigma_mps2: f64,
        most_sigmas: f64,
    ) -> bool {
        self.pushes = 1.0;
        let to_body = DMat3::from_quat(self.rotation.conjugate());
        let felt_mps2 = to_body * (self.a_world_mps2 + GRAVITY_MPS2);
        self.read_within(
            &Reading {
                residual: accel_mps2 - felt_mps2 - self.accel_bias_mps2,
                slopes: [
                    (A, Slope::Matrix(to_body)),
                    (R, Slope::Matrix(cross(felt_mps2))),
                    (ACCEL_BIAS, Slope::One),
                ],
                variance: squares(DVec3::splat(sigma_mps2)),
            },
            most_sigmas,
        )
    }

    /// Expects the hardest flight from this time on, even if the flight was calm.
    pub(super) fn expect_manoeuvre(&mut self) {
        (self.pushes, self.turns) = (1.0, 1.0);
        self.covariance.add(A, A, ACCELERATION_SIGMA_MPS2.powi(2));
        self.covariance.add(W, W, TURN_DENSITY * ACCELERATION_LASTS_S);
    }

    /// Inflates the covariance for a manoeuvre.
    pub(super) fn inflate_covariance(&mut self, manoeuvre: &Manoeuvre) {
        self.expect_manoeuvre();
        let Manoeuvre { distance_m, angle_rad, dt_s } = *manoeuvre;
        for (block, sigma) in
            [(P, distance_m), (V, distance_m / dt_s), (R, angle_rad), (W, angle_rad / dt_s)]
        {
            self.covariance.add(block, block, sigma * sigma);
        }
    }

    /// Whether every number is finite.
    pub(super) fn is_finite(&self) -> bool {
        self.p_world_m.is_finite()
            && self.v_world_mps.is_finite()
            && self.a_world_mps2.is_finite()
            && self.rotation.is_finite()
            && self.omega_body_radps.is_finite()
            && self.covariance.is_finite()
    }

    fn position_reading(&self, p_world_m: DVec3, variance: DMat3) -> Reading<1> {
        Reading { residual: p_world_m - self.p_world_m, slopes: [(P, Slope::One)], variance }
    }

    fn attitude_reading(&self, rotation: DQuat, variance: DMat3) -> Reading<1> {
        Reading {
            residual: shortest(self.rotation.conjugate() * rotation).to_scaled_axis(),
            slopes: [(R, Slope::One)],
            variance,
        }
    }

    fn innovation<const N: usize>(&self, reading: &Reading<N>) -> Innovation {
        let inverse = self.covariance.spread(reading).inverse();
        Innovation { residual: reading.residual, sigmas: sigmas(reading.residual, &inverse) }
    }

    fn read_within<const N: usize>(&mut self, reading: &Reading<N>, most_sigmas: f64) -> bool {
        let inverse = self.covariance.spread(reading).inverse();
        let within = sigmas(reading.residual, &inverse) <= most_sigmas;
        if within {
            self.correct(reading, &inverse);
        }
        within
    }

    /// Updates the estimate with a reading of a pose. Returns the new manoeuvre level; `share` is the old one.
    /// It is a step along the gradient of the reading's likelihood, so that innovations become as large as
    /// expected (Mehra, 1972, "Approaches to adaptive filtering").
    fn read<const N: usize>(&mut self, reading: &Reading<N>, share: f64) -> f64 {
        let spread = self.covariance.spread(reading);
        let inverse = spread.inverse();
        // Excludes the stamp's error times speed, which does not act along every axis: its absence is not a
        // sign of calm.
        let own = 3.0 * diagonal(&reading.variance).min_element();
        let by_motion = diagonal(&(spread - reading.variance)).element_sum();
        let surprise = reading.residual.length_squared() / (by_motion + own);
        let counts = by_motion / (by_motion + own);
        self.correct(reading, &inverse);
        (share * (1.0 + LEARNS * counts * (surprise - 1.0))).clamp(LEAST_SHARE, 1.0)
    }

    fn correct<const N: usize>(&mut self, reading: &Reading<N>, inverse: &DMat3) {
        let error = self.covariance.read(reading, inverse);
        self.p_world_m += error[P];
        self.v_world_mps += error[V];
        self.a_world_mps2 += error[A];
        self.rotation = (self.rotation * DQuat::from_scaled_axis(error[R])).normalize();
        self.omega_body_radps += error[W];
        self.gyro_bias_radps += error[GYRO_BIAS];
        self.accel_bias_mps2 += error[ACCEL_BIAS];
    }
}

fn diagonal(m: &DMat3) -> DVec3 {
    DVec3::new(m.x_axis.x, m.y_axis.y, m.z_axis.z)
}

/// Returns the same rotation by the shorter way.
pub(super) fn shortest(rotation: DQuat) -> DQuat {
    if rotation.w < 0.0 { -rotation } else { rotation }
}

fn sigmas(residual: DVec3, inverse: &DMat3) -> f64 {
    let squared = residual.dot(*inverse * residual);
    // A matrix that cannot be inverted carries no information: no reading is near.
    if squared >= 0.0 { squared.sqrt() } else { f64::INFINITY }
}

/// Returns the matrix of `u x`.
fn cross(u: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, u.z, -u.y),
        DVec3::new(-u.z, 0.0, u.x),
        DVec3::new(u.y, -u.x, 0.0),
    )
}
