//! Motion capture: the true pose in, measured poses out, 200 Hz.
//!
//! [`formats`] encodes them for the wire, [`feed`] sends them.

pub mod feed;
pub mod formats;

use std::collections::VecDeque;

use glam::DQuat;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::AutopilotTime;

use crate::noise::Noise;

/// Maximum length of an object name [bytes].
pub const MAX_NAME: usize = 24;
/// Interval between poses [s].
const INTERVAL_S: f64 = 0.005;
/// White noise of a marker cluster's position [m].
const POSITION_SIGMA_M: f64 = 0.0003;
/// White noise of a marker cluster's orientation [rad]: 0.1 degrees.
const ROTATION_SIGMA_RAD: f64 = 0.1 * std::f64::consts::PI / 180.0;

/// Tracked object, and errors of the system.
#[derive(Clone, Debug, PartialEq)]
pub struct MocapConfig {
    /// Object name, at most [`MAX_NAME`] bytes.
    pub object: String,
    /// Seed of noise and loss.
    pub seed: u64,
    /// Time after which nothing is sent [s].
    pub stop_after_s: Option<f64>,
    /// Latency between exposure and sending [s].
    pub latency_s: f64,
    /// Share of datagrams lost at random, 0 to 1.
    pub loss: f64,
}

impl Default for MocapConfig {
    fn default() -> Self {
        Self { object: "vizflyt".into(), seed: 0, stop_after_s: None, latency_s: 0.0, loss: 0.0 }
    }
}

/// Measured pose of one exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// Frame number, from 1.
    pub frame: u32,
    /// Time of the exposure.
    pub at: AutopilotTime,
    /// Measured pose of the vehicle.
    pub world_from_body: Pose<World, Body>,
}

/// Simulated motion capture system.
#[derive(Clone, Debug)]
pub struct Mocap {
    config: MocapConfig,
    noise: Noise,
    frame: u32,
    due: AutopilotTime,
    waiting: VecDeque<(AutopilotTime, Sight)>,
}

impl Mocap {
    /// Returns a system that tracks one object.
    pub fn new(config: MocapConfig) -> Self {
        let noise = Noise::new(config.seed, 2);
        Self { config, noise, frame: 0, due: AutopilotTime::ZERO, waiting: VecDeque::new() }
    }

    /// Measures the true pose if the next exposure is due.
    pub fn handle_truth(&mut self, now: AutopilotTime, pose: &Pose<World, Body>) {
        if now < self.due {
            return;
        }
        let on_grid = self.due.plus_seconds(INTERVAL_S);
        self.due = if on_grid > now { on_grid } else { now.plus_seconds(INTERVAL_S) };
        self.frame = self.frame.wrapping_add(1);
        let stopped =
            self.config.stop_after_s.is_some_and(|s| now.seconds_since(AutopilotTime::ZERO) > s);
        let lost = self.noise.uniform() < self.config.loss;
        let turned = DQuat::from_scaled_axis(self.noise.gaussian3() * ROTATION_SIGMA_RAD);
        let measured = Pose::new(
            pose.translation_m + self.noise.gaussian3() * POSITION_SIGMA_M,
            pose.rotation * turned,
        );
        if !stopped && !lost {
            let sight = Sight { frame: self.frame, at: now, world_from_body: measured };
            self.waiting.push_back((now.plus_seconds(self.config.latency_s), sight));
        }
    }

    /// Returns the next measured pose that is due to be sent.
    pub fn poll_transmit(&mut self, now: AutopilotTime) -> Option<Sight> {
        match self.waiting.front() {
            Some(&(at, sight)) if at <= now => {
                self.waiting.pop_front();
                Some(sight)
            }
            _ => None,
        }
    }

    /// Returns the vehicle's name in the motion capture.
    pub fn object(&self) -> &str {
        &self.config.object
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// Runs for `seconds`. Returns (time sent [ms], frame, position [m]).
    fn run(config: MocapConfig, seconds: f64) -> Vec<(u64, u32, DVec3)> {
        let mut mocap = Mocap::new(config);
        let pose = Pose::new(DVec3::new(1.0, 2.0, 3.0), DQuat::IDENTITY);
        let mut sent = Vec::new();
        for i in 0..(seconds * 400.0) as u64 {
            let now = AutopilotTime::from_ns(i * 2_500_000);
            mocap.handle_truth(now, &pose);
            while let Some(sight) = mocap.poll_transmit(now) {
                let p_m = sight.world_from_body.translation_m;
                sent.push((now.as_ns() / 1_000_000, sight.frame, p_m));
            }
        }
        sent
    }

    #[test]
    fn sends_two_hundred_poses_a_second_with_the_given_noise() {
        let sent = run(MocapConfig::default(), 5.0);
        assert_eq!(sent.len(), 1000);
        let squares = sent.iter().map(|s| (s.2.x - 1.0).powi(2)).sum::<f64>();
        let sigma_m = (squares / 1000.0).sqrt();
        assert!((sigma_m / POSITION_SIGMA_M - 1.0).abs() < 0.15, "{sigma_m}");
    }

    #[test]
    fn stops_delays_and_drops_as_configured() {
        let stopped = run(MocapConfig { stop_after_s: Some(1.0), ..Default::default() }, 3.0);
        assert!(stopped.len() == 201 && stopped.last().unwrap().0 == 1000);
        let late = run(MocapConfig { latency_s: 0.03, ..Default::default() }, 1.0);
        assert_eq!(late[0].0, 30);
        let lossy = run(MocapConfig { loss: 0.3, ..Default::default() }, 10.0);
        assert!((1300..1500).contains(&lossy.len()), "{}", lossy.len());
        assert!(lossy.last().unwrap().1 > 1990, "frame numbers continue over losses");
    }
}
