//! Pose filter of one vehicle: accepts or rejects measurements, and keeps the history for late ones.

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, Twist, World};
use vizflyt_protocol::messages::{PoseAges, PoseSample};
use vizflyt_protocol::time::ServerTime;

use super::covariance::squares;
use super::estimate::{Estimate, Manoeuvre};
use super::history::{History, Input, Record};
use super::motion::Motion;
use super::quality::{Fading, PoseQuality, Rejects};
use super::source::{ClaimKind, Comparison, Source, Surprise};
use super::{ImuReading, MAX_SOURCES, Measured, PoseConfig, PoseSigma, Rejected};

/// Change in the availability of poses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PoseChange {
    /// No accepted pose for this time [s], and the reason for the last rejection, if a measurement arrived.
    Lost(f64, Option<Rejected>),
    /// A pose was accepted again.
    Regained,
    /// Reset: the pose jumped by this distance [m] and angle [rad], and stayed there.
    Jumped(f64, f64),
    /// The IMU contradicts the poses and is excluded.
    ImuLeftOut,
}

/// The pose of one vehicle. See [the module](super).
#[derive(Clone, Debug)]
pub struct PoseFilter {
    config: PoseConfig,
    history: History,
    sources: [Source; MAX_SOURCES],
    newest: Option<PoseSample>,
    /// Reason for rejecting the last measurement, if it was rejected.
    rejected: Option<Rejected>,
    resets: u8,
    in_flight: bool,
    lost: bool,
    change: Option<PoseChange>,
    /// Reset that has not been polled yet.
    jumped: Option<PoseChange>,
    imu: Imu,
    /// Intervals of accepted poses, and their innovations. [standard deviations]
    accepted: Fading,
}

#[derive(Clone, Copy, Debug, Default)]
struct Imu {
    last: Option<ServerTime>,
    /// Rotation measured by the gyroscope since the start, without bias.
    turned: DQuat,
    read: u32,
    refused: u32,
    left_out: bool,
}

/// Decision about a measurement.
enum GateResult {
    Fits {
        sigmas: f64,
    },
    /// A calm vehicle began to manoeuvre at this time, within the limits of vehicles.
    Begins(ServerTime),
    /// A motion that the model did not predict.
    Manoeuvre(Manoeuvre),
    /// The pose changed for a reason other than motion.
    Reset {
        distance_m: f64,
        angle_rad: f64,
    },

    Rejected(Rejected),
}

impl Default for PoseFilter {
    fn default() -> Self {
        Self::new(&PoseConfig::default())
    }
}

impl PoseFilter {
    /// Returns a filter without any measurement.
    pub fn new(config: &PoseConfig) -> Self {
        Self {
            config: *config,
            history: History::default(),
            sources: Default::default(),
            newest: None,
            rejected: None,
            resets: 0,
            in_flight: false,
            lost: false,
            change: None,
            jumped: None,
            imu: Imu::default(),
            accepted: Fading::default(),
        }
    }

    /// Sets whether the vehicle is in the air. Sensor noise then makes every measurement differ from the one
    /// before, so repeated poses are not measurements. On the ground, the poses of a source that rounds may repeat.
    pub fn set_in_flight(&mut self, in_flight: bool) {
        self.in_flight = in_flight;
    }

    /// Processes a measurement; returns the newest sample if it is accepted. For a measurement older than that,
    /// the sample keeps its stamp and is recomputed. In flight, the sample is unchanged for a pose that repeats the
    /// one before it, for at most 0.15 s, and for the first pose after a loss.
    pub fn handle_pose(&mut self, measured: &Measured) -> Result<PoseSample, Rejected> {
        let index = usize::from(measured.source).min(MAX_SOURCES - 1);
        match self.take(index, measured) {
            Ok(None) => self.newest.ok_or(Rejected::Invalid),
            Ok(Some(sigmas)) => {
                if let Some((_, estimate)) = self.history.newest() {
                    self.sources[index].accept(measured, estimate, self.imu.turned);
                }
                self.accepted.add(measured.stamp, sigmas);
                self.rejected = None;
                if std::mem::take(&mut self.lost) {
                    self.change = Some(PoseChange::Regained);
                }
                let newest = self.history.newest_pose();
                let sample = newest.map(|(stamp, estimate)| self.sample(stamp, estimate));
                self.newest = sample.or(self.newest);
                self.newest.ok_or(Rejected::Invalid)
            }
            Err(reason) => {
                self.sources[index].reject(&reason);
                if reason != Rejected::Stale {
                    self.rejected = Some(reason);
                }
                Err(reason)
            }
        }
    }

    /// Returns the innovation of an accepted measurement in standard deviations; `None` if the measurement adds
    /// nothing.
    fn take(&mut self, index: usize, measured: &Measured) -> Result<Option<f64>, Rejected> {
        let pose = &measured.world_from_body;
        if !pose.is_valid() || pose.translation_m.abs().max_element() > FURTHEST_M {
            return Err(Rejected::Invalid);
        }
        self.sources[index].check_stamp(measured)?;
        if self.in_flight && measured.is_origin {
            return Err(Rejected::NotVisible);
        }
        match self.sources[index].compare(measured) {
            Comparison::Equal(since_s) if self.in_flight => {
                let repeated = Rejected::Repeated(since_s);
                // A source may send each pose twice.
                if since_s > REPEATS_S / 2.0 {
                    self.rejected = Some(repeated);
                }
                return if since_s > REPEATS_S { Err(repeated) } else { Ok(None) };
            }
            // A source that sends old poses may begin with any of them.
            Comparison::Different(age_s)
                if self.in_flight
                    && age_s > self.longest_interval_s(index, measured.stamp)
                    && self.is_lost(measured.stamp) =>
            {
                return Ok(None);
            }
            Comparison::Equal(_) | Comparison::Different(_) => {}
        }
        self.fuse(index, measured).map(Some)
    }

    /// Returns the maximum time between two poses of a source that has not repeated them. [s]
    fn longest_interval_s(&self, index: usize, now: ServerTime) -> f64 {
        REPEATS_S.max(1.6 / self.sources[index].rate_hz(now).max(1.0))
    }

    /// Fuses a measurement if it fits. Returns its innovation in standard deviations.
    fn fuse(&mut self, index: usize, measured: &Measured) -> Result<f64, Rejected> {
        let Measured { stamp, world_from_body: pose, .. } = *measured;
        let sigma = self.sigma(measured);
        let long_ago =
            self.newest.is_none_or(|newest| stamp.seconds_since(newest.stamp) > BEGIN_ANEW_AFTER_S);
        let still = Surprise {
            stamp,
            pose,
            is_turned: false,
            // No expectation yet.
            off_m: DVec3::INFINITY,
            off_rad: DVec3::INFINITY,
            v_world_mps: DVec3::ZERO,
            omega_body_radps: DVec3::ZERO,
            noise_m: 0.0,
            noise_rad: 0.0,
        };
        if long_ago && self.sources[index].pending(&still).is_none() {
            let noise = self.sources[index].noise_factor();
            self.begin(stamp, &pose, &sigma.times(noise));
            return Ok(0.0);
        }
        if !self.history.reaches(stamp) {
            return Err(Rejected::Stale);
        }
        let imu = &mut self.imu;
        let prior = self.history.at(stamp, |estimate, record| imu.fuse(estimate, record));
        let Some(prior) = prior else { return Err(Rejected::Stale) };
        let begins = self.sources[index].add(stamp, &pose, &sigma);
        let noise = self.sources[index].noise_factor();
        let result = self.judge(index, measured, &sigma, &prior, begins);
        let taken = match result {
            GateResult::Fits { sigmas } if begins => {
                self.begin(stamp, &pose, &sigma.times(noise));
                return Ok(sigmas);
            }
            GateResult::Fits { sigmas } => {
                self.put(stamp, &pose, self.variances(&sigma, &prior, noise), None);
                Ok(sigmas)
            }
            GateResult::Begins(since) => {
                self.history.change(since, Estimate::expect_manoeuvre);
                self.put(stamp, &pose, self.variances(&sigma, &prior, noise), None);
                Ok(self.config.gate_sigmas)
            }
            GateResult::Manoeuvre(manoeuvre) => {
                self.put(stamp, &pose, self.variances(&sigma, &prior, noise), Some(manoeuvre));
                Ok(self.config.gate_sigmas)
            }
            GateResult::Reset { distance_m, angle_rad } => {
                self.jumped = Some(PoseChange::Jumped(distance_m, angle_rad));
                self.resets = self.resets.wrapping_add(1);
                self.begin(stamp, &pose, &sigma.times(noise));
                return Ok(self.config.gate_sigmas);
            }
            GateResult::Rejected(reason) => Err(reason),
        };
        self.settle();
        if self.history.newest().is_some_and(|(_, estimate)| !estimate.is_finite()) {
            // Should not happen. The measurement is better than no pose at all.
            self.begin(stamp, &pose, &sigma);
        }
        taken
    }

    /// Fuses the readings that arrived since the last request for a pose.
    fn settle(&mut self) {
        let imu = &mut self.imu;
        self.history.settle(|estimate, record| imu.fuse(estimate, record));
        if self.imu.read < IMU_TRIAL || self.imu.left_out {
            return;
        }
        let newest = self.history.newest();
        let biased = newest.is_some_and(|(_, newest)| newest.is_biased_beyond_belief());
        if biased || 2 * self.imu.refused > self.imu.read {
            self.imu.left_out = true;
            self.change.get_or_insert(PoseChange::ImuLeftOut);
        }
        (self.imu.read, self.imu.refused) = (0, 0);
    }

    fn judge(
        &mut self,
        index: usize,
        measured: &Measured,
        sigma: &PoseSigma,
        prior: &Estimate,
        begins: bool,
    ) -> GateResult {
        let Measured { stamp, world_from_body: pose, .. } = *measured;
        if let Err(frozen) = self.sources[index].check_frozen(measured, self.imu.turned) {
            return GateResult::Rejected(frozen);
        }
        let noise = self.sources[index].noise_factor();
        let (variance_m2, variance_rad2) = self.variances(sigma, prior, noise);
        let place = prior.position_innovation(pose.translation_m, variance_m2);
        let attitude = prior.attitude_innovation(pose.rotation, variance_rad2);
        let sigmas = place.sigmas.max(attitude.sigmas);
        let gate = self.config.gate_sigmas;
        let surprise = Surprise {
            stamp,
            pose,
            is_turned: attitude.sigmas > place.sigmas,
            off_m: place.residual,
            off_rad: attitude.residual,
            v_world_mps: prior.v_world_mps,
            omega_body_radps: prior.omega_body_radps,
            noise_m: sigma.position_m.max_element() * noise.sqrt(),
            noise_rad: sigma.rotation_rad.max_element() * noise.sqrt(),
        };
        let trusted = self.sources.iter().enumerate().find(|(other, source)| {
            let age_s = source.accepted_at.map(|at| stamp.seconds_since(at).abs());
            *other != index && age_s.is_some_and(|age_s| age_s < TRUSTED_FOR_S)
        });
        let (distance_m, angle_rad) = (place.residual.length(), attitude.residual.length());
        // The gate widens while no pose is accepted. Therefore a pose also counts as a jump if it is closer to
        // what several rejected poses claimed than to the expectation.
        let jumped = trusted.is_none()
            && self.sources[index]
                .pending(&surprise)
                .is_some_and(|claim| claim.count >= 2 && claim.explains(&surprise));
        if sigmas <= gate && !jumped {
            return GateResult::Fits { sigmas };
        }
        if let Some((other, _)) = trusted {
            let other = other as u8;
            return GateResult::Rejected(Rejected::Disagree { other, distance_m, angle_rad });
        }
        let newest = self.newest.map_or(stamp, |newest| newest.stamp);
        let dt_s = stamp.seconds_since(newest).abs().max(MIN_DT_S);
        let began = self.manoeuvre_began(index, measured, sigma);
        let is_small = distance_m <= HARMLESS_M && angle_rad <= HARMLESS_RAD;
        if let Some(since) = began.filter(|_| is_small && !jumped) {
            return GateResult::Begins(since);
        }
        let speed_mps = distance_m / dt_s;
        // A gyroscope would have measured the turn.
        let measured_turn = self.imu_is_fresh(stamp) && angle_rad > MEASURABLE_RAD;
        let flips = attitude.sigmas > gate && (measured_turn || angle_rad / dt_s > MAX_TURN_RADPS);
        let leaps = place.sigmas > gate && speed_mps > MAX_MANOEUVRE_MPS;
        let kind = if leaps {
            ClaimKind::Leap
        } else if flips {
            ClaimKind::Flip
        } else {
            ClaimKind::Shift
        };
        // Until the noise of the source is known, accept everything within the reach of a manoeuvre.
        if kind <= ClaimKind::Shift && (begins || !self.sources[index].is_known()) {
            return GateResult::Fits { sigmas: sigmas.min(gate) };
        }
        let (claim, moves) = self.sources[index].claim(&surprise, kind);
        // Two poses are enough if they follow each other closely, or if they are within the gate of the hardest
        // flight and move on. Outliers seldom look like such a motion.
        let close =
            claim.lasted_s() <= CLOSE_S / 2.0 || began.is_some() && claim.grows_to(&surprise);
        let enough = if close { 2 } else { CONFIRMED };
        if moves && claim.count >= enough || is_small && claim.count >= 2 {
            return match began {
                Some(since) => GateResult::Begins(since),
                None => GateResult::Manoeuvre(Manoeuvre { distance_m, angle_rad, dt_s }),
            };
        }
        let lasted_s = claim.lasted_s();
        let stays = claim.count >= JUMP_CONFIRMED && lasted_s >= JUMP_LASTS_S
            || claim.count >= CONFIRMED && (lasted_s >= JUMP_LASTS_LONG_S || sigmas <= gate);
        match claim.kind {
            ClaimKind::Shift | ClaimKind::Leap if stays => {
                GateResult::Reset { distance_m, angle_rad }
            }
            ClaimKind::Flip if lasted_s >= self.config.flip_accept_delay_s => {
                GateResult::Reset { distance_m, angle_rad }
            }
            ClaimKind::Flip => GateResult::Rejected(Rejected::Flip(angle_rad)),
            ClaimKind::Shift if claim.count >= 2 && !moves => {
                GateResult::Rejected(Rejected::Jump { distance_m, speed_mps })
            }
            ClaimKind::Leap => GateResult::Rejected(Rejected::Jump { distance_m, speed_mps }),
            ClaimKind::Shift => GateResult::Rejected(Rejected::Outlier(sigmas)),
        }
    }

    /// Returns the time since which the vehicle must have manoeuvred for this pose to be within the gate of the
    /// hardest flight; `None` if the pose is outside of that gate too.
    fn manoeuvre_began(
        &mut self,
        index: usize,
        measured: &Measured,
        sigma: &PoseSigma,
    ) -> Option<ServerTime> {
        let Measured { stamp, world_from_body: pose, .. } = *measured;
        let accepted_at = self.sources[index].accepted_at.unwrap_or(stamp);
        let since = stamp.plus_seconds(-MANOEUVRE_SEEN_S).min(accepted_at);
        let imu = &mut self.imu;
        let fuse = |estimate: &mut Estimate, record: &Record| imu.fuse(estimate, record);
        let prior = self.history.at_after(stamp, since, Estimate::expect_manoeuvre, fuse)?;
        let (variance_m2, variance_rad2) =
            self.variances(sigma, &prior, self.sources[index].noise_factor());
        let place = prior.position_innovation(pose.translation_m, variance_m2);
        let attitude = prior.attitude_innovation(pose.rotation, variance_rad2);
        (place.sigmas.max(attitude.sigmas) <= self.config.gate_sigmas).then_some(since)
    }

    /// Clears the history and restarts with this pose.
    fn begin(&mut self, stamp: ServerTime, pose: &Pose<World, Body>, sigma: &PoseSigma) {
        let former = self.history.newest().map(|(_, estimate)| *estimate);
        let fresh = Estimate::new(pose, sigma);
        let estimate = former
            .filter(Estimate::is_finite)
            .map_or(fresh, |former| fresh.with_biases_of(&former));
        let input = Input::Pose {
            p_world_m: pose.translation_m,
            rotation: pose.rotation,
            variance_m2: squares(sigma.position_m),
            variance_rad2: squares(sigma.rotation_rad),
            manoeuvre: None,
        };
        self.history.begin(stamp, input, &estimate);
    }

    fn put(
        &mut self,
        stamp: ServerTime,
        pose: &Pose<World, Body>,
        (variance_m2, variance_rad2): (DMat3, DMat3),
        manoeuvre: Option<Manoeuvre>,
    ) {
        let (p_world_m, rotation) = (pose.translation_m, pose.rotation);
        let input = Input::Pose { p_world_m, rotation, variance_m2, variance_rad2, manoeuvre };
        let imu = &mut self.imu;
        self.history.put(stamp, input, |estimate, record| imu.fuse(estimate, record));
    }

    /// Returns the standard deviations to use: the source's own, within limits, or the configured ones.
    fn sigma(&self, measured: &Measured) -> PoseSigma {
        let settings = self.config.sigma();
        let stated = measured.sigma.filter(|sigma| {
            let least = sigma.position_m.min_element().min(sigma.rotation_rad.min_element());
            sigma.position_m.is_finite() && sigma.rotation_rad.is_finite() && least > 0.0
        });
        let sigma = stated.unwrap_or(settings);
        PoseSigma {
            position_m: sigma.position_m.clamp(DVec3::splat(1e-5), DVec3::splat(10.0)),
            rotation_rad: sigma.rotation_rad.clamp(DVec3::splat(1e-5), DVec3::splat(3.0)),
        }
    }

    /// Returns the variances of a measurement: its own, multiplied by the source's noise factor, plus the
    /// effect of the stamp's error on a moving vehicle. [m^2, world], [rad^2, body]
    fn variances(&self, sigma: &PoseSigma, prior: &Estimate, noise: f64) -> (DMat3, DMat3) {
        let moved_m = prior.v_world_mps * self.config.stamp_sigma_s;
        let turned_rad = prior.omega_body_radps * self.config.stamp_sigma_s;
        let outer = |v: DVec3| DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        (
            squares(sigma.position_m) * noise + outer(moved_m),
            squares(sigma.rotation_rad) * noise + outer(turned_rad),
        )
    }

    /// Records a reading of the autopilot's IMU. Readings that are too old, or arrive before the first pose,
    /// are dropped. The fusion waits until a pose is requested: readings arrive late and in groups, and each
    /// would repeat the fusion of all newer ones.
    pub fn handle_imu(&mut self, reading: &ImuReading) {
        let ImuReading { stamp, accel_mps2, gyro_radps } = *reading;
        let plausible = accel_mps2.is_finite()
            && gyro_radps.is_finite()
            && accel_mps2.length() < MAX_ACCEL_MPS2
            && gyro_radps.length() < MAX_GYRO_RADPS;
        let newer = self.imu.last.is_none_or(|last| stamp > last);
        let known = self.newest.is_some_and(|newest| {
            stamp.seconds_since(newest.stamp) < BEGIN_ANEW_AFTER_S && self.history.reaches(stamp)
        });
        if !self.config.imu || self.imu.left_out || !(plausible && newer && known) {
            return;
        }
        if let (Some(last), Some((_, estimate))) = (self.imu.last, self.history.newest()) {
            let dt_s = stamp.seconds_since(last).min(MAX_IMU_GAP_S);
            let turn = DQuat::from_scaled_axis(estimate.without_bias(gyro_radps) * dt_s);
            self.imu.turned = (self.imu.turned * turn).normalize();
        }
        self.imu.last = Some(stamp);
        let input = Input::Imu { accel_mps2, gyro_radps };
        let imu = &mut self.imu;
        self.history.put(stamp, input, |estimate, record| imu.fuse(estimate, record));
    }

    /// Detects silence. Call at [`Self::poll_timeout`].
    pub fn handle_timeout(&mut self, now: ServerTime) {
        if let (Some(newest), Some(due)) = (self.newest, self.poll_timeout())
            && now >= due
        {
            self.lost = true;
            let age_s = now.seconds_since(newest.stamp);
            self.change = Some(PoseChange::Lost(age_s, self.rejected));
        }
    }

    /// Returns the time of the next call of [`Self::handle_timeout`]; `None` while poses are lost, and before
    /// the first one.
    pub fn poll_timeout(&self) -> Option<ServerTime> {
        let newest = self.newest.filter(|_| !self.lost)?;
        // A nanosecond later: the sum is rounded.
        let lost_s = self.config.hold_after_s + f64::from(newest.allowance_s);
        Some(newest.stamp.plus_seconds(lost_s).plus_ns(1))
    }

    /// Whether no pose has been accepted for too long at `now`.
    fn is_lost(&self, now: ServerTime) -> bool {
        self.lost || self.poll_timeout().is_some_and(|due| now >= due)
    }

    /// Returns the time by which a pose may exceed the configured age before it is lost, for the source with
    /// the smallest allowance. [s]
    fn allowance_s(&self, now: ServerTime) -> f64 {
        let PoseConfig { hold_after_s, land_after_s, .. } = self.config;
        let ages = PoseAges { hold_after_s, land_after_s };
        let timings = self.sources.iter().filter_map(|source| source.timing(now));
        let of_each = timings.map(|(delay_s, interval_s)| ages.allowance_s(delay_s, interval_s));
        of_each.reduce(f64::min).unwrap_or(0.0)
    }

    /// Returns each change once. Call until it returns `None`.
    pub fn poll_change(&mut self) -> Option<PoseChange> {
        self.change.take().or_else(|| self.jumped.take())
    }

    /// Returns the newest accepted pose.
    pub fn newest(&self) -> Option<&PoseSample> {
        self.newest.as_ref()
    }

    /// Returns the motion by all readings.
    pub fn motion(&mut self) -> Option<Motion> {
        self.settle();
        self.history.newest().map(|(stamp, estimate)| Motion::of(stamp, estimate))
    }

    /// Returns the pose at another time, at most 0.2 s from the newest reading.
    pub fn predict(&mut self, at: ServerTime) -> Option<Pose<World, Body>> {
        Some(self.motion()?.at(at))
    }

    /// Returns how good the localization is at `now`.
    pub fn quality(&self, now: ServerTime) -> PoseQuality {
        let Some(newest) = self.newest else { return PoseQuality::default() };
        let sources = self.sources.iter().enumerate();
        let sigma = self.history.newest_pose().map(|(_, estimate)| estimate.sigma());
        PoseQuality {
            age_ms: Some(now.seconds_since(newest.stamp) * 1e3),
            rate_hz: self.accepted.rate_hz(now),
            position_sigma_mm: sigma.map_or(0.0, |s| s.position_m.max_element() * 1e3),
            rotation_sigma_deg: sigma.map_or(0.0, |s| s.rotation_rad.max_element().to_degrees()),
            innovation_sigmas: self.accepted.value(),
            speed_mps: newest.twist.linear_mps.length(),
            imu: self.imu_is_fresh(newest.stamp),
            resets: self.resets,
            sources: sources.filter_map(|(i, source)| source.quality(i as u8, now)).collect(),
        }
    }

    /// Returns the number of rejected measurements of all sources, by reason.
    pub fn rejected(&self) -> Rejects {
        self.sources.iter().fold(Rejects::default(), |sum, source| sum.and(source.rejected()))
    }

    fn imu_is_fresh(&self, stamp: ServerTime) -> bool {
        let age_s = self.imu.last.map(|last| stamp.seconds_since(last));
        !self.imu.left_out && age_s.is_some_and(|age_s| age_s < IMU_SILENT_S)
    }

    fn sample(&self, stamp: ServerTime, estimate: &Estimate) -> PoseSample {
        let sigma = estimate.sigma();
        PoseSample {
            stamp,
            world_from_body: estimate.pose(),
            twist: Twist {
                linear_mps: estimate.v_world_mps,
                angular_radps: estimate.omega_body_radps,
            },
            resets: self.resets,
            position_sigma_m: sigma.position_m.as_vec3(),
            rotation_sigma_rad: sigma.rotation_rad.as_vec3(),
            allowance_s: self.allowance_s(stamp) as f32,
        }
    }
}

impl Imu {
    /// Fuses a reading, and counts IMU readings that are fused for the first time.
    fn fuse(&mut self, estimate: &mut Estimate, record: &Record) {
        match record.input {
            Input::Pose { p_world_m, rotation, variance_m2, variance_rad2, manoeuvre } => {
                if let Some(manoeuvre) = &manoeuvre {
                    estimate.inflate_covariance(manoeuvre);
                }
                estimate.read_position(p_world_m, variance_m2);
                estimate.read_attitude(rotation, variance_rad2);
            }
            Input::Imu { accel_mps2, gyro_radps } => {
                let turned = estimate.read_gyro(gyro_radps, GYRO_SIGMA_RADPS, IMU_GATE_SIGMAS);
                let pushed = estimate.read_accel(accel_mps2, ACCEL_SIGMA_MPS2, IMU_GATE_SIGMAS);
                if !record.is_known {
                    self.read += 1;
                    self.refused += u32::from(!(turned && pushed));
                }
            }
        }
    }
}

/// Maximum distance from the origin: no room is larger. [m]
const FURTHEST_M: f64 = 1e4;
/// After a longer pause, the filter restarts without the former motion. [s]
const BEGIN_ANEW_AFTER_S: f64 = 1.0;
/// Time for which a pose may repeat in flight: two equal poses at 10 Hz. [s]
const REPEATS_S: f64 = 0.15;
/// A source accepted within this time has priority over others that disagree. [s]
const TRUSTED_FOR_S: f64 = 0.15;
/// Measurements closer together contain no information about speed. [s]
const MIN_DT_S: f64 = 1e-4;
/// Maximum change of speed by a bump or a hard stop; faster drones do not fly in rooms. [m/s]
pub(super) const MAX_MANOEUVRE_MPS: f64 = 15.0;
/// Racing drones turn at 2000 degrees per second. [rad/s]
pub(super) const MAX_TURN_RADPS: f64 = 35.0;
/// Above this angle, the gyroscope overrules the measured attitude: its drift is far less. [rad]
const MEASURABLE_RAD: f64 = 0.2;
/// A jump that lasts for this number of measurements and this time is accepted (a moved origin, a regained
/// object); over a longer time, fewer measurements are enough. [s]
const JUMP_CONFIRMED: u32 = 5;
const JUMP_LASTS_S: f64 = 0.015;
const JUMP_LASTS_LONG_S: f64 = 0.095;
/// One or two deviating measurements are outliers; a third one that continues them is a motion.
const CONFIRMED: u32 = 3;
/// Time in which a filter that expects a calm flight detects any other: by then, a hard start is 3 cm off. [s]
const MANOEUVRE_SEEN_S: f64 = 0.1;
/// A smaller deviation counts as the start of a manoeuvre at once, and never as a jump: an outlier of that size
/// does little harm. [m], [rad]
const HARMLESS_M: f64 = 0.03;
const HARMLESS_RAD: f64 = 0.1;
/// Duration of two intervals in which a motion is so short that two outliers seldom look like one. [s]
const CLOSE_S: f64 = 0.03;
/// Noise of a flight controller's gyroscope with the motors running. [rad/s]
const GYRO_SIGMA_RADPS: f64 = 0.03;
/// Noise of a flight controller's accelerometer with the motors running: mostly vibration. [m/s^2]
const ACCEL_SIGMA_MPS2: f64 = 0.6;
/// Gate for single inertial readings; readings outside are dropped.
const IMU_GATE_SIGMAS: f64 = 6.0;
/// Sensors saturate beyond 16 g and 2300 degrees per second. [m/s^2], [rad/s]
const MAX_ACCEL_MPS2: f64 = 160.0;
const MAX_GYRO_RADPS: f64 = 40.0;
/// Readings further apart are not integrated. [s]
const MAX_IMU_GAP_S: f64 = 0.1;
/// Number of readings after which the IMU as a whole is checked: two seconds.
const IMU_TRIAL: u32 = 200;
/// An IMU that is silent for longer is not used. [s]
const IMU_SILENT_S: f64 = 0.3;
