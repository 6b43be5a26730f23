//! Poses of the last seconds: gaps and jitter. Pure.

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::messages::PoseSample;

/// Poses of the last [`WINDOW_S`]; the newest stays.
#[derive(Clone, Debug, Default)]
pub struct PoseWindow {
    poses: VecDeque<(f64, DVec3)>,
    allowance_s: f32,
    /// Time of the first pose since the last silence. [s]
    since_s: f64,
}

/// Summary of a [`PoseWindow`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSummary {
    /// Time since the newest pose. [s]
    pub age_s: f64,
    /// Longest time between two poses of the window, including the time since the newest. [s]
    pub gap_s: f64,
    /// Root mean square distance from the mean; `None` if it moves. [mm]
    pub jitter_mm: Option<f64>,
    /// [`PoseSample::allowance_s`] of the newest pose. [s]
    pub allowance_s: f32,
}

impl PoseWindow {
    /// Adds a pose.
    pub fn push(&mut self, pose: &PoseSample) {
        let at_s = pose.stamp.as_ns() as f64 * 1e-9;
        let last_s = self.poses.back().map(|(last_s, _)| *last_s);
        if last_s.is_some_and(|last_s| at_s <= last_s) {
            return;
        }
        // A silence is reported while it lasts; it ends when poses arrive again.
        if last_s.is_none_or(|last_s| at_s - last_s > WINDOW_S) {
            self.poses.clear();
            self.since_s = at_s;
        }
        self.poses.push_back((at_s, pose.world_from_body.translation_m));
        self.allowance_s = pose.allowance_s;
        while self.poses.len() > MAX_POSES
            || self.poses.front().is_some_and(|(first_s, _)| at_s - first_s > WINDOW_S)
        {
            self.poses.pop_front();
        }
    }

    /// Returns the summary; `None` before poses have arrived for a second.
    pub fn summary(&self, now_s: f64) -> Option<PoseSummary> {
        let &(last_s, _) = self.poses.back()?;
        let age_s = (now_s - last_s).max(0.0);
        if self.poses.len() < 2 || (last_s - self.since_s < SETTLED_S && age_s < SETTLED_S) {
            return None;
        }
        let times = self.poses.iter().map(|(at_s, _)| *at_s);
        let gap_s = times.clone().zip(times.skip(1)).map(|(a, b)| b - a).fold(age_s, f64::max);
        let count = self.poses.len() as f64;
        let middle_m = self.poses.iter().map(|(_, p_m)| *p_m).sum::<DVec3>() / count;
        let off_m2 = |(_, p_m): &(f64, DVec3)| (*p_m - middle_m).length_squared();
        let most_m2 = self.poses.iter().map(off_m2).fold(0.0, f64::max);
        let rms_m = (self.poses.iter().map(off_m2).sum::<f64>() / count).sqrt();
        Some(PoseSummary {
            age_s,
            gap_s,
            jitter_mm: (most_m2.sqrt() < MOVING_M).then_some(rms_m * 1e3),
            allowance_s: self.allowance_s,
        })
    }
}

/// Length of the window. [s]
const WINDOW_S: f64 = 3.0;
/// Maximum poses: about 500 Hz.
const MAX_POSES: usize = 1500;
/// Minimum time of poses for a summary. [s]
const SETTLED_S: f64 = 1.0;
/// Distance from the mean above which the vehicle moves. [m]
const MOVING_M: f64 = 0.05;
