//! How the vehicle moves, and which of two answers is true.
//!
//! Where one square is all that is seen, two poses explain it. Both are kept, each with a penalty in the
//! units of [`crate::solve::PoseFit::cost`]: what its corners cost more than the other's, summed over the
//! images, and what it would have turned against its own motion. The false one tilts the other way with
//! every motion, and its penalty grows; a second tag ends it at once.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::solve::{PoseFit, Solved, VehicleTwist};

/// What is known of the vehicle's way.
#[derive(Debug, Default)]
pub(super) struct Track {
    /// The likelier first; two at most.
    hypotheses: Vec<Hypothesis>,
}

#[derive(Clone, Debug)]
struct Hypothesis {
    /// Newest last, each with how much it counts.
    past: VecDeque<(HostTime, Pose<World, Body>, f64)>,
    penalty: f64,
}

impl Track {
    /// Returns when it was last seen.
    pub(super) fn newest(&self) -> Option<HostTime> {
        self.hypotheses.first().and_then(Hypothesis::newest).map(|(stamp, _)| stamp)
    }

    /// Returns where the vehicle should be; `None` if it was not seen for too long.
    pub(super) fn predict(&self, stamp: HostTime) -> Option<Pose<World, Body>> {
        self.hypotheses.first()?.predict(stamp)
    }

    /// Returns the uncertainty of the prediction. [m]
    pub(super) fn uncertainty_m(&self, stamp: HostTime) -> f64 {
        let Some(newest) = self.newest() else { return f64::INFINITY };
        let dt_s = stamp.seconds_since(newest).abs();
        MIN_UNCERTAINTY_M
            + SPEED_UNCERTAINTY_MPS * dt_s
            + 0.5 * ACCELERATION_UNCERTAINTY_MPS2 * dt_s * dt_s
    }

    /// Takes a pose of the past, which tells how it moves since.
    pub(super) fn insert(&mut self, stamp: HostTime, fit: &PoseFit) {
        if let [only] = &mut self.hypotheses[..] {
            only.push(stamp, fit);
        }
    }

    /// Returns how it moves; `None` before there are enough poses, and some time after the last.
    pub(super) fn motion(&self, stamp: HostTime) -> Option<VehicleTwist> {
        let age_s = stamp.seconds_since(self.newest()?);
        (age_s <= MOTION_LASTS_S).then(|| self.hypotheses.first()?.motion())?
    }

    /// Takes a solution; returns the accepted fit, or `None` while two are possible.
    pub(super) fn update(
        &mut self,
        stamp: HostTime,
        solved: &Solved,
        most_tilt_rad: f64,
    ) -> Option<PoseFit> {
        let stale = |h: &Hypothesis| h.predict(stamp).is_none();
        if self.hypotheses.iter().all(stale) {
            self.hypotheses.clear();
        }
        let fits = [Some(solved.best), solved.other];
        let mut next: Vec<(Hypothesis, PoseFit)> = Vec::with_capacity(2);
        for fit in fits.into_iter().flatten() {
            let pose = fit.world_from_body;
            let up = (pose.rotation * DVec3::Z).z.clamp(-1.0, 1.0);
            let leans = if up.acos() > most_tilt_rad { IMPOSSIBLE } else { 0.0 };
            let own = fit.cost - solved.best.cost + leans;
            let from = self
                .hypotheses
                .iter()
                .map(|h| (KEPT * h.penalty + h.surprise(stamp, &pose), h))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let (penalty, past) = match from {
                Some((before, h)) => (before + own, h.past.clone()),
                None => (own, VecDeque::new()),
            };
            let mut hypothesis = Hypothesis { past, penalty };
            hypothesis.push(stamp, &fit);
            next.push((hypothesis, fit));
        }
        next.sort_by(|a, b| a.0.penalty.total_cmp(&b.0.penalty));
        let least = next.first()?.0.penalty;
        for (hypothesis, _) in &mut next {
            hypothesis.penalty -= least;
        }
        next.retain(|(hypothesis, _)| hypothesis.penalty < HOPELESS);
        let accepted = match &next[..] {
            [(_, fit)] => Some(*fit),
            [(_, fit), (second, _)] if second.penalty >= DECIDED => Some(*fit),
            _ => None,
        };
        self.hypotheses = next.into_iter().map(|(hypothesis, _)| hypothesis).collect();
        accepted
    }
}

impl Hypothesis {
    fn newest(&self) -> Option<(HostTime, Pose<World, Body>)> {
        self.past.back().map(|(stamp, pose, _)| (*stamp, *pose))
    }

    fn push(&mut self, stamp: HostTime, fit: &PoseFit) {
        let weight = (fit.sigmas().0.length_squared() + MIN_SIGMA_M * MIN_SIGMA_M).recip();
        let at = self.past.partition_point(|(other, ..)| *other < stamp);
        self.past.insert(at, (stamp, fit.world_from_body, weight));
        let Some((stamp, _)) = self.newest() else { return };
        while self.past.front().is_some_and(|(old, ..)| stamp.seconds_since(*old) > MOTION_SPAN_S)
            || self.past.len() > MAX_KEPT
        {
            self.past.pop_front();
        }
    }

    fn predict(&self, stamp: HostTime) -> Option<Pose<World, Body>> {
        let (newest, pose) = self.newest()?;
        let dt_s = stamp.seconds_since(newest);
        (dt_s.abs() <= FORGET_AFTER_S).then(|| self.motion().unwrap_or_default().carry(&pose, dt_s))
    }

    /// Returns parabolas through the latest poses, by least squares; straight lines through a few. At the newest
    /// pose: the velocity of a straight line is that of the middle of its span.
    fn motion(&self) -> Option<VehicleTwist> {
        let (_, pose) = self.newest()?;
        let (v_world_mps, a_world_mps2) =
            self.slope(MOTION_SPAN_S, |past| past.translation_m - pose.translation_m)?;
        let (omega_body_radps, _) =
            self.slope(TURN_SPAN_S, |past| turn(pose.rotation, past.rotation))?;
        Some(VehicleTwist { v_world_mps, omega_body_radps, a_world_mps2 })
    }

    /// Returns first and second derivative by time of a quantity at the newest pose, by those of the last `span_s`.
    fn slope(
        &self,
        span_s: f64,
        value: impl Fn(&Pose<World, Body>) -> DVec3,
    ) -> Option<(DVec3, DVec3)> {
        let (newest, _) = self.newest()?;
        let age_s = |stamp: &HostTime| newest.seconds_since(*stamp);
        let recent = || self.past.iter().filter(|(stamp, ..)| age_s(stamp) <= span_s);
        let count = recent().count();
        let (oldest, ..) = recent().next()?;
        let span_s = age_s(oldest);
        if count < 3 || !(span_s > 1e-3) {
            return None;
        }
        // Time in spans, 0 is the newest: sums of powers of it, and of what changes times them.
        let (mut powers, mut sums) = ([0.0; 5], [DVec3::ZERO; 3]);
        for (stamp, past, weight) in recent() {
            let (t, value) = (-age_s(stamp) / span_s, value(past));
            let mut power = *weight;
            for i in 0..5 {
                powers[i] += power;
                if i < 3 {
                    sums[i] += value * power;
                }
                power *= t;
            }
        }
        let [n, t, t2, t3, t4] = powers;
        // Rows of the inverse that yield slope and curvature.
        let (slope, bend) = if count >= CURVED_FROM {
            let det = n * (t2 * t4 - t3 * t3) - t * (t * t4 - t3 * t2) + t2 * (t * t3 - t2 * t2);
            (
                [(t3 * t2 - t * t4) / det, (n * t4 - t2 * t2) / det, (t * t2 - n * t3) / det],
                [(t * t3 - t2 * t2) / det, (t * t2 - n * t3) / det, (n * t2 - t * t) / det],
            )
        } else {
            let det = n * t2 - t * t;
            ([-t / det, n / det, 0.0], [0.0; 3])
        };
        let by = |row: [f64; 3]| row[0] * sums[0] + row[1] * sums[1] + row[2] * sums[2];
        Some((by(slope) / span_s, 2.0 * by(bend) / (span_s * span_s)))
    }

    /// Returns what a pose costs as the next of this one's.
    fn surprise(&self, stamp: HostTime, pose: &Pose<World, Body>) -> f64 {
        let (Some(expected), Some((newest, _))) = (self.predict(stamp), self.newest()) else {
            return MAX_SURPRISE;
        };
        let dt_s = stamp.seconds_since(newest).abs();
        let sigma_rad = TURN_SIGMA_RAD + TURN_SIGMA_RADPS * dt_s;
        let angle = expected.rotation.angle_between(pose.rotation);
        (0.5 * (angle / sigma_rad).powi(2)).min(MAX_SURPRISE)
    }
}

/// Returns the turn from one attitude to another about the axes of the first. [rad]
fn turn(from: DQuat, to: DQuat) -> DVec3 {
    let q = from.conjugate() * to;
    // Both signs are the same attitude; this one is the shorter way.
    (if q.w < 0.0 { -q } else { q }).to_scaled_axis()
}

/// Poses of this span make the motion: of two cameras at 30 Hz ten. [s]
const MOTION_SPAN_S: f64 = 0.16;
/// Turns change faster than velocities. [s]
const TURN_SPAN_S: f64 = 0.12;
/// After this long a motion is another one. [s]
const MOTION_LASTS_S: f64 = 0.15;
/// A parabola takes so many poses.
const CURVED_FROM: usize = 6;
/// Better than this poses do not count more. [m]
const MIN_SIGMA_M: f64 = 0.001;
/// And no more than this many.
const MAX_KEPT: usize = 32;
/// After this long a vehicle can be anywhere. [s]
const FORGET_AFTER_S: f64 = 0.4;
/// Noise of the prediction from one image to the next. [m]
const MIN_UNCERTAINTY_M: f64 = 0.04;
/// Standard error of its velocity. [m/s]
const SPEED_UNCERTAINTY_MPS: f64 = 0.5;
/// Unpredicted acceleration. [m/s^2]
const ACCELERATION_UNCERTAINTY_MPS2: f64 = 10.0;
/// Noise of the predicted attitude. [rad]
const TURN_SIGMA_RAD: f64 = 0.05;
/// Unpredicted rate of turn. [rad/s]
const TURN_SIGMA_RADPS: f64 = 1.0;
/// One image decides little against motion: it may have been misread.
const MAX_SURPRISE: f64 = 10.0;
/// Of what was learnt before, how much stays from image to image.
const KEPT: f64 = 0.97;
/// A solution that is e^4 times likelier is accepted.
const DECIDED: f64 = 4.0;
/// One that is e^14 times less likely is dropped.
const HOPELESS: f64 = 14.0;
/// Penalty of an impossible pose.
const IMPOSSIBLE: f64 = 20.0;
