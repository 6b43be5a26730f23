//! `vizflyt replay`: a flight's log to a plugin, in its own process over the same shared memory.
//!
//! ```text
//! log ─▶ ReplayPlan ─────────┐
//! log ─▶ observations ─────┴─▶ Feeder: decode, publish ══shared memory══▶ plugin process
//!                                 ▲      next image after the answer          │
//!                                 └───────────────────────────────────────────┘
//!                                 └─▶ answers file, comparison with the flight
//! ```
//! The plugin sees what it saw in flight, bit by bit: the same bytes are decoded by the same code
//! into the same layout, and the observation's head (vehicle, stamps, numbers) is the recorded one.
//! A reduced log holds the images of some observations only: those are fed, bit by bit, and the report
//! counts the others. In lock-step nothing depends on how fast this computer is, so a deterministic plugin answers
//! the same every time. Nothing is flown: there is no link here.

mod compare;
mod feeder;
mod plan;
#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::json;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::Setpoint;
use vizflyt_protocol::time::HostTime;

pub use self::compare::{Difference, difference};
use self::feeder::{FeedOutcome, Feeder};
pub use self::feeder::{decode, observation_len};
use self::plan::FeedAction;
pub use self::plan::{FlownPlugin, ReplayPlan};
use crate::lockstep::ProcessError;
use crate::log::read::{LogError, LogReader, Recorded, RecordedFlight};
use crate::supervisor::{PluginLimits, Stream};

/// Why a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// It was written with another layout of shared memory.
    #[error(
        "the log is of protocol {found}, written by {program}, and this program is of protocol \
         {PROTOCOL_VERSION}: replay it with the version that flew it; --poses-to and Foxglove read it as it is"
    )]
    Protocol {
        /// The protocol's version.
        found: u32,
        /// The program that wrote it, from the log.
        program: String,
    },
    /// It has no images.
    #[error("the log has no images: none came in that flight, or its disk was full")]
    NoImages,
    /// It does not say what the plugin flew in.
    #[error("the log does not say what the plugin flew in: the plugin never attached")]
    NoStart,
    /// The plugin's process cannot be started, or shared memory failed.
    #[error(transparent)]
    Process(#[from] ProcessError),
    /// The answers cannot be written.
    #[error("answers {0} cannot be written: {1}")]
    Answers(PathBuf, std::io::Error),
}

/// How to replay.
#[derive(Clone, Debug)]
pub struct ReplayOptions {
    /// The command that starts the plugin, before the runtime's own argument.
    pub command: Vec<OsString>,
    /// What it may take, and the map that it is handed: as in flight.
    pub limits: PluginLimits,
    /// At the flight's pace instead of as fast as possible.
    pub is_realtime: bool,
    /// Images that the plugin skipped in flight, too.
    pub all: bool,
    /// An answer that takes longer ends the replay.
    pub answer_within: Duration,
    /// Where all answers go, one JSON object per line.
    pub answers: PathBuf,
}

/// Where an answer differs from the flight's.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Differs {
    /// The observation's number in the flight.
    pub image: u64,
    /// Since the first observation. [s]
    pub at_s: f64,
    /// What differs most.
    pub difference: Difference,
    /// The flight's answer.
    pub recorded: Option<Setpoint>,
    /// The replay's.
    pub replayed: Option<Setpoint>,
}

/// What a replay found.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ReplayReport {
    /// Observations in the log.
    pub images_logged: u64,
    /// Those whose images are not in it, as it is a reduced log.
    pub images_left_out: u64,
    /// Those that the plugin got.
    pub images_fed: u64,
    /// Those that the plugin answered in flight, but whose images the log lacks: dropped, or
    /// damaged.
    pub images_missing: u64,
    /// Answers that the flight has, too.
    pub compared: u64,
    /// Those that differ.
    pub differ: u64,
    /// The first that differs.
    pub first: Option<Differs>,
    /// The one that differs most.
    pub largest: Option<Differs>,
    /// How the plugin failed, in a sentence; `None` if it came to the end.
    pub plugin_failed: Option<String>,
    /// Whether the log ends early, as after a killed runtime.
    pub log_is_cut: bool,
    /// How long it took. [s]
    pub seconds: f64,
}

impl ReplayReport {
    fn compare(
        &mut self,
        image: u64,
        at_s: f64,
        recorded: Option<&Setpoint>,
        replayed: Option<&Setpoint>,
    ) {
        self.compared += 1;
        let Some(difference) = difference(recorded, replayed) else { return };
        self.differ += 1;
        let amount = difference.amount;
        let differs = Differs {
            image,
            at_s,
            difference,
            recorded: recorded.cloned(),
            replayed: replayed.cloned(),
        };
        if self.largest.as_ref().is_none_or(|largest| amount > largest.difference.amount) {
            self.largest = Some(differs.clone());
        }
        self.first.get_or_insert(differs);
    }
}

/// Replays `log`; `line` is called with every line that the plugin prints. The calling thread must live as
/// long: the plugin dies with it.
///
/// # Errors
/// [`ReplayError`], if it cannot begin or go on. A plugin that fails is in the report.
pub fn replay(
    log: &Path,
    plan: ReplayPlan,
    options: &ReplayOptions,
    line: &mut dyn FnMut(Stream, &str),
) -> Result<ReplayReport, ReplayError> {
    let lost = |error| ReplayError::Answers(options.answers.clone(), error);
    let mut answers = BufWriter::new(File::create(&options.answers).map_err(lost)?);
    let started = Instant::now();
    let mut report = ReplayReport {
        images_logged: plan.observations,
        images_left_out: plan.without_images,
        log_is_cut: plan.is_cut,
        ..ReplayReport::default()
    };
    let mut feeder = Feeder::new(options, line);
    let failed = run(log, plan, options, &mut feeder, &mut report, &mut answers);
    // What it printed last is on its way, also of one that failed.
    feeder.stop();
    let failed = failed?;
    answers.flush().map_err(lost)?;
    report.plugin_failed = failed;
    report.seconds = started.elapsed().as_secs_f64();
    Ok(report)
}

fn run(
    log: &Path,
    mut plan: ReplayPlan,
    options: &ReplayOptions,
    feeder: &mut Feeder<'_>,
    report: &mut ReplayReport,
    answers: &mut impl Write,
) -> Result<Option<String>, ReplayError> {
    let mut flight = RecordedFlight::new(LogReader::open(log)?, true);
    let mut pace: Option<(HostTime, Instant)> = None;
    while let Some(recorded) = flight.next()? {
        let Recorded::Observation(observation) = recorded else { continue };
        let published = HostTime::from_ns(observation.published_ns);
        let FeedAction::After(time, answer) = plan.feed(observation.seq, published, options.all)
        else {
            continue;
        };
        if observation.images.is_empty() {
            // Left out of a reduced log, as the report says.
            continue;
        }
        while let Some((_, message)) = plan.messages.pop_front_if(|(sent, _)| *sent < time) {
            if let Err(why) = feeder.send(&message)? {
                return Ok(Some(why));
            }
        }
        let (first, began) = *pace.get_or_insert((published, Instant::now()));
        let at_s = published.seconds_since(first);
        if options.is_realtime {
            let due = began + Duration::from_secs_f64(at_s.max(0.0));
            feeder.idle_until(due);
        }
        let setpoint = match feeder.feed(&observation)? {
            FeedOutcome::Replied(setpoint) => setpoint,
            FeedOutcome::Undecodable => {
                report.images_missing += u64::from(answer.is_some());
                continue;
            }
            FeedOutcome::Failed(why) => return Ok(Some(why)),
        };
        report.images_fed += 1;
        // Only what is the same in every replay: no time of this computer.
        let text = json!({"image": observation.seq, "at_s": at_s, "setpoint": setpoint});
        writeln!(answers, "{text}")
            .map_err(|error| ReplayError::Answers(options.answers.clone(), error))?;
        if let Some(answer) = answer {
            report.compare(observation.seq, at_s, answer.setpoint.as_ref(), setpoint.as_ref());
        }
    }
    report.images_missing += plan.unfed();
    Ok(None)
}

/// Sleeps until then, at most.
fn sleep_until(due: Instant) {
    thread::sleep(due.saturating_duration_since(Instant::now()));
}
