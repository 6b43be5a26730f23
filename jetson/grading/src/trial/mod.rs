//! One graded flight on a virtual clock: simulated vehicle, runtime, referee, renderer in one thread,
//! and the plugin in a process of its own that is waited for.
//!
//! ```text
//! tick of 2.5 ms:  Simulation ──MAVLink──▶ Lockstep ──MAVLink──▶ Simulation
//!                  mocap ─▶ Referee (filter, rules) ─▶ poses, events ─▶ Lockstep
//! image is due:    Referee's motion ─▶ where the vehicle will be when it is seen ─▶ CpuRenderer
//! sensor is due:   likewise ─▶ reading, on its way as long as an image
//! image is seen:   observation ─▶ plugin ─▶ answer; it counts `answer` later
//! ```
//! No wall clock decides anything but that a plugin is hung, and no order of threads anything at
//! all: the same program, plugin, course and seed give the same bits on the same kind of processor.
//! [`TrialResult::hash`] is over all of them.
//!
//! `flight` is the loop, `pending` an image between camera and plugin, `kept` what the report shows of it.

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

use self::flight::Flight;

/// How long things take in a graded flight, always the same.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Delays {
    /// From one image to the next, of cameras that have no rate of their own. [ns]
    pub image_period_ns: i64,
    /// From the start of rendering until the plugin is given the image, which shows the vehicle where
    /// it is by then, as far as can be foretold. [ns]
    pub image_ns: i64,
    /// From when the plugin is given an image until its answer counts. [ns]
    pub answer_ns: i64,
}

/// What is flown, and how.
pub(crate) struct Trial<'a> {
    /// Where.
    pub course: &'a CourseInstance,
    /// Seed of the course and of the simulator's noise.
    pub seed: u64,
    /// The command that starts the plugin.
    pub command: &'a [OsString],
    /// What it may use.
    pub limits: &'a PluginLimits,
    /// A plugin that takes more of its own time for an answer has failed.
    pub answer_within: Duration,
    /// The time model.
    pub delays: Delays,
    /// The simulated inertial sensor.
    pub imu: ImuModel,
    /// Ends it.
    pub stop: &'a AtomicBool,
    /// Where it is logged, if it is.
    pub log: Option<TrialLog<'a>>,
    /// How far it came, until it is over: the next attempt has to come by there.
    pub reached: &'a Cell<Option<Reached>>,
}

/// How far a flight came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reached {
    /// Images that the plugin has answered.
    images: u64,
    /// Over all until then.
    hash: [u8; 32],
}

/// A flight that was lost and flown again went another way: a plugin that draws lots could have ended itself to draw
/// again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "flown again, it went another way before it came to where it was lost; a plugin that is not the same every time \
     and is killed gets no grade"
)]
pub(crate) struct AnotherWay;

/// Where a flight is logged.
pub(crate) struct TrialLog<'a> {
    /// An empty file.
    pub file: &'a File,
    /// Which images it keeps.
    pub images: LoggedImages,
    /// Whether depth is written for viewers, too.
    pub depth: bool,
    /// The plugin as the command line names it.
    pub plugin: &'a OsString,
}

/// One image that the plugin was given, for the report.
#[derive(Clone, Debug)]
pub(crate) struct TrialImage {
    /// The instant that it shows.
    pub stamp: ServerTime,
    /// H x W x 3.
    pub rgb: Vec<u8>,
    /// Its size. [px]
    pub size_px: (u32, u32),
}

/// The result of a trial.
#[derive(Clone, Debug)]
pub(crate) struct TrialResult {
    /// The score.
    pub verdict: Verdict,
    /// Over all samples, setpoints, events and images.
    pub hash: [u8; 32],
    /// All that happened, in order.
    pub events: Vec<Event>,
    /// Where it was, 200 a second.
    pub samples: Vec<Sample>,
    /// The plugin's setpoints.
    pub asked: Vec<TimedSetpoint>,
    /// What was ahead in the images that it answered.
    pub seen: Vec<ClearanceAhead>,
    /// The newest images until the flight was decided.
    pub shots: VecDeque<TrialImage>,
    /// Images from take-off until then, evenly spread.
    pub keyframes: Vec<TrialImage>,
    /// The last lines that the plugin printed.
    pub lines: VecDeque<String>,
    /// Images that the plugin answered.
    pub images: u64,
    /// Where the plugin thought it was.
    pub odometry: Vec<Odometry>,
    /// Where the simulated vehicle truly was, 200 a second, while a plugin publishes.
    pub truth: Vec<Stamped>,
    /// Virtual time. [s]
    pub virtual_s: f64,
}

impl TrialResult {
    /// Returns the record from which its probable cause is found.
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
    /// Flies; `None` if it is ended by [`Self::stop`]. Call it on a thread that lives as long: the
    /// plugin dies with it.
    ///
    /// # Errors
    /// If the plugin cannot be started at all, or shared memory fails. A plugin that fails is a
    /// verdict.
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
