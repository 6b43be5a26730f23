//! Motion of the vehicle, and the choice between two ambiguous poses.
//!
//! A single visible square has two possible poses. Both are kept as hypotheses, each with a penalty in the units of
//! [`crate::solve::PoseFit::cost`]. The penalty sums two terms over the images: the additional cost of the hypothesis'
//! corners, and the deviation of its rotation from its own motion. The false pose tilts against the true motion, so its
//! penalty grows. A second tag resolves the ambiguity at once.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::solve::{PoseFit, Solved, VehicleTwist};

/// Recent poses of the vehicle.
#[derive(Debug, Default)]
pub(super) struct Track {
    /// At most two, the more likely one first.
    hypotheses: Vec<Hypothesis>,
}

#[derive(Clone, Debug)]
struct Hypothesis {
    /// Past poses with their weights, the newest last.
    past: VecDeque<(HostTime, Pose<World, Body>, f64)>,
    penalty: f64,
}

impl Track {
    /// Returns the stamp of the newest pose.
    pub(super) fn newest(&self) -> Option<HostTime> {
        self.hypotheses.first().and_then(Hypothesis::newest).map(|(stamp, _)| stamp)
    }

    /// Returns the predicted pose; `None` if the last pose is too old.
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

    /// Adds a pose between older ones, which improves the motion estimate.
    pub(super) fn insert(&mut self, stamp: HostTime, fit: &PoseFit) {
        if let [only] = &mut self.hypotheses[..] {
            only.push(stamp, fit);
        }
    }

    /// Returns the motion; `None` with too few poses, or if the last pose is too old.
    pub(super) fn motion(&self, stamp: HostTime) -> Option<VehicleTwist> {
        let age_s = stamp.seconds_since(self.newest()?);
        (age_s <= MOTION_LASTS_S).then(|| self.hypotheses.first()?.motion())?
    }

    /// Processes a solution; returns the accepted fit, or `None` while it is ambiguous.
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

    /// Fits parabolas to the latest poses by least squares, or straight lines if there are few poses. The result is the
    /// motion at the newest pose; a straight line's velocity belongs to the middle of its span.
    fn motion(&self) -> Option<VehicleTwist> {
        let (_, pose) = self.newest()?;
        let (v_world_mps, a_world_mps2) =
            self.slope(MOTION_SPAN_S, |past| past.translation_m - pose.translation_m)?;
        let (omega_body_radps, _) =
            self.slope(TURN_SPAN_S, |past| turn(pose.rotation, past.rotation))?;
        Some(VehicleTwist { v_world_mps, omega_body_radps, a_world_mps2 })
    }

    /// Returns the first and second time derivative of a quantity at the newest pose, from the poses of the last
    /// `span_s`.
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
        // Time in units of the span, 0 at the newest pose: sums of its powers, also multiplied by the values.
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
        // Rows of the inverse that give slope and curvature.
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

    /// Returns the cost of `pose` as the continuation of this hypothesis.
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

/// Returns the rotation from one attitude to another about the axes of the first. [rad]
fn turn(from: DQuat, to: DQuat) -> DVec3 {
    let q = from.conjugate() * to;
    // Both signs are the same attitude; this one is the shorter rotation.
    (if q.w < 0.0 { -q } else { q }).to_scaled_axis()
}

/// Time span of poses for velocity and acceleration: ten poses of two cameras at 30 Hz. [s]
const MOTION_SPAN_S: f64 = 0.16;
/// Time span of poses for the rate of rotation, which changes faster than velocity. [s]
const TURN_SPAN_S: f64 = 0.12;
/// Maximum age of a motion estimate. [s]
const MOTION_LASTS_S: f64 = 0.15;
/// Minimum number of poses for a parabola.
const CURVED_FROM: usize = 6;
/// Lower limit of a pose's sigma in its weight. [m]
const MIN_SIGMA_M: f64 = 0.001;
/// Maximum number of kept poses.
const MAX_KEPT: usize = 32;
/// Maximum age of a pose for prediction. [s]
const FORGET_AFTER_S: f64 = 0.4;
/// Prediction noise from one image to the next. [m]
const MIN_UNCERTAINTY_M: f64 = 0.04;
/// Standard error of the predicted velocity. [m/s]
const SPEED_UNCERTAINTY_MPS: f64 = 0.5;
/// Unpredicted acceleration. [m/s^2]
const ACCELERATION_UNCERTAINTY_MPS2: f64 = 10.0;
/// Noise of the predicted attitude. [rad]
const TURN_SIGMA_RAD: f64 = 0.05;
/// Unpredicted rate of rotation. [rad/s]
const TURN_SIGMA_RADPS: f64 = 1.0;
/// Maximum cost of one image against the motion: it may have been misread.
const MAX_SURPRISE: f64 = 10.0;
/// Share of the penalty that is kept from image to image.
const KEPT: f64 = 0.97;
/// A hypothesis that is e^4 times more likely is accepted.
const DECIDED: f64 = 4.0;
/// A hypothesis that is e^14 times less likely is dropped.
const HOPELESS: f64 = 14.0;
/// Penalty of a tilt above the maximum.
const IMPOSSIBLE: f64 = 20.0;
