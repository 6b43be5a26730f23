//! State of one source of poses, to distinguish a bad measurement from a bad prediction.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

use super::estimate::{Estimate, shortest};
use super::filter::{MAX_MANOEUVRE_MPS, MAX_TURN_RADPS};
use super::quality::{Fading, Rejects, SourceQuality};
use super::{Measured, PoseSigma, Rejected};

/// Rejected poses that agree with each other.
#[derive(Clone, Copy, Debug)]
pub(super) struct Claim {
    pub kind: ClaimKind,
    /// Time of the first of them, and its deviation from the expected pose. [m, world], [rad, body]
    since: ServerTime,
    first_off_m: DVec3,
    first_off_rad: DVec3,
    /// Whether the attitude deviates more than the position.
    is_turned: bool,
    newest: ServerTime,
    pose: Pose<World, Body>,
    pub count: u32,
}

/// Kind of deviation; the worst of the poses counts.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub(super) enum ClaimKind {
    /// Outside of the gate, within the reach of a manoeuvre.
    Shift,
    /// Further than vehicles fly in the time.
    Leap,
    /// Turned faster than vehicles turn.
    Flip,
}

/// A pose that does not fit, with the expected state at its time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surprise {
    pub stamp: ServerTime,
    pub pose: Pose<World, Body>,
    /// Deviation from the expected pose. [m, world], [rad, body]
    pub off_m: DVec3,
    pub off_rad: DVec3,
    /// Whether the attitude deviates more than the position.
    pub is_turned: bool,
    /// Expected velocity and angular velocity. [m/s, world], [rad/s, body]
    pub v_world_mps: DVec3,
    pub omega_body_radps: DVec3,
    /// One standard deviation of the measurement. [m], [rad]
    pub noise_m: f64,
    pub noise_rad: f64,
}

/// The last accepted pose, while it is repeated.
#[derive(Clone, Copy, Debug)]
struct Still {
    since: ServerTime,
    pose: Pose<World, Body>,
    /// Speed and turn rate of the vehicle at its first occurrence. [m/s], [rad/s]
    speed_mps: f64,
    turn_radps: f64,
    /// Rotation measured by the gyroscope at that time.
    turned: DQuat,
}

/// Comparison of a measurement with the one before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Comparison {
    /// Equal to all measurements for this time. [s]
    Equal(f64),
    /// Different, this time after the first occurrence of the pose before; infinite for the first measurement. [s]
    Different(f64),
}

#[derive(Clone, Debug, Default)]
pub(super) struct Source {
    last: Option<(ServerTime, ServerTime)>,
    /// Newest pose that differs from the one before it, and its stamp.
    changed: Option<(ServerTime, Pose<World, Body>)>,
    still: Option<Still>,
    claim: Option<Claim>,
    pub accepted_at: Option<ServerTime>,
    accepted: u64,
    rejected: Rejects,
    latency: Fading,
    noise: Noise,
}

/// Noise of the source's measurements, estimated by medians: a few outliers have no effect, however large.
#[derive(Clone, Debug, Default)]
struct Noise {
    /// The last two measurements.
    last: Option<(ServerTime, Pose<World, Body>)>,
    step: Option<Increment>,
    /// Squared deviation of each measurement from the line through the two before it, for positions and
    /// attitudes. The median is 1 if the noise is as stated and the vehicle does not manoeuvre.
    places: Window,
    attitudes: Window,
}

/// Difference between consecutive measurements.
#[derive(Clone, Copy, Debug)]
struct Increment {
    dt_s: f64,
    moved_m: DVec3,
    turned_rad: DVec3,
}

/// The last values, for their median.
#[derive(Clone, Debug, Default)]
struct Window(VecDeque<f64>);

impl Window {
    fn push(&mut self, value: f64) {
        if self.0.len() == WINDOW {
            self.0.pop_front();
        }
        self.0.push_back(value);
    }

    /// Returns the median, or 0 if there is no value.
    fn median(&self) -> f64 {
        let mut values = [0.0; WINDOW];
        let count = self.0.len().min(WINDOW);
        for (to, from) in values.iter_mut().zip(&self.0) {
            *to = *from;
        }
        match count {
            0 => 0.0,
            _ => *values[..count].select_nth_unstable_by(count / 2, f64::total_cmp).1,
        }
    }
}

impl Noise {
    fn add(&mut self, stamp: ServerTime, pose: &Pose<World, Body>, sigma: &PoseSigma) {
        let Some((at, from)) = self.last.replace((stamp, *pose)) else { return };
        let step = Increment {
            dt_s: stamp.seconds_since(at),
            moved_m: pose.translation_m - from.translation_m,
            turned_rad: shortest(from.rotation.conjugate() * pose.rotation).to_scaled_axis(),
        };
        // Only steps of similar duration show a deviation from the line.
        let former = self.step.replace(step);
        let Some(former) = former.filter(|former| {
            (0.5..2.0).contains(&(step.dt_s / former.dt_s)) && step.dt_s < CLAIM_LASTS_S
        }) else {
            return;
        };
        let share = step.dt_s / former.dt_s;
        // Variances of the three measurements: 1 for the newest, `(1 + share)^2` for the middle one, `share^2`
        // for the first.
        let weight = MEDIAN_SQUARE * (1.0 + (1.0 + share).powi(2) + share * share);
        let add = |window: &mut Window, beside: DVec3, usual: f64, sigma: f64| {
            let by_motion = usual * step.dt_s * step.dt_s;
            let square = (beside.length_squared() - by_motion * by_motion).max(0.0);
            window.push(square / (weight * sigma * sigma));
        };
        let beside_m = step.moved_m - former.moved_m * share;
        let beside_rad = step.turned_rad - former.turned_rad * share;
        add(&mut self.places, beside_m, USUAL_MPS2, sigma.position_m.max_element());
        add(&mut self.attitudes, beside_rad, USUAL_RADPS2, sigma.rotation_rad.max_element());
    }

    fn is_known(&self) -> bool {
        self.places.0.len() >= TRIAL
    }

    /// Returns the factor for the variances: 1 while measurements scatter as their sigmas state.
    fn factor(&self) -> f64 {
        let square = self.places.median().max(self.attitudes.median());
        if square > NOISY_SQUARE { square.min(MAX_FACTOR) } else { 1.0 }
    }
}

impl Source {
    /// Checks the stamp against arrival and earlier stamps.
    pub(super) fn check_stamp(&mut self, measured: &Measured) -> Result<(), Rejected> {
        let Measured { stamp, arrival, .. } = *measured;
        let latency_s = arrival.seconds_since(stamp);
        if !(-EARLY_S..=LATE_S).contains(&latency_s) {
            return Err(Rejected::Clock(latency_s));
        }
        if let Some((last, last_arrival)) = self.last
            && stamp <= last
        {
            let back_s = last.seconds_since(stamp);
            let jumped = back_s > CLOCK_JUMP_S && arrival > last_arrival;
            return Err(if jumped { Rejected::ClockJump(back_s) } else { Rejected::Stale });
        }
        if self.last.is_some_and(|(last, _)| stamp.seconds_since(last) < MIN_APART_S) {
            return Err(Rejected::Stale);
        }
        self.last = Some((stamp, arrival));
        self.latency.add(arrival, latency_s);
        Ok(())
    }

    /// Compares a measurement, accepted or not, with the one before it.
    pub(super) fn compare(&mut self, measured: &Measured) -> Comparison {
        let Measured { stamp, world_from_body: pose, resolution, .. } = *measured;
        let age_s = self.changed.map_or(f64::INFINITY, |(since, _)| stamp.seconds_since(since));
        let is_equal = self.changed.is_some_and(|(_, last)| {
            let off_m = (pose.translation_m - last.translation_m).abs().max_element();
            off_m <= resolution.position_m
                && (pose.rotation == last.rotation
                    || angle_rad(last.rotation.conjugate() * pose.rotation)
                        <= resolution.rotation_rad)
        });
        if is_equal {
            return Comparison::Equal(age_s);
        }
        self.changed = Some((stamp, pose));
        Comparison::Different(age_s)
    }

    /// Detects bitwise equal poses while the vehicle moves.
    pub(super) fn check_frozen(&self, measured: &Measured, turned: DQuat) -> Result<(), Rejected> {
        let Some(still) = self.still.filter(|still| still.pose == measured.world_from_body) else {
            return Ok(());
        };
        let since_s = measured.stamp.seconds_since(still.since);
        let flown_m = if still.speed_mps > MOVING_MPS { still.speed_mps * since_s } else { 0.0 };
        let turned_rad =
            if still.turn_radps > TURNING_RADPS { still.turn_radps * since_s } else { 0.0 };
        let by_gyro_rad = angle_rad(still.turned.conjugate() * turned);
        let frozen = flown_m > FROZEN_M
            || turned_rad > FROZEN_RAD
            || by_gyro_rad > FROZEN_RAD + GYRO_DRIFT_RADPS * since_s;
        if frozen { Err(Rejected::Frozen(since_s)) } else { Ok(()) }
    }

    /// Returns the [`Claim`] of the last rejected poses, if `surprise` agrees with it.
    pub(super) fn pending(&self, surprise: &Surprise) -> Option<Claim> {
        self.claim.filter(|claim| claim.is_made_by(surprise))
    }

    /// Records a pose that does not fit. Returns its claim, and whether the claim is a manoeuvre: poses that
    /// leave the expected path together, each further than the one before.
    pub(super) fn claim(&mut self, surprise: &Surprise, kind: ClaimKind) -> (Claim, bool) {
        let Surprise { stamp, pose, off_m, off_rad, .. } = *surprise;
        let former = self.claim;
        let before_s = former.map_or(0.0, |former| {
            former.since.seconds_since(self.accepted_at.unwrap_or(stamp)).max(0.0)
        });
        let pauses = before_s > PAUSE_S.max(PAUSE_INTERVALS / self.rate_hz(stamp).max(1.0));
        let moves = former.filter(|former| former.leads_to(surprise, before_s, pauses));
        let claim = match moves.or(former.filter(|former| former.is_made_by(surprise))) {
            Some(former) => Claim {
                kind: if kind > former.kind { kind } else { former.kind },
                newest: stamp,
                pose,
                count: former.count + 1,
                ..former
            },
            None => Claim {
                kind,
                since: stamp,
                first_off_m: off_m,
                first_off_rad: off_rad,
                is_turned: surprise.is_turned,
                newest: stamp,
                pose,
                count: 1,
            },
        };
        self.claim = Some(claim);
        (claim, moves.is_some() && claim.kind <= ClaimKind::Shift)
    }

    /// Records an accepted pose, after which the vehicle moves as in `estimate`.
    pub(super) fn accept(&mut self, measured: &Measured, estimate: &Estimate, turned: DQuat) {
        let Measured { stamp, world_from_body: pose, .. } = *measured;
        self.claim = None;
        self.accepted += 1;
        self.accepted_at = Some(stamp);
        if self.still.is_none_or(|still| still.pose != pose) {
            self.still = Some(Still {
                since: stamp,
                pose,
                speed_mps: estimate.v_world_mps.length(),
                turn_radps: estimate.omega_body_radps.length(),
                turned,
            });
        }
    }

    /// Records a measurement, accepted or not. Returns whether it shows for the first time that the source is
    /// noisier than stated, so that the present estimate trusts it too much.
    pub(super) fn add(
        &mut self,
        stamp: ServerTime,
        pose: &Pose<World, Body>,
        sigma: &PoseSigma,
    ) -> bool {
        let was_known = self.noise.is_known();
        self.noise.add(stamp, pose, sigma);
        !was_known && self.noise.is_known() && self.noise.factor() > 1.0
    }

    /// Returns the factor for this source's variances: 1 while its measurements scatter as their sigmas state.
    pub(super) fn noise_factor(&self) -> f64 {
        if self.noise.is_known() { self.noise.factor() } else { 1.0 }
    }

    /// Whether there are enough measurements to estimate the noise.
    pub(super) fn is_known(&self) -> bool {
        self.noise.is_known()
    }

    /// Returns the rate of measurements, accepted or not. [Hz]
    pub(super) fn rate_hz(&self, now: ServerTime) -> f64 {
        self.latency.rate_hz(now)
    }

    /// Returns the usual latency of the source and its interval, if it is active. [s]
    pub(super) fn timing(&self, now: ServerTime) -> Option<(f64, f64)> {
        let rate_hz = self.latency.rate_hz(now);
        (rate_hz > 0.0).then(|| (self.latency.value(), 1.0 / rate_hz))
    }

    pub(super) fn reject(&mut self, reason: &Rejected) {
        self.rejected.count(reason);
    }

    pub(super) fn rejected(&self) -> Rejects {
        self.rejected
    }

    pub(super) fn quality(&self, source: u8, now: ServerTime) -> Option<SourceQuality> {
        (self.accepted + self.rejected.total() > 0).then(|| SourceQuality {
            source,
            name: String::new(),
            rate_hz: self.latency.rate_hz(now),
            latency_ms: self.latency.value() * 1e3,
            accepted: self.accepted,
            rejected: self.rejected,
        })
    }
}

impl Claim {
    /// Whether an object at the claimed pose, at rest or moving like the vehicle, would be at this pose by the
    /// time of `surprise`.
    fn is_made_by(&self, surprise: &Surprise) -> bool {
        let Surprise { stamp, v_world_mps, omega_body_radps, .. } = *surprise;
        let dt_s = stamp.seconds_since(self.newest);
        let moved_m = surprise.pose.translation_m - self.pose.translation_m;
        let turned = self.pose.rotation.conjugate() * surprise.pose.rotation;
        let turning = DQuat::from_scaled_axis(-omega_body_radps * dt_s);
        let mut fits_m = FITS_M + FITS_MPS * dt_s + FITS_SIGMAS * surprise.noise_m;
        let mut fits_rad = FITS_RAD + FITS_RADPS * dt_s + FITS_SIGMAS * surprise.noise_rad;
        // Poses of one claim are closer to each other than to the expected pose.
        if self.is_turned {
            fits_rad = fits_rad.min(CLOSER * surprise.off_rad.length());
        } else {
            fits_m = fits_m.min(CLOSER * surprise.off_m.length());
        }
        (0.0..=CLAIM_LASTS_S).contains(&dt_s)
            && moved_m.length().min((moved_m - v_world_mps * dt_s).length()) <= fits_m
            && angle_rad(turned).min(angle_rad(turned * turning)) <= fits_rad
    }

    /// Whether the line through its first pose and this one, extended backwards, meets the expected path within
    /// `before_s`, the time between the last accepted pose and the first rejected one: a bump or a hard stop
    /// does, an outlier does not. `pauses`: whether the source was silent in between.
    fn leads_to(&self, surprise: &Surprise, before_s: f64, pauses: bool) -> bool {
        let dt_s = surprise.stamp.seconds_since(self.since);
        // The motion during a pause of the source is unknown.
        let unseen_m = if pauses { UNSEEN_MPS * before_s } else { 0.0 };
        let leads = |first: DVec3, now: DVec3, noise: f64, most: f64| {
            let way = now - first;
            let along = first.dot(way) / way.length_squared().max(f64::MIN_POSITIVE);
            let miss = first - way * along.clamp(0.0, before_s / dt_s);
            way.length() <= most * dt_s && miss.length() <= ASTRAY * first.length() + noise
        };
        let Surprise { off_m, off_rad, noise_m, noise_rad, .. } = *surprise;
        dt_s > 0.0
            && surprise.stamp.seconds_since(self.newest) <= CLAIM_LASTS_S
            && leads(self.first_off_m, off_m, FITS_SIGMAS * noise_m + unseen_m, MAX_MANOEUVRE_MPS)
            && leads(self.first_off_rad, off_rad, FITS_SIGMAS * noise_rad, MAX_TURN_RADPS)
    }

    /// Whether the deviation is at least [`GROWS`] times the first, as in a motion that began after the last accepted
    /// pose.
    pub(super) fn grows_to(&self, surprise: &Surprise) -> bool {
        let Surprise { off_m, off_rad, .. } = surprise;
        if self.is_turned {
            off_rad.length() >= GROWS * self.first_off_rad.length()
        } else {
            off_m.length() >= GROWS * self.first_off_m.length()
        }
    }

    /// Whether the claim is closer to the pose than the expectation is.
    pub(super) fn explains(&self, surprise: &Surprise) -> bool {
        let Surprise { pose, off_m, off_rad, .. } = surprise;
        if self.is_turned {
            angle_rad(self.pose.rotation.conjugate() * pose.rotation) < off_rad.length()
        } else {
            (pose.translation_m - self.pose.translation_m).length() < off_m.length()
        }
    }

    /// Returns the duration of the claim. [s]
    pub(super) fn lasted_s(&self) -> f64 {
        self.newest.seconds_since(self.since)
    }
}

/// Returns the angle of a rotation. [rad]
fn angle_rad(rotation: DQuat) -> f64 {
    shortest(rotation).to_scaled_axis().length()
}

/// Number of remembered measurements: a second at 30 Hz.
const WINDOW: usize = 32;
/// Minimum number of measurements for an estimate of the noise: 0.3 s at 30 Hz.
const TRIAL: usize = 8;
/// Median of the chi-squared distribution with three degrees of freedom.
const MEDIAN_SQUARE: f64 = 2.37;
/// Accelerations of a hovering vehicle. [m/s^2], [rad/s^2]
const USUAL_MPS2: f64 = 1.0;
const USUAL_RADPS2: f64 = 2.0;
/// Above this, a source scatters by more than it states, and not by chance. [sigma^2]
const NOISY_SQUARE: f64 = 1.8;
/// Ten times the sigma: a source with more noise is unusable.
const MAX_FACTOR: f64 = 100.0;
/// Maximum time by which a measurement may arrive before its stamp: the error between two clocks. [s]
const EARLY_S: f64 = 0.02;
/// Maximum age of a measurement at arrival: older ones are useless for flight. [s]
const LATE_S: f64 = 1.0;
/// Minimum jump of a clock: packets overtake each other by less. [s]
const CLOCK_JUMP_S: f64 = 0.25;
/// Minimum interval between two stamps of a source; a pose with a closer stamp is rejected. Packets that
/// wait in the socket and are stamped when they are read have such stamps. [s]
const MIN_APART_S: f64 = 0.000_5;
/// Minimum speed for the detection of a frozen stream: slower motion is close to the noise. [m/s]
const MOVING_MPS: f64 = 0.3;
/// Minimum turn rate for the detection of a frozen stream. [rad/s]
const TURNING_RADPS: f64 = 0.5;
/// Distance without a new pose that counts as frozen: many times the noise of any usable source. [m]
const FROZEN_M: f64 = 0.01;
/// Turn without a new pose that counts as frozen. [rad]
const FROZEN_RAD: f64 = 0.06;
/// Drift of a gyroscope before its bias is known. [rad/s]
const GYRO_DRIFT_RADPS: f64 = 0.03;
/// Maximum time between two poses of a [`Claim`]. Sources with a longer interval are too slow for flight. [s]
const CLAIM_LASTS_S: f64 = 0.25;
/// Tolerance within a claim, in standard deviations of the measurement.
const FITS_SIGMAS: f64 = 4.0;
/// Tolerance within a claim: wobble of a false position. [m], [rad]
const FITS_M: f64 = 0.02;
const FITS_RAD: f64 = 0.1;
/// Motion of a wrongly tracked object relative to the vehicle: another vehicle, or a wand in a hand. [m/s],
/// [rad/s]
const FITS_MPS: f64 = 3.0;
const FITS_RADPS: f64 = 4.0;
/// Share of the newest deviation within which poses of a claim must agree.
const CLOSER: f64 = 0.5;
/// Maximum distance of the start of a manoeuvre from the expected path, as a share of its first deviation: 11
/// degrees.
const ASTRAY: f64 = 0.2;
/// Growth of a deviation per interval: at least twofold for a motion that began after the last accepted pose,
/// less a fifth for noise.
const GROWS: f64 = 1.6;
/// Pause in which a vehicle may have stopped or turned unseen: eight missing frames at 100 Hz. [s]
const PAUSE_S: f64 = 0.08;
/// Minimum pause of a slow source, in intervals.
const PAUSE_INTERVALS: f64 = 2.5;
/// Unseen change of speed during a pause. [m/s]
const UNSEEN_MPS: f64 = 3.0;
