//! One graded flight on a virtual clock: simulated vehicle, runtime, referee and renderer in one
//! thread, with the plugin in a separate process. The simulation waits for each answer.
//!
//! ```text
//! tick of 2.5 ms:  Simulation ──MAVLink──▶ Lockstep ──MAVLink──▶ Simulation
//!                  mocap ─▶ Referee (filter, rules) ─▶ poses, events ─▶ Lockstep
//! image is due:    Referee's motion ─▶ pose of the vehicle when it is delivered ─▶ CpuRenderer
//! sensor is due:   same ─▶ reading, with the delay of an image
//! image arrives:   observation ─▶ plugin ─▶ answer; takes effect `answer` later
//! ```
//! The wall clock only decides whether a plugin hangs, and the order of threads decides nothing:
//! the same program, plugin, course and seed give the same bits on the same kind of processor.
//! [`TrialResult::hash`] covers all of them.
//!
//! `flight`: the loop; `pending`: an image between camera and plugin; `kept`: data for the report.

mod flight;
mod kept;
mod pending;

use std::cell::Cell;
use std::collections::VecDeque;
use std::ffi::OsString;
use std::fs::File;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use vizflyt_arena::crash::{ClearanceAhead, Flight as Record, TimedSetpoint};
use vizflyt_arena::verdict::{Sample, Verdict};
use vizflyt_protocol::messages::{Event, Odometry};
use vizflyt_protocol::time::ServerTime;
use vizflyt_runtime::lockstep::PluginProcess;
use vizflyt_runtime::log::LoggedImages;
use vizflyt_runtime::supervisor::PluginLimits;
use vizflyt_simulator::imu::ImuModel;
use vizflyt_studio::course::CourseInstance;
use vizflyt_studio::evaluate::Stamped;
use vizflyt_trust::{CourseSecret, Purpose};

use self::flight::Flight;

/// Fixed delays of a graded flight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Delays {
    /// Image period of cameras without their own rate. [ns]
    pub image_period_ns: i64,
    /// Delay from the start of rendering until the image is delivered to the plugin. The image
    /// shows the predicted pose of the vehicle at delivery. [ns]
    pub image_ns: i64,
    /// Delay from delivery of an image until the plugin's answer takes effect. [ns]
    pub answer_ns: i64,
}

/// Parameters of a graded flight.
pub(crate) struct Trial<'a> {
    pub course: &'a CourseInstance,
    /// Secret from which course and noise follow, with the seed.
    pub secret: &'a CourseSecret,
    /// Seed of the flight.
    pub seed: u64,
    /// Command that starts the plugin.
    pub command: &'a [OsString],
    /// Limits of the plugin's sandbox.
    pub limits: &'a PluginLimits,
    /// Timeout of an answer, in the plugin's own time; a timeout is a failure.
    pub answer_within: Duration,
    /// Time model.
    pub delays: Delays,
    /// Simulated inertial sensor.
    pub imu: ImuModel,
    /// Stop flag.
    pub stop: &'a AtomicBool,
    /// Log of the flight, if requested.
    pub log: Option<TrialLog<'a>>,
    /// Progress of an earlier, lost attempt: the repeated flight must pass the same state.
    pub reached: &'a Cell<Option<Reached>>,
}

/// Progress of a flight.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reached {
    /// Number of images that the plugin has answered.
    images: u64,
    /// Hash of the flight until then.
    hash: [u8; 32],
}

/// A repeated flight differs from the lost one: otherwise a plugin with random behaviour could end
/// itself to get another attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the repeated flight differs before the point where the first one was lost; a plugin that is not deterministic \
     and is killed gets no grade"
)]
pub(crate) struct AnotherWay;

/// Log of a flight.
pub(crate) struct TrialLog<'a> {
    /// An empty file.
    pub file: &'a File,
    /// Images to log.
    pub images: LoggedImages,
    /// Whether to log depth for viewers too.
    pub depth: bool,
    /// Plugin as given on the command line.
    pub plugin: &'a OsString,
}

/// An image that was delivered to the plugin, for the report.
#[derive(Clone, Debug)]
pub(crate) struct TrialImage {
    /// Instant that the image shows.
    pub stamp: ServerTime,
    /// RGB, H x W x 3.
    pub rgb: Vec<u8>,
    /// Size of the image. [px]
    pub size_px: (u32, u32),
}

/// The result of a trial.
#[derive(Clone, Debug)]
pub(crate) struct TrialResult {
    /// Verdict with the score.
    pub verdict: Verdict,
    /// Hash over all samples, setpoints, events and images.
    pub hash: [u8; 32],
    /// All events, in order.
    pub events: Vec<Event>,
    /// Track of the vehicle at 200 Hz.
    pub samples: Vec<Sample>,
    /// Setpoints of the plugin.
    pub asked: Vec<TimedSetpoint>,
    /// Clearance ahead in the answered images.
    pub seen: Vec<ClearanceAhead>,
    /// Newest images until the end of the flight was decided.
    pub shots: VecDeque<TrialImage>,
    /// Images from take-off until then, evenly spread.
    pub keyframes: Vec<TrialImage>,
    /// Last lines that the plugin printed.
    pub lines: VecDeque<String>,
    /// Images that the plugin answered.
    pub images: u64,
    /// Pose estimates of the plugin.
    pub odometry: Vec<Odometry>,
    /// True poses of the simulated vehicle at 200 Hz, if the plugin publishes estimates.
    pub truth: Vec<Stamped>,
    /// Virtual time of the flight. [s]
    pub virtual_s: f64,
}

impl TrialResult {
    /// Returns the record from which the probable cause is determined.
    pub(crate) fn record(&self, delays: &Delays) -> Record<'_> {
        Record {
            verdict: &self.verdict,
            samples: &self.samples,
            asked: Some(&self.asked),
            seen: &self.seen,
            last_line: self.lines.back().map(String::as_str),
            delay_s: (delays.image_ns + delays.answer_ns) as f64 * 1e-9,
        }
    }
}

impl Trial<'_> {
    /// Returns the seed for one purpose.
    fn seed(&self, purpose: Purpose) -> u64 {
        self.secret.seed(purpose, self.seed)
    }

    /// Flies; returns `None` if stopped. The calling thread must live as long as the flight: the
    /// plugin dies with it.
    ///
    /// # Errors
    /// If the plugin cannot be started, or shared memory fails. A failure of the plugin is a
    /// verdict, not an error.
    pub(crate) fn fly(&self) -> Result<Option<TrialResult>> {
        let expected = self.reached.get();
        let process = PluginProcess::start(self.command, self.limits, self.answer_within)?;
        let mut flight = Flight::new(self, process)?;
        let result = flight.run();
        flight.lockstep.stop(&mut flight.lines.sink());
        flight.log_lines();
        if !result? {
            return Ok(None);
        }
        ensure!(expected.is_none_or(|expected| expected.images <= flight.answered), AnotherWay);
        if let Some(log) = flight.lockstep.take_log() {
            log.finish().context("the flight's log cannot be written")?;
        }
        Ok(Some(flight.end()))
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use vizflyt_simulator::imu::{Imu, SensorSample};

    use super::*;

    /// Samples that a plugin receives before take-off.
    fn at_rest(seed: u64) -> [SensorSample; 6] {
        let mut imu = Imu::new(ImuModel::default(), seed);
        [(); 6].map(|()| imu.sample(DVec3::Z * 9.81, DVec3::ZERO, 0.0, [0.0; 4], 0.0025))
    }

    #[test]
    fn imu_noise_identifies_the_seed_only_of_public_courses() {
        let folder = tempfile::tempdir().unwrap();
        let secret = CourseSecret::read_or_create(&folder.path().join("secret")).unwrap();
        // A plugin that tries all likely seeds.
        let guess = |secret: &CourseSecret| {
            let observed = at_rest(secret.seed(Purpose::Noise, 4711));
            (0..10_000).find(|&seed| at_rest(seed) == observed)
        };
        assert_eq!(guess(&CourseSecret::PUBLIC), Some(4711));
        assert_eq!(guess(&secret), None);
        // The seed of the noise itself, if it were found, is of no use for the course.
        let noise = secret.seed(Purpose::Noise, 4711);
        let course = |seed| CourseSecret::PUBLIC.seed(Purpose::Course, seed);
        assert_ne!(course(noise), secret.seed(Purpose::Course, 4711));
    }
}
