//! State estimator of the autopilot: IMU at 400 Hz in, pose and twist out. Corrected by external navigation (vision
//! poses from the companion) like ArduCopter's EKF3 with EK3_SRC1_* = 6.
//!
//! - Boot: the vehicle stands still for two seconds, in which tilt and gyro bias are measured.
//! - Vision without an origin: only heading. Vision with an origin: position, after a settling time ([`Startup`]).
//! - A late measurement is compared with the stored state of its time. The correction is applied to the present and to
//!   all stored states.
//! - Vision lost: the IMU continues; after a second, the barometer corrects the height; after 7.1 s, the horizontal
//!   position counts as lost (observed in a real ArduCopter).
//!
//! The filter is an error-state Kalman filter with the 15 errors of [`covariance`].

mod covariance;
mod stamp;

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World, wrap_pi, yaw_of};
use vizflyt_protocol::time::AutopilotTime;

use crate::airframe::GRAVITY_MPS2;
use crate::imu::{ACCEL_RANGE_MPS2, SensorSample};
use crate::startup::Startup;
use covariance::{ATTITUDE, Covariance, POSITION, VELOCITY};
use stamp::StampCorrector;

/// Standing time before the filter starts [s]. A real ArduCopter takes about 4 s, but waits for more than a lab has.
pub const ALIGN_S: f64 = 2.0;
/// Time without vision after which the position is lost [s].
pub const POSITION_LOST_S: f64 = 7.1;
/// Time without vision after which the barometer corrects the height [s].
const BARO_AFTER_S: f64 = 1.0;
/// Minimum interval of fused poses [s]: at most 50 a second, with a margin for rounded stamps.
const MIN_INTERVAL_S: f64 = 0.018;
/// Innovations of more than this many deviations are rejected (EK3_POS_I_GATE = 500 %).
const GATE: f64 = 5.0;
/// Added velocity deviation for a clipped accelerometer sample, which hides an unknown change of velocity [m/s].
const CLIPPED_MPS: f64 = 3.0;
/// Limits of position [m] and speed [m/s] beyond which the filter has diverged and is reset.
const ABSURD_M: f64 = 1e5;
const ABSURD_MPS: f64 = 300.0;
/// Duration of stored states for late measurements [s].
const HISTORY_S: f64 = 0.55;
/// IMU samples per prediction of the covariance: 100 Hz.
const SAMPLES_PER_PREDICTION: u32 = 4;

/// Measurement of external navigation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisionMeasurement {
    /// Measured pose.
    pub world_from_body: Pose<World, Body>,
    /// The sender's time stamp on its own clock [us]; 0 if it sends none.
    pub usec: u64,
    /// Incremented by the sender at each intended jump of its poses.
    pub reset_counter: u8,
    /// Standard deviation of the position [m].
    pub sigma_m: f64,
    /// Standard deviation of the heading [rad].
    pub sigma_rad: f64,
    /// Constant part of the latency (VISO_DELAY_MS) [s].
    pub latency_s: f64,
}

/// Present estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Position [m, world].
    pub p_world_m: DVec3,
    /// Velocity [m/s, world].
    pub v_world_mps: DVec3,
    /// Attitude, body to world.
    pub world_from_body: DQuat,
    /// Angular velocity without bias [rad/s, body].
    pub omega_body_radps: DVec3,
    /// Acceleration without gravity over the last sample [m/s^2, world].
    pub a_world_mps2: DVec3,
}

/// Validity of the parts of the estimate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EstimatorHealth {
    /// Whether tilt is known.
    pub attitude: bool,
    /// Whether vision poses arrive (VisOdom: healthy).
    pub vision: bool,
    /// Whether the origin is set.
    pub origin: bool,
    /// Whether horizontal position and velocity are known.
    pub position: bool,
}

#[derive(Clone, Copy, Debug)]
struct Past {
    stamp: AutopilotTime,
    p: DVec3,
    yaw: f64,
}

/// Error-state Kalman filter.
#[derive(Clone, Debug)]
pub struct Estimator {
    estimate: Estimate,
    gyro_bias: DVec3,
    accel_bias: DVec3,
    covariance: Covariance,
    history: VecDeque<Past>,
    align: Align,
    stamps: StampCorrector,
    origin: bool,
    /// Offset of the vision's height [m]; see [`Estimator::reset_height_datum`].
    height_offset_m: f64,
    yaw_known: bool,
    position: Position,
    reset_counter: u8,
    last_vision: Option<AutopilotTime>,
    last_measured: Option<AutopilotTime>,
    /// Last two measured positions [m, world].
    measured: [Option<(AutopilotTime, DVec3)>; 2],
    prediction: Prediction,
    baro: Baro,
    last_still: Option<AutopilotTime>,
    /// Duration of fused vision after which the position is valid [s].
    settle_s: f64,
}

/// Sums of the standing vehicle's sensors at boot.
#[derive(Clone, Debug, Default)]
struct Align {
    seconds: f64,
    samples: f64,
    accel: DVec3,
    gyro: DVec3,
    done: bool,
}

/// State of the horizontal position.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Position {
    Unknown,
    /// Fused since `since`, most recently at `last`.
    Fused {
        since: AutopilotTime,
        last: AutopilotTime,
    },
}

/// Sums between two predictions of the covariance.
#[derive(Clone, Copy, Debug, Default)]
struct Prediction {
    samples: u32,
    dt_s: f64,
    accel: DVec3,
    omega: DVec3,
}

/// Barometer relative to the vision's height.
#[derive(Clone, Copy, Debug, Default)]
struct Baro {
    sum_m: f64,
    samples: u32,
    datum_m: Option<f64>,
}

impl Default for Estimator {
    fn default() -> Self {
        Self {
            estimate: Estimate {
                p_world_m: DVec3::ZERO,
                v_world_mps: DVec3::ZERO,
                world_from_body: DQuat::IDENTITY,
                omega_body_radps: DVec3::ZERO,
                a_world_mps2: DVec3::ZERO,
            },
            gyro_bias: DVec3::ZERO,
            accel_bias: DVec3::ZERO,
            covariance: Covariance::new([1.0, 0.3, 0.03, 0.005, 0.05]),
            history: VecDeque::with_capacity((HISTORY_S * 400.0) as usize + 8),
            align: Align::default(),
            stamps: StampCorrector::default(),
            origin: false,
            height_offset_m: 0.0,
            yaw_known: false,
            position: Position::Unknown,
            reset_counter: 0,
            last_vision: None,
            last_measured: None,
            measured: [None; 2],
            prediction: Prediction::default(),
            baro: Baro::default(),
            last_still: None,
            settle_s: Startup::default().settle_s(),
        }
    }
}

impl Estimator {
    /// Returns an estimator with a start-up behaviour.
    pub fn new(startup: Startup) -> Self {
        Self { settle_s: startup.settle_s(), ..Self::default() }
    }

    pub fn estimate(&self) -> &Estimate {
        &self.estimate
    }

    /// Returns the validity of the estimate at `now`.
    pub fn health(&self, now: AutopilotTime) -> EstimatorHealth {
        EstimatorHealth {
            attitude: self.align.done,
            vision: self.last_vision.is_some_and(|t| now.seconds_since(t) < 0.5),
            origin: self.origin,
            position: matches!(self.position, Position::Fused { since, last }
                if last.seconds_since(since) >= self.settle_s),
        }
    }

    /// Returns the standard deviations of position [m], velocity [m/s] and heading [rad].
    pub fn sigmas(&self) -> (f64, f64, f64) {
        let sigma = |i| self.covariance.sigma(i);
        (sigma(POSITION), sigma(VELOCITY), sigma(ATTITUDE + 2))
    }

    /// Sets the origin. Returns `false` if the filter has not started or already has an origin.
    pub fn set_origin(&mut self) -> bool {
        let taken = self.align.done && !self.origin;
        self.origin |= taken;
        taken
    }

    /// Adds the present height to all later heights. ArduCopter does this when it reports "Field Elevation Set": the
    /// present height should become zero, but it is added instead of subtracted, so that 0.59 m became 1.17 m. Harmless
    /// at z = 0.
    pub fn reset_height_datum(&mut self) {
        let z = self.estimate.p_world_m.z;
        self.height_offset_m += z;
        self.estimate.p_world_m.z += z;
        for past in &mut self.history {
            past.p.z += z;
        }
        self.baro.datum_m = None;
    }

    /// Takes one sensor sample, `dt_s` after the last one. `still` means that the motors are off.
    pub fn handle_sensors(
        &mut self,
        now: AutopilotTime,
        sample: &SensorSample,
        dt_s: f64,
        still: bool,
    ) {
        if !(sample.accel_body_mps2.is_finite() && sample.gyro_body_radps.is_finite()) {
            return;
        }
        if !self.align.done {
            self.align(sample, dt_s);
            return;
        }
        self.integrate(sample, dt_s);
        let clipped = sample.accel_body_mps2.abs().max_element() > 0.98 * ACCEL_RANGE_MPS2;
        if clipped {
            for i in 0..3 {
                self.covariance.inflate_variance(VELOCITY + i, CLIPPED_MPS);
            }
        }
        self.recover();
        self.history.push_back(Past {
            stamp: now,
            p: self.estimate.p_world_m,
            yaw: yaw_of(self.estimate.world_from_body),
        });
        while self.history.front().is_some_and(|past| now.seconds_since(past.stamp) > HISTORY_S) {
            self.history.pop_front();
        }
        if let Position::Fused { last, .. } = self.position
            && now.seconds_since(last) > POSITION_LOST_S
        {
            self.position = Position::Unknown;
        }
        self.handle_baro(now, sample.baro_m);
        self.hold_still(now, still);
    }

    /// Records that external navigation sends, without using its pose.
    pub fn note_vision_alive(&mut self, now: AutopilotTime) {
        self.last_vision = Some(now);
    }

    /// Takes one pose from external navigation.
    pub fn handle_vision(&mut self, now: AutopilotTime, m: &VisionMeasurement) {
        let pose = &m.world_from_body;
        // A number may be finite but absurd.
        if !pose.is_valid() || pose.translation_m.abs().max_element() > ABSURD_M {
            return;
        }
        self.last_vision = Some(now);
        let valid_at = self.stamps.correct(m.usec, now).plus_seconds(-m.latency_s.clamp(0.0, 0.25));
        if !self.align.done
            || self.last_measured.is_some_and(|t| valid_at.seconds_since(t) < MIN_INTERVAL_S)
        {
            return;
        }
        self.last_measured = Some(valid_at);
        let Some(past) = self.past_at(valid_at) else { return };
        let jumped = m.reset_counter != self.reset_counter;
        self.reset_counter = m.reset_counter;

        self.fuse_yaw(yaw_of(pose.rotation), past.yaw, m.sigma_rad, jumped);
        if !self.origin {
            return;
        }
        let p = pose.translation_m + DVec3::Z * self.height_offset_m;
        self.measured.rotate_left(1);
        self.measured[1] = Some((valid_at, p));
        match self.position {
            Position::Fused { since, .. } if !jumped => {
                if self.fuse_position(now, p, past.p, m.sigma_m) {
                    self.position = Position::Fused { since, last: now };
                }
            }
            _ => {
                let since = match self.position {
                    Position::Fused { since, .. } => since,
                    Position::Unknown => now,
                };
                self.reset_position(p - past.p);
                if since == now {
                    self.reset_velocity(p, valid_at);
                }
                self.position = Position::Fused { since, last: now };
            }
        }
    }

    fn align(&mut self, sample: &SensorSample, dt_s: f64) {
        let a = &mut self.align;
        a.seconds += dt_s;
        a.samples += 1.0;
        a.accel += sample.accel_body_mps2;
        a.gyro += sample.gyro_body_radps;
        if a.seconds < ALIGN_S {
            return;
        }
        a.done = true;
        self.gyro_bias = a.gyro / a.samples;
        // The specific force of a vehicle at rest points up.
        let up_body = a.accel.normalize_or(DVec3::Z);
        self.estimate.world_from_body = DQuat::from_rotation_arc(up_body, DVec3::Z);
    }

    fn integrate(&mut self, sample: &SensorSample, dt_s: f64) {
        let omega = sample.gyro_body_radps - self.gyro_bias;
        let accel = sample.accel_body_mps2 - self.accel_bias;
        let e = &mut self.estimate;
        let half_turn = DQuat::from_scaled_axis(omega * (dt_s / 2.0));
        // The mean force acted at the mid-interval attitude.
        let midway = e.world_from_body * half_turn;
        let a_world = midway * accel - DVec3::Z * GRAVITY_MPS2;
        e.world_from_body = (midway * half_turn).normalize();
        e.p_world_m += e.v_world_mps * dt_s + a_world * (0.5 * dt_s * dt_s);
        e.v_world_mps += a_world * dt_s;
        e.a_world_mps2 = a_world;
        e.omega_body_radps = omega;

        let sums = &mut self.prediction;
        sums.samples += 1;
        sums.dt_s += dt_s;
        sums.accel += accel;
        sums.omega += omega;
        if sums.samples == SAMPLES_PER_PREDICTION {
            let n = f64::from(SAMPLES_PER_PREDICTION);
            let sums = std::mem::take(sums);
            let attitude = self.estimate.world_from_body;
            self.covariance.predict(attitude, sums.accel / n, sums.omega / n, sums.dt_s);
        }
    }

    /// Returns the stored state nearest to `stamp`; the oldest one for older stamps.
    fn past_at(&self, stamp: AutopilotTime) -> Option<Past> {
        let after = self.history.partition_point(|past| past.stamp < stamp);
        self.history.get(after).or(self.history.back()).copied()
    }

    fn fuse_yaw(&mut self, measured_rad: f64, past_rad: f64, sigma_rad: f64, jumped: bool) {
        let innovation = wrap_pi(measured_rad - past_rad);
        if !self.yaw_known || jumped {
            self.turn(innovation);
            self.covariance.reset(ATTITUDE + 2, sigma_rad);
            self.yaw_known = true;
            return;
        }
        let attitude = self.estimate.world_from_body;
        let nose = attitude * DVec3::X;
        let level = nose.x * nose.x + nose.y * nose.y;
        // A nearly vertical nose has no heading.
        if !(level > 0.1) {
            return;
        }
        // The change of atan2(n.y, n.x) by a small rotation in world axes, then in body axes.
        let by_world = DVec3::new(-nose.z * nose.x / level, -nose.z * nose.y / level, 1.0);
        let by_body = attitude.conjugate() * by_world;
        let row = [(ATTITUDE, by_body.x), (ATTITUDE + 1, by_body.y), (ATTITUDE + 2, by_body.z)];
        if self.covariance.normalized_innovation(&row, innovation, sigma_rad).abs() < GATE {
            self.covariance.fuse(&row, innovation, sigma_rad);
            self.apply(None);
        }
    }

    /// Rotates the estimate and all stored states about the vertical.
    fn turn(&mut self, angle_rad: f64) {
        let turn = DQuat::from_rotation_z(angle_rad);
        self.estimate.world_from_body = (turn * self.estimate.world_from_body).normalize();
        for past in &mut self.history {
            past.yaw = wrap_pi(past.yaw + angle_rad);
        }
    }

    fn fuse_position(&mut self, now: AutopilotTime, p: DVec3, past: DVec3, sigma_m: f64) -> bool {
        let innovation = p - past;
        let passes = (0..3).all(|i| {
            self.covariance
                .normalized_innovation(&[(POSITION + i, 1.0)], innovation[i], sigma_m)
                .abs()
                < GATE
        });
        if passes {
            for i in 0..3 {
                self.covariance.fuse(&[(POSITION + i, 1.0)], innovation[i], sigma_m);
            }
            self.apply(Some(now));
        }
        passes
    }

    fn reset_position(&mut self, shift: DVec3) {
        self.estimate.p_world_m += shift;
        for past in &mut self.history {
            past.p += shift;
        }
        for i in 0..3 {
            self.covariance.reset(POSITION + i, 0.1);
        }
        self.baro.datum_m = None;
    }

    /// Sets the velocity after a lost position is found again: from two vision positions, if available, because the
    /// velocity from only the IMU may be far off.
    fn reset_velocity(&mut self, p: DVec3, valid_at: AutopilotTime) {
        let Some((before, p_before)) = self.measured[0] else { return };
        let dt_s = valid_at.seconds_since(before);
        if !(dt_s > 0.005 && dt_s < 0.2) {
            return;
        }
        let v = (p - p_before) / dt_s;
        if v.length() < 30.0 {
            self.estimate.v_world_mps = v;
            for i in 0..3 {
                self.covariance.reset(VELOCITY + i, 1.0);
            }
        }
    }

    /// Restarts the filter if its state has become absurd: level and at rest, with the present heading if it is finite.
    fn recover(&mut self) {
        let e = &mut self.estimate;
        let sane = e.p_world_m.abs().max_element() < ABSURD_M
            && e.v_world_mps.abs().max_element() < ABSURD_MPS
            && e.p_world_m.is_finite()
            && e.v_world_mps.is_finite()
            && e.world_from_body.is_normalized()
            && self.covariance.is_finite();
        if sane {
            return;
        }
        let yaw_rad = yaw_of(e.world_from_body);
        let level = DQuat::from_rotation_z(if yaw_rad.is_finite() { yaw_rad } else { 0.0 });
        let fresh = Self::default();
        *self = Self {
            estimate: Estimate { world_from_body: level, ..fresh.estimate },
            align: Align { done: true, ..Align::default() },
            origin: self.origin,
            height_offset_m: self.height_offset_m,
            reset_counter: self.reset_counter,
            ..fresh
        };
    }

    /// Applies the accumulated correction to the estimate and to all stored states.
    fn apply(&mut self, now: Option<AutopilotTime>) {
        let [p, v, turn, gyro_bias, accel_bias] = self.covariance.take_correction();
        let e = &mut self.estimate;
        let yaw_before = yaw_of(e.world_from_body);
        e.p_world_m += p;
        e.v_world_mps += v;
        e.world_from_body = (e.world_from_body * DQuat::from_scaled_axis(turn)).normalize();
        self.gyro_bias = (self.gyro_bias + gyro_bias).clamp_length_max(0.2);
        self.accel_bias = (self.accel_bias + accel_bias).clamp_length_max(2.0);
        let turned = wrap_pi(yaw_of(e.world_from_body) - yaw_before);
        for past in &mut self.history {
            let age_s = now.map_or(0.0, |now| now.seconds_since(past.stamp));
            past.p += p - v * age_s;
            past.yaw = wrap_pi(past.yaw + turned);
        }
    }

    /// Averages the barometer to 25 Hz. With vision, estimates the barometer's datum; without vision, corrects the
    /// height.
    fn handle_baro(&mut self, now: AutopilotTime, baro_m: f64) {
        const SAMPLES: u32 = 16;
        const SIGMA_M: f64 = 0.25;
        const LEARN: f64 = 0.02;
        if !(baro_m.abs() < ABSURD_M) {
            return;
        }
        self.baro.sum_m += baro_m;
        self.baro.samples += 1;
        if self.baro.samples < SAMPLES {
            return;
        }
        let mean_m = self.baro.sum_m / f64::from(SAMPLES);
        (self.baro.sum_m, self.baro.samples) = (0.0, 0);
        let difference_m = mean_m - self.estimate.p_world_m.z;
        let vision_age_s = self.last_vision.map_or(f64::INFINITY, |t| now.seconds_since(t));
        match self.baro.datum_m {
            Some(datum_m) if vision_age_s > BARO_AFTER_S => {
                let row = [(POSITION + 2, 1.0)];
                self.covariance.fuse(&row, difference_m - datum_m, SIGMA_M);
                self.apply(None);
            }
            Some(datum_m) => self.baro.datum_m = Some(datum_m + LEARN * (difference_m - datum_m)),
            None => self.baro.datum_m = Some(difference_m),
        }
    }

    /// Stabilizes the tilt without a position: the velocity is zero when standing, and small on average in flight. 20
    /// Hz.
    fn hold_still(&mut self, now: AutopilotTime, still: bool) {
        if matches!(self.position, Position::Fused { .. })
            || self.last_still.is_some_and(|t| now.seconds_since(t) < 0.05)
        {
            return;
        }
        self.last_still = Some(now);
        let sigma_mps = if still { 0.05 } else { 3.0 };
        let axes = if still { 3 } else { 2 };
        for i in 0..axes {
            let innovation = -self.estimate.v_world_mps[i];
            self.covariance.fuse(&[(VELOCITY + i, 1.0)], innovation, sigma_mps);
        }
        self.apply(None);
        if still {
            // The position is unknown; prevent it from drifting before vision sets it.
            for i in 0..3 {
                self.covariance.reset(POSITION + i, 1.0);
            }
        }
    }
}

#[cfg(test)]
mod tests;
