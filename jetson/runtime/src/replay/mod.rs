//! `vizflyt replay`: feeds a flight's log to a plugin in a separate process, over the same shared memory.
//!
//! ```text
//! log ─▶ ReplayPlan ─────────┐
//! log ─▶ observations ─────┴─▶ Feeder: decode, publish ══shared memory══▶ plugin process
//!                                 ▲      next image after the reply           │
//!                                 └───────────────────────────────────────────┘
//!                                 └─▶ file of replies, comparison with the flight
//! ```
//! The plugin receives the same inputs as in flight, bit by bit: the same code decodes the same bytes into
//! the same layout, and the observation's head (vehicle, stamps, numbers) is the recorded one. A reduced log
//! contains the images of only some observations: those are fed, and the report counts the others. Lock-step
//! makes the result independent of the computer's speed, so a deterministic plugin always gives the same
//! replies. No vehicle is involved.

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

/// Reason for which a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The log has another layout of shared memory.
    #[error(
        "the log is of protocol {found}, written by {program}, and this program is of protocol \
         {PROTOCOL_VERSION}: replay it with the version that flew it; --poses-to and Foxglove can read it"
    )]
    Protocol {
        /// Protocol version of the log.
        found: u32,
        /// Program that wrote the log.
        program: String,
    },
    /// The log has no images.
    #[error("the log has no images: none arrived in that flight, or its disk was full")]
    NoImages,
    /// The log has no start message of a plugin.
    #[error(
        "the log has no start message: the plugin never attached; give the log of a flight whose plugin has started"
    )]
    NoStart,
    /// The plugin's process cannot be started, or shared memory failed.
    #[error(transparent)]
    Process(#[from] ProcessError),
    /// The file of replies cannot be written.
    #[error("answers {0} cannot be written: {1}")]
    Answers(PathBuf, std::io::Error),
}

/// Options of a replay.
#[derive(Clone, Debug)]
pub struct ReplayOptions {
    /// Command of the plugin, without the runtime's argument.
    pub command: Vec<OsString>,
    /// Limits and map of the plugin, as in flight.
    pub limits: PluginLimits,
    /// Whether to replay at the flight's pace instead of as fast as possible.
    pub is_realtime: bool,
    /// Whether to feed also images that the plugin skipped in flight.
    pub all: bool,
    /// Timeout of a reply, which ends the replay.
    pub answer_within: Duration,
    /// Output file of the replies, one JSON object per line.
    pub answers: PathBuf,
}

/// Reply that differs from the flight's.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Differs {
    /// Number of the observation in the flight.
    pub image: u64,
    /// Time since the first observation. [s]
    pub at_s: f64,
    /// Largest difference.
    pub difference: Difference,
    /// Reply in the flight.
    pub recorded: Option<Setpoint>,
    /// Reply in the replay.
    pub replayed: Option<Setpoint>,
}

/// Result of a replay.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ReplayReport {
    /// Observations in the log.
    pub images_logged: u64,
    /// Observations without images, in a reduced log.
    pub images_left_out: u64,
    /// Observations fed to the plugin.
    pub images_fed: u64,
    /// Observations with a reply in flight but without intact images in the log: dropped or damaged.
    pub images_missing: u64,
    /// Replies compared with the flight's.
    pub compared: u64,
    /// Replies that differ.
    pub differ: u64,
    /// First reply that differs.
    pub first: Option<Differs>,
    /// Reply with the largest difference.
    pub largest: Option<Differs>,
    /// Failure of the plugin as a sentence; `None` if it reached the end.
    pub plugin_failed: Option<String>,
    /// Whether the log is truncated, for example because the runtime was killed.
    pub log_is_cut: bool,
    /// Duration of the replay. [s]
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

/// Replays `log`; calls `line` with each line that the plugin prints. The kernel kills the plugin when the
/// calling thread ends.
///
/// # Errors
/// [`ReplayError`], if the replay cannot begin or continue. The report contains a failure of the plugin.
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
    // Also after a failure, the last printed lines are still in the pipe.
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
            // Omitted from a reduced log; counted in the report.
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
        // No times of this computer, so that all replays write the same bytes.
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

fn sleep_until(due: Instant) {
    thread::sleep(due.saturating_duration_since(Instant::now()));
}
