//! Schedule and exposure of a vehicle's cameras. Pure, with time as an argument, so that the render thread
//! (wall clock) and graded flights (virtual clock) follow the same rules.
//!
//! ```text
//! periods, now ──▶ CameraSchedule ──▶ the cameras that are due
//! newest motion, now ──▶ Exposure ──▶ instant of the images, pose at that instant, render cameras
//! ```

use glam::DVec3;
use vizflyt_arena::config::CameraConfig;
use vizflyt_arena::pose::Predict;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::{CameraInfo, MAX_CAMERAS};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::weather::Moment;
use vizflyt_splat::{Atmosphere, Camera};

use crate::poses::newest::Localized;

/// Default time from rendering to the plugin, until a runtime has reported it; typical for a common machine.
/// [ns]
const SEEN_AFTER_NS: i64 = 15_000_000;
/// Colour outside the twin: black, like the trainers' background.
const BACKGROUND: [f32; 3] = [0.0; 3];

/// Times between images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Periods {
    /// Period of a camera without its own rate. [ns]
    pub default_ns: i64,
    /// Minimum period of all cameras. [ns]
    pub least_ns: i64,
    /// Cameras that are due within this time are rendered together. [ns]
    pub together_ns: i64,
}

impl Periods {
    fn of(&self, camera: &CameraConfig) -> i64 {
        camera.rate_hz.map_or(self.default_ns, |hz| (1e9 / hz) as i64).max(self.least_ns)
    }
}

/// Due times of one vehicle's cameras.
#[derive(Clone, Debug)]
pub struct CameraSchedule {
    due: [ServerTime; MAX_CAMERAS],
}

impl CameraSchedule {
    /// Creates a schedule in which every camera is due at `now`.
    pub fn new(now: ServerTime) -> Self {
        Self { due: [now; MAX_CAMERAS] }
    }

    /// Limits each wait to the camera's present period, so that a faster rate takes effect at once.
    pub fn hasten(&mut self, cameras: &[CameraConfig], periods: &Periods, now: ServerTime) {
        for (due, camera) in self.due.iter_mut().zip(cameras) {
            *due = (*due).min(now.plus_ns(periods.of(camera)));
        }
    }

    /// Returns the earliest due time; `None` without cameras.
    pub fn next(&self, cameras: &[CameraConfig]) -> Option<ServerTime> {
        self.due[..cameras.len().min(MAX_CAMERAS)].iter().min().copied()
    }

    /// Returns the cameras to render at `now`, and schedules their next images.
    pub fn take(
        &mut self,
        cameras: &[CameraConfig],
        periods: &Periods,
        now: ServerTime,
    ) -> [bool; MAX_CAMERAS] {
        let mut taken = [false; MAX_CAMERAS];
        for ((taken, due), camera) in taken.iter_mut().zip(&mut self.due).zip(cameras) {
            *taken = *due <= now.plus_ns(periods.together_ns);
            if *taken {
                // Counted from the due time, to keep the mean rate; after a rest, from now.
                *due = due.plus_ns(periods.of(camera)).max(now);
            }
        }
        taken
    }
}

/// Instant, pose and velocity of one vehicle's images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Instant that the images show.
    pub at: ServerTime,
    /// Pose of the vehicle at that instant.
    pub world_from_body: Pose<World, Body>,
    /// Velocity of the vehicle. [m/s, world]
    pub v_world_mps: DVec3,
}

impl Exposure {
    /// Returns the exposure of images rendered at `now`, which the plugin receives `seen_after_ns` later;
    /// `None` uses the default. [ns]
    pub fn new(
        predict: Predict,
        seen_after_ns: Option<i64>,
        newest: &Localized,
        now: ServerTime,
    ) -> Self {
        let Localized { sample, motion } = newest;
        let v_world_mps = motion.v_world_mps;
        let after_ns = match predict {
            Predict::Measured => {
                let world_from_body = sample.world_from_body;
                return Self { at: sample.stamp, world_from_body, v_world_mps };
            }
            Predict::Drawn => 0,
            Predict::Seen => seen_after_ns.unwrap_or(SEEN_AFTER_NS),
        };
        let at = motion.reach(now.plus_ns(after_ns));
        Self { at, world_from_body: motion.at(at), v_world_mps }
    }

    /// Returns the moment of the images, for a flight with this seed.
    pub fn moment(&self, seed: u64) -> Moment {
        Moment { at_ns: self.at.as_ns().cast_signed(), v_world_mps: self.v_world_mps, seed }
    }

    /// Returns the camera to render, at its pose at that instant.
    pub fn camera(
        &self,
        config: &CameraConfig,
        info: &CameraInfo,
        atmosphere: Atmosphere,
    ) -> Camera {
        Camera {
            intrinsics: info.intrinsics,
            world_from_cam: self.world_from_body * info.body_from_cam,
            near_m: config.near_m as f32,
            background: BACKGROUND,
            atmosphere,
        }
    }
}

/// Returns whether the course withholds a camera's depth: "no return" everywhere.
pub fn withholds_depth(config: &CameraConfig) -> bool {
    !config.depth
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::PoseSample;

    const START: ServerTime = ServerTime::from_ns(10_000_000_000);
    /// At most 120 images a second.
    const LIVE: Periods =
        Periods { default_ns: 8_333_333, least_ns: 8_333_333, together_ns: 1_000_000 };

    fn cameras(rates_hz: &[Option<f64>]) -> Vec<CameraConfig> {
        let camera = |&rate_hz| {
            let ahead = CameraConfig::ahead("x", [4, 3], 90.0, DVec3::ZERO);
            CameraConfig { rate_hz, ..ahead }
        };
        rates_hz.iter().map(camera).collect()
    }

    /// Runs a second in which each tick takes `tick_ms`; returns the number of images of each camera.
    fn rendered_in_a_second(rates_hz: &[Option<f64>], tick_ms: i64) -> Vec<usize> {
        let (start, cameras) = (START, cameras(rates_hz));
        let mut schedule = CameraSchedule::new(start);
        let mut counts = vec![0; cameras.len()];
        let mut now = start;
        while now < start.plus_seconds(1.0) {
            schedule.hasten(&cameras, &LIVE, now);
            now = now.max(schedule.next(&cameras).unwrap());
            let taken = schedule.take(&cameras, &LIVE, now);
            assert!(taken.contains(&true), "a tick renders something");
            for (count, taken) in counts.iter_mut().zip(taken) {
                *count += usize::from(taken);
            }
            now = now.plus_ns(tick_ms * 1_000_000);
        }
        counts
    }

    #[test]
    fn every_camera_keeps_its_rate() {
        assert!(rendered_in_a_second(&[None], 1)[0].abs_diff(120) <= 1);
        let counts = rendered_in_a_second(&[Some(30.0), None, Some(10.0), Some(500.0)], 1);
        assert!(counts[0].abs_diff(30) <= 1 && counts[2].abs_diff(10) <= 1, "{counts:?}");
        assert!(counts[1].abs_diff(120) <= 1 && counts[3] == counts[1], "{counts:?}");
        // A machine that renders 40 ticks per second uses every one for the camera without a rate.
        let counts = rendered_in_a_second(&[Some(30.0), None], 25);
        assert!(counts[0].abs_diff(30) <= 1 && counts[1].abs_diff(40) <= 1, "{counts:?}");
    }

    #[test]
    fn cameras_of_one_rate_stay_together() {
        let pair = cameras(&[Some(30.0), Some(30.0)]);
        let (mut schedule, mut now) = (CameraSchedule::new(START), START);
        for k in 0..100 {
            now = now.max(schedule.next(&pair).unwrap()).plus_ns(k % 7 * 1_000_000);
            let taken = schedule.take(&pair, &LIVE, now);
            assert_eq!(taken[0], taken[1]);
        }
    }

    #[test]
    fn images_show_the_configured_instant() {
        let measured = ServerTime::from_ns(1_000_000_000);
        let mut newest = Localized::still(PoseSample::still(measured, Pose::IDENTITY));
        newest.motion.v_world_mps = DVec3::X * 5.0;
        // Rendered 10 ms after the measurement, seen 30 ms later; and a pose that is half a second old.
        let now = measured.plus_ns(10_000_000);
        let x_m = |predict, seen_after_ns, now| {
            let shown = Exposure::new(predict, seen_after_ns, &newest, now);
            let x_m = shown.world_from_body.translation_m.x;
            assert!((x_m - 5.0 * shown.at.seconds_since(measured)).abs() < 1e-9);
            x_m
        };
        assert_eq!(x_m(Predict::Measured, Some(30_000_000), now), 0.0);
        assert!((x_m(Predict::Drawn, Some(30_000_000), now) - 0.05).abs() < 1e-9);
        assert!((x_m(Predict::Seen, Some(30_000_000), now) - 0.2).abs() < 1e-9);
        assert!((x_m(Predict::Seen, None, now) - 0.05 - 5e-9 * SEEN_AFTER_NS as f64).abs() < 1e-9);
        assert!(
            (x_m(Predict::Seen, Some(30_000_000), measured.plus_ns(500_000_000)) - 1.0).abs()
                < 1e-9
        );
    }

    #[test]
    fn a_faster_rate_takes_effect_at_once() {
        let mut schedule = CameraSchedule::new(START);
        let (slow, fast) = (cameras(&[Some(0.1)]), cameras(&[Some(50.0)]));
        schedule.take(&slow, &LIVE, START);
        schedule.hasten(&slow, &LIVE, START);
        assert_eq!(schedule.next(&slow), Some(START.plus_seconds(10.0)));
        schedule.hasten(&fast, &LIVE, START);
        assert_eq!(schedule.next(&fast), Some(START.plus_ns(20_000_000)));
    }

    #[test]
    fn renders_at_the_first_tick_after_the_due_time() {
        let periods = Periods { default_ns: 33_333_333, least_ns: 0, together_ns: 0 };
        let one = cameras(&[None]);
        let (mut schedule, mut taken) = (CameraSchedule::new(START), Vec::new());
        for tick in 0..400 {
            if schedule.take(&one, &periods, START.plus_ns(tick * 2_500_000))[0] {
                taken.push(tick);
            }
        }
        // 33.3 ms are 13.33 ticks.
        assert_eq!(taken[..5], [0, 14, 27, 40, 54]);
        assert_eq!(taken.len(), 30);
    }
}
