//! What is remembered of one source of poses, to distinguish a bad measurement from a bad prediction.

use glam::DQuat;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

use super::estimate::{Estimate, shortest};
use super::quality::{Fading, Rejects, SourceQuality};
use super::{Measured, Rejected};

/// Poses that do not fit what is known, but each other.
#[derive(Clone, Copy, Debug)]
pub(super) struct Claim {
    pub kind: ClaimKind,
    since: ServerTime,
    newest: ServerTime,
    pose: Pose<World, Body>,
    /// How many.
    pub count: u32,
}

/// What the vehicle would have to have done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum ClaimKind {
    /// A turn or a stop that the motion model does not foresee, over this time. [s]
    Manoeuvre(f64),
    /// Flown faster than vehicles fly. [m/s]
    Jump(f64),
    /// Turned faster than vehicles turn.
    Flip,
}

/// The last accepted pose, as long as it comes again and again.
#[derive(Clone, Copy, Debug)]
struct Still {
    since: ServerTime,
    pose: Pose<World, Body>,
    /// How the vehicle moved when the first of them came. [m/s], [rad/s]
    speed_mps: f64,
    turn_radps: f64,
    /// How far the gyroscope had turned then.
    turned: DQuat,
}

/// One source.
#[derive(Clone, Debug, Default)]
pub(super) struct Source {
    last: Option<(ServerTime, ServerTime)>,
    still: Option<Still>,
    claim: Option<Claim>,
    pub accepted_at: Option<ServerTime>,
    accepted: u64,
    rejected: Rejects,
    latency: Fading,
    noise: Noise,
}

/// How its measurements scatter against their stated sigmas.
#[derive(Clone, Copy, Debug)]
struct Noise {
    /// Mean square of innovations in standard deviations, an axis: 1 where all is as stated.
    square: f64,
    /// What variances are multiplied by.
    factor: f64,
}

impl Default for Noise {
    fn default() -> Self {
        Self { square: 1.0, factor: 1.0 }
    }
}

impl Source {
    /// Checks the stamp by itself.
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

    /// Notices numbers that stay the same to the last bit while the vehicle moves.
    pub(super) fn check_frozen(&self, measured: &Measured, turned: DQuat) -> Result<(), Rejected> {
        let Some(still) = self.still.filter(|still| still.pose == measured.world_from_body) else {
            return Ok(());
        };
        let since_s = measured.stamp.seconds_since(still.since);
        let flown_m = if still.speed_mps > MOVING_MPS { still.speed_mps * since_s } else { 0.0 };
        let turned_rad =
            if still.turn_radps > TURNING_RADPS { still.turn_radps * since_s } else { 0.0 };
        let by_gyro_rad = shortest(still.turned.conjugate() * turned).to_scaled_axis().length();
        let frozen = flown_m > FROZEN_M
            || turned_rad > FROZEN_RAD
            || by_gyro_rad > FROZEN_RAD + GYRO_DRIFT_RADPS * since_s;
        if frozen { Err(Rejected::Frozen(since_s)) } else { Ok(()) }
    }

    /// Returns the claim that earlier poses made, if this one makes it too.
    pub(super) fn pending(&self, measured: &Measured) -> Option<Claim> {
        self.claim.filter(|claim| claim.fits(measured.stamp, &measured.world_from_body))
    }

    /// Takes note of a pose that does not fit; returns its claim, of `kind` if it is the first to
    /// make it.
    pub(super) fn claim(&mut self, measured: &Measured, kind: ClaimKind) -> Claim {
        let Measured { stamp, world_from_body: pose, .. } = *measured;
        let claim = match self.pending(measured) {
            Some(claim) => Claim { newest: stamp, pose, count: claim.count + 1, ..claim },
            None => Claim { kind, since: stamp, newest: stamp, pose, count: 1 },
        };
        self.claim = Some(claim);
        claim
    }

    /// Takes note of an accepted pose, after which the vehicle moves as in `estimate`.
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

    /// Returns what this source's variances are to be multiplied by: 1 as long as its measurements
    /// scatter as their sigmas state.
    pub(super) fn noise_factor(&self) -> f64 {
        self.noise.factor
    }

    /// Learns from a measurement that is no jump: it was off by so many standard deviations of
    /// three axes.
    pub(super) fn learn(&mut self, sigmas: f64) {
        let Noise { square, factor } = &mut self.noise;
        *square += ((sigmas * sigmas / 3.0).min(MAX_SQUARE) - *square) * LEARNS;
        if *square > NOISY_SQUARE {
            *factor = (*factor * (1.0 + LEARNS)).min(MAX_FACTOR);
        } else if *square < CALM_SQUARE {
            *factor = (*factor * (1.0 - LEARNS)).max(1.0);
        }
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
    /// Whether a vehicle at the claimed position could be there now.
    fn fits(&self, stamp: ServerTime, pose: &Pose<World, Body>) -> bool {
        let dt_s = stamp.seconds_since(self.newest);
        let moved_m = (pose.translation_m - self.pose.translation_m).length();
        let turned_rad =
            shortest(self.pose.rotation.conjugate() * pose.rotation).to_scaled_axis().length();
        (0.0..=CLAIM_LASTS_S).contains(&dt_s)
            && moved_m <= FITS_M + FITS_MPS * dt_s
            && turned_rad <= FITS_RAD + FITS_RADPS * dt_s
    }

    /// How long it has been made. [s]
    pub(super) fn lasted_s(&self) -> f64 {
        self.newest.seconds_since(self.since)
    }
}

/// Share of what one measurement teaches: 50 of them.
const LEARNS: f64 = 0.02;
/// One measurement does not count for more. [sigma^2]
const MAX_SQUARE: f64 = 36.0;
/// Beyond this a source scatters by more than it states; a motion model that fits badly for a while
/// does not reach it.
const NOISY_SQUARE: f64 = 2.5;
/// Below this its weight may rise again.
const CALM_SQUARE: f64 = 1.2;
/// Ten times the sigma: what is worse still is no localization.
const MAX_FACTOR: f64 = 100.0;
/// A measurement may seem to come before it was made by what two clocks disagree at most. [s]
const EARLY_S: f64 = 0.02;
/// Nobody flies on what is older. [s]
const LATE_S: f64 = 1.0;
/// Packets overtake each other by less. [s]
const CLOCK_JUMP_S: f64 = 0.25;
/// Stamps closer together are those of packets that were read at once: no source is that fast. [s]
const MIN_APART_S: f64 = 0.000_5;
/// Slower than this the motion's own noise is not far away. [m/s]
const MOVING_MPS: f64 = 0.3;
/// The same of turning. [rad/s]
const TURNING_RADPS: f64 = 0.5;
/// Many times the noise of any source that flies. [m]
const FROZEN_M: f64 = 0.01;
/// The same of attitudes. [rad]
const FROZEN_RAD: f64 = 0.06;
/// A gyroscope turns by itself, before its bias is known. [rad/s]
const GYRO_DRIFT_RADPS: f64 = 0.03;
/// Poses of one claim follow each other within this; slower sources do not fly. [s]
const CLAIM_LASTS_S: f64 = 0.25;
/// Noise within a claim. [m], [rad]
const FITS_M: f64 = 0.05;
const FITS_RAD: f64 = 0.2;
/// Motion within a claim: faster than anyone flies in a room. [m/s], [rad/s]
const FITS_MPS: f64 = 30.0;
const FITS_RADPS: f64 = 35.0;
