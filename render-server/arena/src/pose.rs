//! From localization measurements to the pose that everything else uses: what cannot be is turned
//! away, the twist is estimated, and silence is noticed.
//!
//! In: one measurement per packet, 30 to 500 Hz. Out: a [`PoseSample`] for each that is believed.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, Twist, World};
use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::time::ServerTime;

/// Why a measurement is not believed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Rejected {
    /// A number that is not finite, or a quaternion that is not of unit length.
    #[error("the pose holds numbers that are no pose")]
    Invalid,
    /// Not newer than the last one.
    #[error("the pose is not newer than the last one")]
    Stale,
    /// Further from the last pose than any vehicle flies. [m/s]
    #[error("the pose jumped as fast as {0:.0} m/s; a marker swap or another object?")]
    Jump(f64),
}

/// Faster than this between two measurements is not flight: the fastest racing drones do 70 m/s
/// outdoors, none 30 m/s in a room. [m/s]
const MOST_MPS: f64 = 30.0;
/// Noise and a missed packet must not look like a jump. [m]
const JUMP_FLOOR_M: f64 = 0.05;
/// A jump that stays put for this many measurements is the truth (a moved origin, a regained
/// object).
const JUMP_CONFIRMED: u32 = 10;
/// Span of measurements from which the twist is taken. At 200 Hz and 0.3 mm of noise the
/// velocity's own noise is 5 mm/s, its lag half the span. [s]
const TWIST_SPAN_S: f64 = 0.05;
/// Over less than this, noise and bunched packets make any speed; the former twist holds. [s]
const LEAST_SPAN_S: f64 = 0.01;
/// Measurements kept for the twist at most; 500 Hz fills the span with fewer.
const TWIST_SAMPLES: usize = 32;
/// Silence that counts as a lost pose: 30 missed packets of a 200 Hz mocap. [s]
pub const LOST_AFTER_S: f64 = 0.15;
/// Longest extrapolation; beyond it a constant velocity means nothing. [s]
const PREDICT_MOST_S: f64 = 0.2;

/// What changed about the source of poses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PoseChange {
    /// No believed pose for this long. [s]
    Lost(f64),
    /// Poses are back.
    Regained,
}

/// Believes or rejects measurements of one vehicle.
#[derive(Clone, Debug, Default)]
pub struct PoseGate {
    recent: VecDeque<(ServerTime, Pose<World, Body>)>,
    newest: Option<PoseSample>,
    /// Where the jumped-to poses are, and how many there have been.
    jumped: Option<(ServerTime, DVec3, u32)>,
    resets: u8,
    lost: bool,
    change: Option<PoseChange>,
}

impl PoseGate {
    /// Takes a measurement; returns the sample if it is believed.
    pub fn handle_measurement(
        &mut self,
        stamp: ServerTime,
        world_from_body: Pose<World, Body>,
    ) -> Result<PoseSample, Rejected> {
        if !world_from_body.is_valid() {
            return Err(Rejected::Invalid);
        }
        if let Some(newest) = self.newest {
            if stamp <= newest.stamp {
                return Err(Rejected::Stale);
            }
            let moved_m =
                (world_from_body.translation_m - newest.world_from_body.translation_m).length();
            let speed_mps = moved_m / stamp.seconds_since(newest.stamp);
            if moved_m > JUMP_FLOOR_M && speed_mps > MOST_MPS {
                self.judge_jump(stamp, world_from_body.translation_m, speed_mps)?;
            }
        }
        self.jumped = None;
        // The oldest kept is the last one before the span: after a pause there is a baseline.
        while self.recent.len() >= TWIST_SAMPLES
            || self.recent.get(1).is_some_and(|(at, _)| stamp.seconds_since(*at) > TWIST_SPAN_S)
        {
            self.recent.pop_front();
        }
        self.recent.push_back((stamp, world_from_body));
        let sample =
            PoseSample { stamp, world_from_body, twist: self.twist(), resets: self.resets };
        self.newest = Some(sample);
        if std::mem::take(&mut self.lost) {
            self.change = Some(PoseChange::Regained);
        }
        Ok(sample)
    }

    /// Rejects a jump, until it has been confirmed; then starts afresh from it.
    fn judge_jump(
        &mut self,
        stamp: ServerTime,
        p_world_m: DVec3,
        speed_mps: f64,
    ) -> Result<(), Rejected> {
        let count = match self.jumped {
            Some((at, place_m, count))
                if (p_world_m - place_m).length()
                    <= JUMP_FLOOR_M + MOST_MPS * stamp.seconds_since(at).max(0.0) =>
            {
                count + 1
            }
            _ => 1,
        };
        self.jumped = Some((stamp, p_world_m, count));
        if count < JUMP_CONFIRMED {
            return Err(Rejected::Jump(speed_mps));
        }
        self.resets = self.resets.wrapping_add(1);
        self.recent.clear();
        Ok(())
    }

    /// Least-squares slope of the positions, and the turn from the oldest to the newest attitude.
    fn twist(&self) -> Twist {
        let (Some(&(newest, newest_pose)), Some(&(oldest, oldest_pose))) =
            (self.recent.back(), self.recent.front())
        else {
            return Twist::default();
        };
        let span_s = newest.seconds_since(oldest);
        if !(span_s >= LEAST_SPAN_S) {
            // After a jump there is no former twist to keep.
            return self
                .newest
                .filter(|_| self.recent.len() > 1)
                .map_or_else(Twist::default, |n| n.twist);
        }
        let n = self.recent.len() as f64;
        let times = || self.recent.iter().map(|(at, _)| at.seconds_since(oldest));
        let mean_s = times().sum::<f64>() / n;
        let spread = times().map(|t| (t - mean_s).powi(2)).sum::<f64>();
        let slope = self
            .recent
            .iter()
            .zip(times())
            .fold(DVec3::ZERO, |sum, ((_, pose), t)| sum + pose.translation_m * (t - mean_s));
        let turn = oldest_pose.rotation.conjugate() * newest_pose.rotation;
        // The short way round.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        Twist { linear_mps: slope / spread, angular_radps: turn.to_scaled_axis() / span_s }
    }

    /// Notices silence. Call at [`Self::poll_timeout`].
    pub fn handle_timeout(&mut self, now: ServerTime) {
        if let Some(newest) = self.newest {
            let age_s = now.seconds_since(newest.stamp);
            if age_s >= LOST_AFTER_S && !self.lost {
                self.lost = true;
                self.change = Some(PoseChange::Lost(age_s));
            }
        }
    }

    /// Returns when [`Self::handle_timeout`] has something to do; `None` while poses are lost or
    /// none has come.
    pub fn poll_timeout(&self) -> Option<ServerTime> {
        let newest = self.newest.filter(|_| !self.lost)?;
        Some(newest.stamp.plus_seconds(LOST_AFTER_S))
    }

    /// Returns a change of the source once.
    pub fn poll_change(&mut self) -> Option<PoseChange> {
        self.change.take()
    }

    /// Returns the newest believed sample.
    pub fn newest(&self) -> Option<&PoseSample> {
        self.newest.as_ref()
    }

    /// Returns the pose at another time by constant velocity, at most 0.2 s ahead.
    pub fn predict(&self, at: ServerTime) -> Option<Pose<World, Body>> {
        let newest = self.newest?;
        let dt_s = at.seconds_since(newest.stamp).clamp(-PREDICT_MOST_S, PREDICT_MOST_S);
        let pose = newest.world_from_body;
        Some(Pose::new(
            pose.translation_m + newest.twist.linear_mps * dt_s,
            pose.rotation * DQuat::from_scaled_axis(newest.twist.angular_radps * dt_s),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(seconds: f64) -> ServerTime {
        ServerTime::from_ns(1_000_000_000).plus_seconds(seconds)
    }

    fn pose(p: DVec3) -> Pose<World, Body> {
        Pose::new(p, DQuat::IDENTITY)
    }

    proptest! {
        #[test]
        fn a_constant_twist_is_found(v in prop::array::uniform3(-8.0..8.0f64), w in prop::array::uniform3(-3.0..3.0f64), hz in 30.0..500.0f64) {
            let (v, w) = (DVec3::from(v), DVec3::from(w));
            let mut gate = PoseGate::default();
            for i in 0..60 {
                let t = f64::from(i) / hz;
                let truth = Pose::new(v * t, DQuat::from_scaled_axis(w * t));
                gate.handle_measurement(at(t), truth).unwrap();
            }
            let twist = gate.newest().unwrap().twist;
            prop_assert!((twist.linear_mps - v).length() < 1e-3, "{:?}", twist);
            prop_assert!((twist.angular_radps - w).length() < 1e-3, "{:?}", twist);
            let ahead = gate.predict(at(59.0 / hz + 0.03)).unwrap();
            prop_assert!((ahead.translation_m - v * (59.0 / hz + 0.03)).length() < 1e-3);
        }
    }

    #[test]
    fn poison_and_old_poses_are_turned_away() {
        let mut gate = PoseGate::default();
        let nan = pose(DVec3::new(f64::NAN, 0.0, 0.0));
        assert_eq!(gate.handle_measurement(at(0.0), nan), Err(Rejected::Invalid));
        gate.handle_measurement(at(1.0), pose(DVec3::ZERO)).unwrap();
        assert_eq!(gate.handle_measurement(at(1.0), pose(DVec3::ZERO)), Err(Rejected::Stale));
        assert_eq!(gate.handle_measurement(at(0.5), pose(DVec3::ZERO)), Err(Rejected::Stale));
    }

    #[test]
    fn a_jump_is_turned_away_until_it_proves_true() {
        let mut gate = PoseGate::default();
        gate.handle_measurement(at(0.0), pose(DVec3::ZERO)).unwrap();
        let far = pose(DVec3::new(5.0, 0.0, 0.0));
        // One swapped marker, then back.
        assert!(matches!(gate.handle_measurement(at(0.005), far), Err(Rejected::Jump(_))));
        assert_eq!(gate.handle_measurement(at(0.010), pose(DVec3::ZERO)).unwrap().resets, 0);
        // A moved origin stays.
        let mut accepted = None;
        for i in 1..=20 {
            if let Ok(sample) = gate.handle_measurement(at(0.010 + 0.005 * f64::from(i)), far) {
                accepted = Some((i, sample));
                break;
            }
        }
        let (count, sample) = accepted.expect("a lasting jump is believed");
        assert_eq!(count, JUMP_CONFIRMED as i32);
        assert_eq!((sample.resets, sample.twist), (1, Twist::default()));
    }

    #[test]
    fn packets_bunched_after_a_pause_are_no_speed() {
        let mut gate = PoseGate::default();
        // 2 m/s, read in time for 0.2 s; then 0.1 s of packets read at once.
        for i in 0..40 {
            let t = 0.005 * f64::from(i);
            gate.handle_measurement(at(t), pose(DVec3::X * 2.0 * t)).unwrap();
        }
        for i in 40..60 {
            let place = pose(DVec3::X * 2.0 * 0.005 * f64::from(i));
            // Those that come at a jump's speed are turned away; the others make no great one.
            let _ = gate.handle_measurement(at(0.3 + 1e-4 * f64::from(i - 40)), place);
            let speed_mps = gate.newest().unwrap().twist.linear_mps.length();
            assert!(speed_mps < 3.0, "{speed_mps} m/s after packet {i}");
        }
    }

    #[test]
    fn silence_is_noticed_once_and_its_end_too() {
        let mut gate = PoseGate::default();
        assert_eq!(gate.poll_timeout(), None);
        gate.handle_measurement(at(0.0), pose(DVec3::ZERO)).unwrap();
        gate.handle_timeout(at(0.1));
        assert_eq!(gate.poll_change(), None);
        let due = gate.poll_timeout().unwrap();
        gate.handle_timeout(due);
        assert!(matches!(gate.poll_change(), Some(PoseChange::Lost(age_s)) if age_s > 0.14));
        gate.handle_timeout(at(1.0));
        assert_eq!((gate.poll_change(), gate.poll_timeout()), (None, None));
        gate.handle_measurement(at(2.0), pose(DVec3::ZERO)).unwrap();
        assert_eq!(gate.poll_change(), Some(PoseChange::Regained));
    }
}
