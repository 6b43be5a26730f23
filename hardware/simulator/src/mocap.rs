//! Motion capture: the true pose in, Vicon Tracker's UDP object stream out. 200 Hz.
//!
//! Layout, little-endian, packed: `u32 frame, u8 items`, then per item `u8 id = 0, u16 size = 72,
//! char[24] name, f64 x, y, z [mm], f64 rx, ry, rz [rad]`.
//!
//! Rotation: turns about the fixed x, then the fixed y, then the fixed z axis,
//! `R = Rz(rz) * Ry(ry) * Rx(rx)`.

use std::collections::VecDeque;

use glam::{DQuat, EulerRot};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::AutopilotTime;

use crate::noise::Noise;

/// Bytes of a datagram with one object.
pub const DATAGRAM: usize = 5 + 3 + 72;
/// Longest object name. [bytes]
pub const MAX_NAME: usize = 24;
/// Time between two poses. [s]
const INTERVAL_S: f64 = 0.005;
/// White noise of a marker cluster's position. [m]
const POSITION_SIGMA_M: f64 = 0.0003;
/// White noise of a marker cluster's orientation: 0.1 degrees. [rad]
const ROTATION_SIGMA_RAD: f64 = 0.1 * std::f64::consts::PI / 180.0;

/// What is tracked, and how badly.
#[derive(Clone, Debug, PartialEq)]
pub struct MocapConfig {
    /// Object name, at most [`MAX_NAME`] bytes.
    pub object: String,
    /// Seed of noise and loss.
    pub seed: u64,
    /// Nothing is sent after this. [s]
    pub stop_after_s: Option<f64>,
    /// Added between exposure and sending. [s]
    pub latency_s: f64,
    /// Share of datagrams lost at random, 0 to 1.
    pub loss: f64,
}

impl Default for MocapConfig {
    fn default() -> Self {
        Self { object: "vizflyt".into(), seed: 0, stop_after_s: None, latency_s: 0.0, loss: 0.0 }
    }
}

/// The motion capture system.
#[derive(Clone, Debug)]
pub struct Mocap {
    config: MocapConfig,
    noise: Noise,
    frame: u32,
    due: AutopilotTime,
    waiting: VecDeque<(AutopilotTime, [u8; DATAGRAM])>,
}

impl Mocap {
    /// Makes a system that tracks one object.
    pub fn new(config: MocapConfig) -> Self {
        let noise = Noise::new(config.seed, 2);
        Self { config, noise, frame: 0, due: AutopilotTime::ZERO, waiting: VecDeque::new() }
    }

    /// Looks at the true pose; measures it if it is time to.
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
            let datagram = encode_object(self.frame, &self.config.object, &measured);
            self.waiting.push_back((now.plus_seconds(self.config.latency_s), datagram));
        }
    }

    /// Returns the next datagram whose time to be sent has come.
    pub fn poll_transmit(&mut self, now: AutopilotTime) -> Option<[u8; DATAGRAM]> {
        match self.waiting.front() {
            Some(&(at, datagram)) if at <= now => {
                self.waiting.pop_front();
                Some(datagram)
            }
            _ => None,
        }
    }
}

/// Returns a datagram with one object; a longer name is cut.
pub fn encode_object(frame: u32, name: &str, pose: &Pose<World, Body>) -> [u8; DATAGRAM] {
    let mut datagram = [0; DATAGRAM];
    datagram[..4].copy_from_slice(&frame.to_le_bytes());
    datagram[4] = 1;
    datagram[6..8].copy_from_slice(&72u16.to_le_bytes());
    let length = name.len().min(MAX_NAME);
    datagram[8..8 + length].copy_from_slice(&name.as_bytes()[..length]);
    let p_mm = pose.translation_m * 1000.0;
    // Intrinsic z-y-x is fixed x-y-z.
    let (rz, ry, rx) = pose.rotation.to_euler(EulerRot::ZYX);
    for (i, value) in [p_mm.x, p_mm.y, p_mm.z, rx, ry, rz].into_iter().enumerate() {
        let at = 8 + MAX_NAME + 8 * i;
        datagram[at..at + 8].copy_from_slice(&value.to_le_bytes());
    }
    datagram
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use proptest::prelude::*;

    fn read(datagram: &[u8; DATAGRAM]) -> (u32, String, [f64; 6]) {
        let frame = u32::from_le_bytes(datagram[..4].try_into().unwrap());
        let name = String::from_utf8_lossy(&datagram[8..32]).trim_end_matches('\0').to_owned();
        let value =
            |i: usize| f64::from_le_bytes(datagram[32 + 8 * i..40 + 8 * i].try_into().unwrap());
        (frame, name, std::array::from_fn(value))
    }

    #[test]
    fn the_layout_is_tracker_s() {
        let rotation = DQuat::from_rotation_z(0.3);
        let pose = Pose::new(DVec3::new(1.0, -2.0, 0.5), rotation);
        let datagram = encode_object(7, "vizflyt", &pose);
        assert_eq!(datagram.len(), 80);
        assert_eq!(&datagram[..8], &[7, 0, 0, 0, 1, 0, 72, 0]);
        let (_, name, values) = read(&datagram);
        assert_eq!(name, "vizflyt");
        assert_eq!(&values[..3], &[1000.0, -2000.0, 500.0]);
        assert!(values[3].abs() < 1e-12 && values[4].abs() < 1e-12);
        assert!((values[5] - 0.3).abs() < 1e-12);
    }

    proptest! {
        /// R = Rz(rz) * Ry(ry) * Rx(rx).
        #[test]
        fn angles_are_about_fixed_x_then_y_then_z(
            rx in -3.0..3.0f64, ry in -1.5..1.5f64, rz in -3.0..3.0f64,
        ) {
            let rotation = DQuat::from_rotation_z(rz) * DQuat::from_rotation_y(ry) * DQuat::from_rotation_x(rx);
            let (_, _, values) = read(&encode_object(0, "x", &Pose::new(DVec3::ZERO, rotation)));
            prop_assert!((values[3] - rx).abs() < 1e-6);
            prop_assert!((values[4] - ry).abs() < 1e-6);
            prop_assert!((values[5] - rz).abs() < 1e-6);
        }
    }

    /// Runs for `seconds` and returns (time sent [ms], frame, position [m]).
    fn run(config: MocapConfig, seconds: f64) -> Vec<(u64, u32, DVec3)> {
        let mut mocap = Mocap::new(config);
        let pose = Pose::new(DVec3::new(1.0, 2.0, 3.0), DQuat::IDENTITY);
        let mut sent = Vec::new();
        for i in 0..(seconds * 400.0) as u64 {
            let now = AutopilotTime::from_ns(i * 2_500_000);
            mocap.handle_truth(now, &pose);
            while let Some(datagram) = mocap.poll_transmit(now) {
                let (frame, _, v) = read(&datagram);
                let p_m = DVec3::new(v[0], v[1], v[2]) / 1000.0;
                sent.push((now.as_ns() / 1_000_000, frame, p_m));
            }
        }
        sent
    }

    #[test]
    fn two_hundred_poses_a_second_with_little_noise() {
        let sent = run(MocapConfig::default(), 5.0);
        assert_eq!(sent.len(), 1000);
        let squares = sent.iter().map(|s| (s.2.x - 1.0).powi(2)).sum::<f64>();
        let sigma_m = (squares / 1000.0).sqrt();
        assert!((sigma_m / POSITION_SIGMA_M - 1.0).abs() < 0.15, "{sigma_m}");
    }

    #[test]
    fn impairments_stop_delay_and_drop() {
        let stopped = run(MocapConfig { stop_after_s: Some(1.0), ..Default::default() }, 3.0);
        assert!(stopped.len() == 201 && stopped.last().unwrap().0 == 1000);
        let late = run(MocapConfig { latency_s: 0.03, ..Default::default() }, 1.0);
        assert_eq!(late[0].0, 30);
        let lossy = run(MocapConfig { loss: 0.3, ..Default::default() }, 10.0);
        assert!((1300..1500).contains(&lossy.len()), "{}", lossy.len());
        assert!(lossy.last().unwrap().1 > 1990, "frame numbers go on over losses");
    }
}
