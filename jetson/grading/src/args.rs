//! What `vizflyt grade` is told on its command line.

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

use super::judge;

/// Flies a project's course in lock-step, once for each seed, and scores the plugin.
#[derive(Args, Clone, Debug)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    args_override_self = true
)]
#[command(after_help = "Examples:
  vizflyt grade ./first --project p4 --seeds 20 --report out      flies 20 courses; open out/index.html
  vizflyt grade avoid --project forest --variants day,night       in other light, too
  vizflyt grade ./first --project p5 --variants random:20         in twenty lights and weathers that are drawn
  vizflyt grade ./first --project p5 --level g --json > me.json   the signed grade, for programs
  vizflyt grade ./first --project p5 --shard 1/8 -o 1.json        an eighth of the flights, on a cluster
  vizflyt grade merge *.json -o whole.json --report out           all eighths make the whole
  vizflyt grade verify whole.json                                 checks its signature
  vizflyt grade verify out                                        and every file of a report
  vizflyt grade ./first --project p4 --report out --resume        goes on where it was interrupted
  vizflyt grade ./first --project p4 --seeds 3 --watch            again whenever the plugin is saved

The same plugin, program and seeds give the same hash on every run. Status 0 if all flights were flown,
1 if --least was not reached.")]
pub struct GradeArgs {
    #[command(subcommand)]
    pub(super) command: Option<GradeCommand>,
    #[command(flatten)]
    pub(super) fly: FlyArgs,
}

#[derive(Args, Clone, Debug)]
pub(super) struct FlyArgs {
    /// The plugin, as for `vizflyt fly`
    #[arg(value_name = "PLUGIN", required = true)]
    pub(super) plugin: Option<OsString>,
    #[arg(long, value_name = "NAME|FILE", default_value = "p4", help = format!(
        "The project whose course is flown: {}; or a file of your own, FILE.toml", projects::NAMES.join(", ")
    ))]
    pub(super) project: String,
    /// Sensors: ug has depth, g has not
    #[arg(long, value_name = "ug|g", default_value_t)]
    pub(super) level: Level,
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "day", help = format!(
        "Light and weather that each seed is flown in: {}; or random:20, so many that are drawn from the first \
         seed within the project's bounds", Variant::names()
    ))]
    pub(super) variants: Vec<VariantChoice>,
    /// Number of seeds: each is another course
    #[arg(long, value_name = "N", default_value_t = 10)]
    pub(super) seeds: u64,
    /// The first seed, or a file that holds it: keep it secret, so that nobody prepares for the courses
    #[arg(long, value_name = "SEED|@FILE", default_value = "1")]
    pub(super) first_seed: FirstSeed,
    /// Only part I of N of the flights; `merge` makes the whole of all parts
    #[arg(long, value_name = "I/N")]
    pub(super) shard: Option<Shard>,
    /// Flights at a time [default: the number of processors]
    #[arg(long, value_name = "N")]
    pub(super) jobs: Option<NonZero<usize>>,
    /// Images a second, of cameras without a rate of their own
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    pub(super) image_rate: f64,
    /// Age of an image on arrival at the plugin
    #[arg(long, value_name = "MS", default_value_t = 30.0)]
    pub(super) image_delay: f64,
    /// From then until the answer takes effect
    #[arg(long, value_name = "MS", default_value_t = 10.0)]
    pub(super) answer_delay: f64,
    /// The simulated inertial sensor
    #[arg(long, value_name = "NAME", default_value_t, help = format!(
        "The simulated inertial sensor, with its data sheet's noise; frame: as a small frame shakes one: {}",
        ImuModel::names()
    ))]
    pub(super) imu: ImuModel,
    /// A plugin that takes more of its own time for an answer has failed
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0)]
    pub(super) answer_within: f64,
    /// Writes a report there: index.html with a card for each flight, its images, flight logs, junit.xml, and
    /// grade.json, which signs them all
    #[arg(long, value_name = "DIR")]
    pub(super) report: Option<PathBuf>,
    /// Keeps the finished flights of a grade that was interrupted, and flies the others
    #[arg(long, requires = "report")]
    pub(super) resume: bool,
    /// Grades again whenever the plugin is saved, and says what changed
    #[arg(long, conflicts_with_all = ["resume", "shard", "json", "junit", "least"])]
    pub(super) watch: bool,
    /// Says what changed since this grade, or that of a report's folder [default: what the report replaces]
    #[arg(long, value_name = "FILE|DIR")]
    pub(super) since: Option<PathBuf>,
    /// Images in the report's flight logs: as many as fit into 60 MB a minute, all, or no log
    #[arg(
        long,
        value_name = "reduced|full|none",
        value_enum,
        default_value_t,
        hide_possible_values = true
    )]
    pub(super) log: LogOption,
    /// Writes depth into them a second time so that any viewer shows it (16UC1)
    #[arg(long, requires = "report")]
    pub(super) log_depth: bool,
    /// What the plugin shall not read, beside keys, seed and report; may be given more than once
    #[arg(long, value_name = "PATH")]
    pub(super) hide: Vec<PathBuf>,
    /// Writes JUnit XML there
    #[arg(long, value_name = "FILE")]
    pub(super) junit: Option<PathBuf>,
    /// Ends with status 1 if the mean score is less than this, 0 to 100
    #[arg(long, value_name = "SCORE")]
    pub(super) least: Option<f64>,
    #[command(flatten)]
    pub(super) result: ResultArgs,
}

/// The first seed: typed, or of a file, so that it stands in no list of processes and no shell's history.
#[derive(Clone, Debug)]
pub(super) struct FirstSeed {
    pub(super) value: u64,
    pub(super) file: Option<PathBuf>,
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
        // What it holds is a secret, whatever it is.
        let value = number(&held).map_err(|_| format!("{path} holds no seed; {advice}"))?;
        Ok(Self { value, file: Some(path.into()) })
    }
}

/// Where a grade goes, and who signs it.
#[derive(Args, Clone, Debug)]
pub(super) struct ResultArgs {
    /// Prints the signed grade as JSON instead of figures for people
    #[arg(long)]
    pub(super) json: bool,
    /// Writes the signed grade there as JSON
    #[arg(long, short, value_name = "FILE")]
    pub(super) output: Option<PathBuf>,
    /// Folder of the key that grades are signed with [default: ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    pub(super) keys: Option<PathBuf>,
}

#[derive(Subcommand, Clone, Debug)]
pub(super) enum GradeCommand {
    /// Verifies the signature of a grade, and all files of a report; status 1 if anything was changed
    Verify {
        /// The grade, or the folder of its report
        #[arg(value_name = "FILE|DIR")]
        file: PathBuf,
        /// Also checks that this JUnit XML is the grade's
        #[arg(long, value_name = "FILE")]
        junit: Option<PathBuf>,
        /// Accepted signer: a public key or a file with one [default: this computer's own]
        #[arg(long, value_name = "KEY")]
        key: Option<String>,
        /// Folder of this computer's own key [default: ~/.config/vizflyt]
        #[arg(long, value_name = "DIR")]
        keys: Option<PathBuf>,
    },
    /// Makes one grade of all its parts
    Merge {
        /// The parts, as `--shard` wrote them
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// Accepted signer: a public key or a file with one [default: this computer's own]
        #[arg(long, value_name = "KEY")]
        key: Option<String>,
        /// Writes a report of the whole there: index.html, grade.json; images are in the parts' reports
        #[arg(long, value_name = "DIR")]
        report: Option<PathBuf>,
        #[command(flatten)]
        result: ResultArgs,
    },
    /// Judges a logged flight of the lab by the rules that grades go by
    Judge(judge::JudgeArgs),
    /// Prints the public key that this computer's grades are signed with
    Key {
        /// Folder of the key [default: ~/.config/vizflyt]
        #[arg(long, value_name = "DIR")]
        keys: Option<PathBuf>,
    },
}
