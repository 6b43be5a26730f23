//! Command-line arguments of `vizflyt grade`.

use std::ffi::OsString;
use std::num::NonZero;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, Subcommand};
use vizflyt_runtime::args::LogOption;
use vizflyt_scenes::projects::{self, Level};
use vizflyt_scenes::{Variant, VariantChoice};
use vizflyt_simulator::imu::ImuModel;
use vizflyt_studio::shard::Shard;
use vizflyt_trust::{CourseSecret, KeyError};

use super::judge;

/// Fly a course once per seed in lock-step, and score the plugin
#[derive(Args, Clone, Debug)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    args_override_self = true
)]
#[command(after_help = "Examples:
  vizflyt grade ./first --project p4 --seeds 20 --report out      fly 20 courses; open out/index.html
  vizflyt grade avoid --project forest --variants day,night       also in other light
  vizflyt grade ./first --project p5 --variants random:20         in 20 random combinations of light and weather
  vizflyt grade ./first --project p5 --level g --json > me.json   the signed grade, for programs
  vizflyt grade ./first --project p5 --shard 1/8 -o 1.json        fly an eighth of the flights, on a cluster
  vizflyt grade merge *.json -o whole.json --report out           combine all shards
  vizflyt grade verify whole.json                                 check the signature
  vizflyt grade verify out                                        check the signature and all files of a report
  vizflyt grade ./first --project p4 --report out --resume        resume an interrupted grade
  vizflyt grade ./first --project p4 --seeds 3 --watch            grade again when the plugin is saved

The same plugin, program, seeds and secret give the same hash on every run. Status 0 if all flights were flown,
1 if --least was not reached.")]
pub struct GradeArgs {
    #[command(subcommand)]
    pub(super) command: Option<GradeCommand>,
    #[command(flatten)]
    pub(super) fly: FlyArgs,
}

#[derive(Args, Clone, Debug)]
pub(super) struct FlyArgs {
    /// Plugin, as for `vizflyt fly`
    #[arg(value_name = "PLUGIN", required = true)]
    pub(super) plugin: Option<OsString>,
    #[arg(long, help_heading = "Scene", value_name = "NAME|FILE", default_value = "p4", help = format!(
        "Project: {}; or FILE.toml", projects::NAMES.join(", ")
    ))]
    pub(super) project: String,
    /// Sensors: ug with depth, g without depth
    #[arg(long, help_heading = "Scene", value_name = "ug|g", default_value_t)]
    pub(super) level: Level,
    /// Light and weather for each seed; random:20 draws 20 combinations
    #[arg(long, help_heading = "Scene", value_name = "LIST", value_delimiter = ',', default_value = "day", long_help = format!(
        "Light and weather for each seed: {}; or random:20, which draws 20 from the first \
         seed within the project's bounds", Variant::names()
    ))]
    pub(super) variants: Vec<VariantChoice>,
    /// Timeout of an answer, in time of the plugin's own; a timeout is a failure
    #[arg(long, help_heading = "Plugin", value_name = "SECONDS", default_value_t = 10.0)]
    pub(super) answer_within: f64,
    /// Name of the team, for the signed grade
    #[arg(long, help_heading = "Plugin", value_name = "NAME")]
    pub(super) team: Option<String>,
    /// Path to hide from the plugin, like keys, secrets and report; can be repeated
    #[arg(long, help_heading = "Plugin", value_name = "PATH")]
    pub(super) hide: Vec<PathBuf>,
    /// Folder for the output of Cargo: `--watch` keeps it between its attempts
    #[arg(long, value_name = "DIR", hide = true)]
    pub(super) build_in: Option<PathBuf>,
    /// Grade again when the plugin is saved, and print what changed
    #[arg(long, help_heading = "Plugin", conflicts_with_all = ["resume", "shard", "json", "junit", "least"])]
    pub(super) watch: bool,
    /// Number of seeds; each seed gives another course
    #[arg(long, help_heading = "Flight", value_name = "N", default_value_t = 10)]
    pub(super) seeds: u64,
    /// First seed, or a file that contains it
    ///
    /// Keep it secret, so that teams cannot prepare for the courses; --secret protects it from guesses.
    #[arg(long, help_heading = "Flight", value_name = "SEED|@FILE", default_value = "1")]
    pub(super) first_seed: FirstSeed,
    /// File with the secret of the courses; created if missing
    ///
    /// Courses, noise and drift follow from its 128 random bits and the seed, so that a plugin cannot guess a course from
    /// its noise. The same file repeats the same flights. Without it, the courses are public.
    #[arg(long, help_heading = "Flight", value_name = "FILE")]
    pub(super) secret: Option<PathBuf>,
    /// Fly only shard I of N; combine all shards with `grade merge`
    #[arg(long, help_heading = "Flight", value_name = "I/N")]
    pub(super) shard: Option<Shard>,
    /// Number of flights at a time [default: number of processors]
    #[arg(long, help_heading = "Flight", value_name = "N")]
    pub(super) jobs: Option<NonZero<usize>>,
    #[arg(long, help_heading = "Vehicle", value_name = "NAME", default_value_t, help = format!(
        "Inertial sensor: {}", ImuModel::names()
    ), long_help = format!(
        "Simulated inertial sensor, with the noise of its data sheet; frame: with the vibration of a small frame: {}",
        ImuModel::names()
    ))]
    pub(super) imu: ImuModel,
    /// Image rate of cameras without their own rate [Hz]
    #[arg(long, help_heading = "Vehicle", value_name = "HZ", default_value_t = 30.0)]
    pub(super) image_rate: f64,
    /// Delay from the pose until the image is delivered to the plugin
    #[arg(long, help_heading = "Vehicle", value_name = "MS", default_value_t = 30.0)]
    pub(super) image_delay: f64,
    /// Delay from delivery of the image until the plugin's answer takes effect
    #[arg(long, help_heading = "Vehicle", value_name = "MS", default_value_t = 10.0)]
    pub(super) answer_delay: f64,
    /// Folder for a report: index.html with images, flight logs, signed grade.json
    ///
    /// index.html has a card for each flight. The folder also gets junit.xml. grade.json signs all
    /// files.
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    pub(super) report: Option<PathBuf>,
    /// Keep the finished flights of an interrupted grade, and fly the others
    #[arg(long, help_heading = "Output", requires = "report")]
    pub(super) resume: bool,
    /// Compare with this grade or report [default: the report that --report replaces]
    #[arg(long, help_heading = "Output", value_name = "FILE|DIR")]
    pub(super) since: Option<PathBuf>,
    /// File for results as JUnit XML
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    pub(super) junit: Option<PathBuf>,
    /// Minimum mean score (0 to 100); below it, the exit status is 1
    #[arg(long, help_heading = "Output", value_name = "SCORE")]
    pub(super) least: Option<f64>,
    #[command(flatten)]
    pub(super) result: ResultArgs,
    /// Images in the report's flight logs: up to 60 MB per minute, all, or no log
    #[arg(
        long,
        help_heading = "Log",
        value_name = "reduced|full|none",
        value_enum,
        default_value_t,
        hide_possible_values = true
    )]
    pub(super) log: LogOption,
    /// Also log depth in a format that all viewers show (16UC1)
    #[arg(long, help_heading = "Log", requires = "report")]
    pub(super) log_depth: bool,
}

/// First seed, from the command line or a file. A file keeps it out of the process list and the
/// shell's history.
#[derive(Clone, Debug)]
pub(super) struct FirstSeed {
    pub(super) value: u64,
    pub(super) file: Option<PathBuf>,
}

impl FlyArgs {
    /// Reads the secret of the courses, or creates it.
    ///
    /// # Errors
    /// If the file is not usable, or is missing on one of several computers.
    pub(super) fn course_secret(&self) -> Result<CourseSecret, KeyError> {
        match &self.secret {
            None => Ok(CourseSecret::PUBLIC),
            // All shards need the same file, so none of them creates it.
            Some(path) if self.shard.is_some() => CourseSecret::read(path),
            Some(path) => CourseSecret::read_or_create(path),
        }
    }
}

impl FromStr for FirstSeed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.trim().parse();
        let advice = "give a whole number from 0 on, or @FILE with one";
        let Some(path) = text.strip_prefix('@') else {
            let value = number(text).map_err(|error| format!("{error}; {advice}"))?;
            return Ok(Self { value, file: None });
        };
        let held = std::fs::read_to_string(path).map_err(|error| format!("{path}: {error}"))?;
        // The file's content is secret, so the message does not print it.
        let value = number(&held).map_err(|_| format!("{path} holds no seed; {advice}"))?;
        Ok(Self { value, file: Some(path.into()) })
    }
}

/// Destination and signer of a grade.
#[derive(Args, Clone, Debug)]
pub(super) struct ResultArgs {
    /// Print the signed grade as JSON instead of text
    #[arg(long, help_heading = "Output")]
    pub(super) json: bool,
    /// File for the signed grade, as JSON
    #[arg(long, short, help_heading = "Output", value_name = "FILE")]
    pub(super) output: Option<PathBuf>,
    /// Folder of the key that signs grades [default: ~/.config/vizflyt]
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    pub(super) keys: Option<PathBuf>,
}

#[derive(Subcommand, Clone, Debug)]
pub(super) enum GradeCommand {
    /// Verify the signature of a grade and all files of a report
    ///
    /// Ends with status 1 if anything was changed.
    Verify {
        /// Grade, or the folder of its report
        #[arg(value_name = "FILE|DIR")]
        file: PathBuf,
        /// JUnit XML file to compare with the grade
        #[arg(long, value_name = "FILE")]
        junit: Option<PathBuf>,
        /// Accepted signer: a public key or a file with one [default: this computer's key]
        #[arg(long, value_name = "KEY")]
        key: Option<String>,
        /// Folder of this computer's own key [default: ~/.config/vizflyt]
        #[arg(long, value_name = "DIR")]
        keys: Option<PathBuf>,
    },
    /// Combine all shards of a grade
    Merge {
        /// Shards, as `--shard` wrote them
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// Accepted signer: a public key or a file with one [default: this computer's key]
        #[arg(long, value_name = "KEY")]
        key: Option<String>,
        /// Folder for a report of the combined grade: index.html, grade.json
        ///
        /// Images stay in the reports of the shards.
        #[arg(long, help_heading = "Output", value_name = "DIR")]
        report: Option<PathBuf>,
        #[command(flatten)]
        result: ResultArgs,
    },
    /// Judge a logged flight of the lab by the rules of grades
    Judge(judge::JudgeArgs),
    /// Print the public key of this computer's grades
    Key {
        /// Folder of the key [default: ~/.config/vizflyt]
        #[arg(long, value_name = "DIR")]
        keys: Option<PathBuf>,
    },
}
