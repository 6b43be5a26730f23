//! `vizflyt grade`: flies a plugin through a project's course, once for each seed, and scores
//! it.
//!
//! ```text
//! project, level, variant, seed -> course  in memory: splats, arena, distance field
//!                               -> trial   one flight in lock-step, a plugin process of its own
//!                               -> vizflyt_arena::crash  what a failure probably was
//! each flight                   -> folder    its card's images, its log, its record (record)
//! flights                       -> document  figures, hash, signature -> report/, junit, JSON
//! parts of a grade              -> merge     the whole
//! ```
//! The guides are `docs/guides/grading.md` and `grading-at-scale.md`.

pub(crate) mod course;
pub(crate) mod document;
mod folder;
mod judge;
mod junit;
mod keys;
mod merge;
mod odometry;
mod pool;
mod progress;
mod record;
pub(crate) mod report;
mod statistics;
mod trial;

use std::cell::Cell;
use std::collections::{BTreeSet, HashMap};
use std::ffi::OsString;
use std::hash::{BuildHasher, RandomState};
use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use anyhow::{Context, Error, Result, bail, ensure};
use clap::{Args, Subcommand, ValueEnum};
use vizflyt_arena::crash::probable_cause;
use vizflyt_runtime::log::LoggedImages;
use vizflyt_runtime::supervisor::{Confinement, PluginLimits};
use vizflyt_scenes::projects::{self, CourseProject, Level};
use vizflyt_scenes::{Variant, VariantChoice};
use vizflyt_simulator::imu::ImuModel;
use vizflyt_splat::{CpuRenderer, Rasterizer, Splats};

use self::course::{CourseInstance, graded_name};
pub(crate) use self::document::Grade;
use self::document::{DelaysMs, MAX_SEEDS, Run, Shard, SignedFile, Subject, VariantSummary, hex};
use self::folder::{FLIGHTS, ReportFolder};
use self::odometry::odometry_score;
use self::progress::Progress;
use self::record::{FlightRecord, FlownWith, SealingKey};
use self::trial::{AnotherWay, Delays, Trial, TrialLog, TrialResult};
use crate::fly::plugin::Plugin;
use crate::terminal::{print_error, print_line, stop_flag};

/// Flies a project's course in lock-step, once for each seed, and scores the plugin.
#[derive(Args, Clone, Debug)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
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

The same plugin, program and seeds give the same hash on every run. Status 0 if all flights were flown,
1 if --least was not reached.")]
pub(crate) struct GradeArgs {
    #[command(subcommand)]
    command: Option<GradeCommand>,
    #[command(flatten)]
    fly: FlyArgs,
}

#[derive(Args, Clone, Debug)]
struct FlyArgs {
    /// The plugin, as for `vizflyt fly`
    #[arg(value_name = "PLUGIN", required = true)]
    plugin: Option<OsString>,
    #[arg(long, value_name = "NAME|FILE", default_value = "p4", help = format!(
        "The project whose course is flown: {}; or a file of your own, FILE.toml", projects::NAMES.join(", ")
    ))]
    project: String,
    /// Sensors: ug has depth, g has not
    #[arg(long, value_name = "ug|g", default_value_t)]
    level: Level,
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "day", help = format!(
        "Light and weather that each seed is flown in: {}; or random:20, so many that are drawn from the first \
         seed within the project's bounds", Variant::names()
    ))]
    variants: Vec<VariantChoice>,
    /// Number of seeds: each is another course
    #[arg(long, value_name = "N", default_value_t = 10)]
    seeds: u64,
    /// The first seed, or a file that holds it: keep it secret, so that nobody prepares for the courses
    #[arg(long, value_name = "SEED|@FILE", default_value = "1")]
    first_seed: FirstSeed,
    /// Only part I of N of the flights; `merge` makes the whole of all parts
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Flights at a time [default: the number of processors]
    #[arg(long, value_name = "N")]
    jobs: Option<NonZero<usize>>,
    /// Images a second, of cameras without a rate of their own
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    image_rate: f64,
    /// Age of an image on arrival at the plugin
    #[arg(long, value_name = "MS", default_value_t = 30.0)]
    image_delay: f64,
    /// From then until the answer takes effect
    #[arg(long, value_name = "MS", default_value_t = 10.0)]
    answer_delay: f64,
    /// The simulated inertial sensor
    #[arg(long, value_name = "NAME", default_value_t, help = format!(
        "The simulated inertial sensor, with its data sheet's noise; frame: as a small frame shakes one: {}",
        ImuModel::names()
    ))]
    imu: ImuModel,
    /// A plugin that takes more of its own time for an answer has failed
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0)]
    answer_within: f64,
    /// Writes a report there: index.html with a card for each flight, its images, flight logs, junit.xml, and
    /// grade.json, which signs them all
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Keeps the finished flights of a grade that was interrupted, and flies the others
    #[arg(long, requires = "report")]
    resume: bool,
    /// Images in the report's flight logs: as many as fit into 60 MB a minute, all, or no log
    #[arg(
        long,
        value_name = "reduced|full|none",
        value_enum,
        default_value_t,
        hide_possible_values = true
    )]
    log: GradeLog,
    /// Writes depth into them a second time so that any viewer shows it (16UC1)
    #[arg(long, requires = "report")]
    log_depth: bool,
    /// What the plugin shall not read, beside keys, seed and report; may be given more than once
    #[arg(long, value_name = "PATH")]
    hide: Vec<PathBuf>,
    /// Writes JUnit XML there
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Ends with status 1 if the mean score is less than this, 0 to 100
    #[arg(long, value_name = "SCORE")]
    least: Option<f64>,
    #[command(flatten)]
    result: ResultArgs,
}

/// The first seed: typed, or of a file, so that it stands in no list of processes and no shell's history.
#[derive(Clone, Debug)]
struct FirstSeed {
    value: u64,
    file: Option<PathBuf>,
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

/// What a report holds of flight logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum GradeLog {
    #[default]
    Reduced,
    Full,
    None,
}

impl GradeLog {
    fn images(self) -> Option<LoggedImages> {
        match self {
            Self::Reduced => Some(LoggedImages::Reduced),
            Self::Full => Some(LoggedImages::Full),
            Self::None => None,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Reduced => "reduced",
            Self::Full => "full",
            Self::None => "none",
        }
    }
}

/// Where a grade goes, and who signs it.
#[derive(Args, Clone, Debug)]
struct ResultArgs {
    /// Prints the signed grade as JSON instead of figures for people
    #[arg(long)]
    json: bool,
    /// Writes the signed grade there as JSON
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Folder of the key that grades are signed with [default: ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

#[derive(Subcommand, Clone, Debug)]
enum GradeCommand {
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

/// Does what was asked for.
pub(crate) fn run(args: &GradeArgs) -> Result<ExitCode> {
    match &args.command {
        None => grade(&args.fly),
        Some(GradeCommand::Verify { file, junit, key, keys }) => {
            let is_folder = file.is_dir();
            let document = if is_folder { file.join(folder::GRADE) } else { file.clone() };
            let grade = verified(&document, key.as_deref(), keys.as_deref())?;
            if is_folder {
                let cannot = || format!("{} does not count", file.display());
                folder::verify(file, &grade).with_context(cannot)?;
            }
            if let Some(path) = junit {
                junit::verify(path, &grade)?;
            }
            print_line(format!(
                "{}: as signed with {}; score {:.1}, {} of {} finished",
                file.display(),
                grade.signature.as_ref().map_or("", |signed| &signed.key),
                grade.summary.score.value,
                grade.summary.finished,
                grade.summary.runs
            ));
            match grade.files.len() {
                0 => {}
                count if is_folder => print_line(format!("all {count} files are as signed")),
                count => print_line(format!(
                    "the report's {count} files were not looked at: give its folder for that"
                )),
            }
            Ok(ExitCode::SUCCESS)
        }
        Some(GradeCommand::Merge { files, key, report, result }) => {
            let read = |path: &PathBuf| Ok((path.display().to_string(), Grade::read(path)?));
            let parts = files.iter().map(read).collect::<Result<Vec<_>>>()?;
            let key = keys::verifying_key(key.as_deref(), result.keys.as_deref())?;
            let mut grade = merge::merge(&parts, &key)?;
            check_outputs(report.as_deref(), result, None)?;
            let folder = report.as_deref().map(ReportFolder::begin).transpose()?;
            let key = keys::signing_key(result.keys.as_deref())?;
            if let Some(folder) = &folder {
                let cards: Vec<String> =
                    grade.runs.iter().map(report::card::without_images).collect();
                report::write(folder, &mut grade, Some(&key), &cards, Vec::new())?;
            } else {
                grade.sign(&key)?;
            }
            hand_over(&grade, result)?;
            if let (Some(folder), false) = (report, result.json) {
                print_line(format!("report      {}", folder.join(folder::PAGE).display()));
            }
            Ok(ExitCode::SUCCESS)
        }
        Some(GradeCommand::Judge(args)) => judge::run(args),
        Some(GradeCommand::Key { keys }) => {
            print_line(hex(&keys::signing_key(keys.as_deref())?.verifying_key().to_bytes()));
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// Returns the grade of a file if it is as it was signed with a key: as given, in hexadecimal or in a
/// file; else this computer's own.
///
/// # Errors
/// What does not hold, in a sentence.
pub(crate) fn verified(file: &Path, key: Option<&str>, keys: Option<&Path>) -> Result<Grade> {
    let grade = Grade::read(file)?;
    let key = keys::verifying_key(key, keys)?;
    grade.verify(&key).with_context(|| format!("{} does not count", file.display()))?;
    Ok(grade)
}

/// Flies, judges, reports.
fn grade(args: &FlyArgs) -> Result<ExitCode> {
    let typed = args.plugin.as_ref().context("no plugin is named")?;
    let plugin = Plugin::find(typed)?;
    let project = CourseProject::find(&args.project)?;
    let (delays, imu) = (delays(args)?, args.imu);
    let variants = variants(args, &project)?;
    let subject = subject(args, &plugin, &project, &variants)?;
    // In the order of `Subject::flights`.
    let seeds = |variant| subject.seeds().map(move |seed| (variant, seed));
    let flights: Vec<(Variant, u64)> = variants
        .iter()
        .flat_map(|&variant| seeds(variant))
        .enumerate()
        .filter(|(index, _)| args.shard.is_none_or(|shard| shard.holds(*index)))
        .map(|(_, flight)| flight)
        .collect();
    let answer_within = Duration::try_from_secs_f64(args.answer_within)
        .with_context(|| format!("--answer-within {}: that is no time", args.answer_within))?;
    let stop: &AtomicBool = &*stop_flag(false)?;
    // What a plugin of the same user could read, forge or look up: keys, our memory (proc(5)).
    let keys = vizflyt_trust::KeysFolder::open(args.result.keys.as_deref())?;
    nix::sys::prctl::set_dumpable(false).context("this process cannot be kept to itself")?;
    let mut hide = vec![keys.file("")];
    hide.extend(args.first_seed.file.clone());
    // It may lie in the plugin's own folder, and holds the logs of flights that are over.
    hide.extend(args.report.clone());
    hide.extend(args.hide.clone());
    let limits = PluginLimits { hide, graded: true, ..PluginLimits::default() };
    let command = plugin.command(&limits)?;
    let flown_with = FlownWith::new(&subject, args.answer_within, args.log.name());
    let report = Report::open(args, flown_with, &flights)?;
    let fly = |&(variant, seed): &(Variant, u64)| -> Result<Option<FlightDone>> {
        if let Some(done) = report.as_ref().and_then(|report| report.kept(variant, seed)) {
            return Ok(Some(done));
        }
        let named = || format!("seed {seed}, {variant}");
        let course =
            CourseInstance::make(&project, args.level, variant, seed).with_context(named)?;
        let limits = PluginLimits { map: course.map.clone(), ..limits.clone() };
        let (course, command, limits) = (&course, &command[..], &limits);
        let reached = Cell::new(None);
        let attempt = || -> Result<Option<FlightDone>> {
            let images = report.as_ref().and_then(|report| Some((report, args.log.images()?)));
            let file = images.map(|(report, _)| report.folder.nameless()).transpose()?;
            let log = file.as_ref().zip(images).map(|(file, (_, images))| TrialLog {
                file,
                images,
                depth: args.log_depth,
                plugin: typed,
            });
            let reached = &reached;
            let trial = Trial {
                course,
                seed,
                command,
                limits,
                answer_within,
                delays,
                imu,
                stop,
                log,
                reached,
            };
            let Some(flown) = trial.fly()? else { return Ok(None) };
            let run = run_of(course, &delays, seed, variant, &flown);
            let mut done = FlightDone { virtual_s: flown.virtual_s, ..FlightDone::of(run) };
            if let Some(report) = &report {
                report.write(course, &flown, file.as_ref(), &mut done)?;
            }
            Ok(Some(done))
        };
        again_if_lost(attempt, stop, &named()).with_context(named)
    };
    let jobs =
        args.jobs.unwrap_or_else(|| available_parallelism().unwrap_or(NonZero::<usize>::MIN));
    let mut progress = Progress::new(flights.len());
    // Which comes after which is nobody's business.
    let (mut order, lots): (Vec<usize>, _) = ((0..flights.len()).collect(), RandomState::new());
    order.sort_by_key(|index| lots.hash_one(index));
    let fly = |&index: &usize| fly(&flights[index]);
    let done = pool::run(&order, jobs, stop, fly, |done| progress.flown(&done.run, done.virtual_s));
    progress.end();
    let resumed = match &report {
        Some(_) => "; --resume keeps the flights that are finished",
        None => "",
    };
    let done = done.with_context(|| format!("nothing is graded{resumed}"))?;
    let Some(done) = done else {
        print_error(format_args!("ended on request; nothing is graded{resumed}"));
        return Ok(ExitCode::FAILURE);
    };
    let mut done: Vec<(usize, FlightDone)> = order.into_iter().zip(done).collect();
    done.sort_by_key(|(index, _)| *index);
    let mut runs = Vec::with_capacity(flights.len());
    let (mut cards, mut files) = (HashMap::new(), Vec::new());
    for (_, FlightDone { run, card, files: own, .. }) in done {
        cards.insert((run.variant.clone(), run.seed), card);
        files.extend(own);
        runs.push(run);
    }
    let mut grade = Grade::new(subject, args.shard, runs);
    // No plugin runs any more.
    let key = keys::signing_key(args.result.keys.as_deref())?;
    let unsealed = Confinement::prepare(&limits, &command).unsealed();
    if let Some(why) = &unsealed {
        print_error(format_args!(
            "this grade is NOT signed: a plugin here could have reached what it must not ({why})"
        ));
    }
    let key = Some(&key).filter(|_| unsealed.is_none());
    if let Some(report) = &report {
        let card = |run: &Run| cards.remove(&(run.variant.clone(), run.seed)).unwrap_or_default();
        let cards: Vec<String> = grade.runs.iter().map(card).collect();
        report::write(&report.folder, &mut grade, key, &cards, files)?;
    } else if let Some(key) = key {
        grade.sign(key)?;
    }
    if let Some(path) = &args.junit {
        junit::write(path, &grade)?;
    }
    hand_over(&grade, &args.result)?;
    if let (Some(folder), false) = (&args.report, args.result.json) {
        print_line(format!("report      {}", folder.join(folder::PAGE).display()));
    }
    let is_enough = args.least.is_none_or(|least| grade.summary.score.value >= least);
    Ok(if is_enough { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// A flight is flown so often at most, where it fails for another reason than the plugin's.
const ATTEMPTS: u32 = 3;
/// So long after the first failure; longer after the second.
const PAUSE: Duration = Duration::from_secs(2);

/// Tries a flight again that failed for another reason than the plugin's: no memory, a process that somebody else
/// killed. That is no grade; so it must not become one.
fn again_if_lost<T>(
    attempt: impl Fn() -> Result<Option<T>>,
    stop: &AtomicBool,
    named: &str,
) -> Result<Option<T>> {
    for tried in 1..ATTEMPTS {
        let error: Error = match attempt() {
            Ok(done) => return Ok(done),
            Err(error) if error.is::<AnotherWay>() => return Err(error),
            Err(error) => error,
        };
        print_error(format_args!("{named}: {error:#}; flown again ({tried} of {})", ATTEMPTS - 1));
        let until = Instant::now() + PAUSE * tried;
        while Instant::now() < until && !stop.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(50));
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
    }
    attempt().with_context(|| format!("not flown to its end in {ATTEMPTS} attempts"))
}

/// A flight that was flown and judged.
#[derive(Clone)]
struct FlightDone {
    run: Run,
    /// Its card, as HTML; empty without a report.
    card: String,
    /// What lies of it in the report.
    files: Vec<SignedFile>,
    /// Flown now: 0 if it is kept of an interrupted grade. [s]
    virtual_s: f64,
}

impl FlightDone {
    fn of(mut run: Run) -> Self {
        // As it will be signed, and so as it is written.
        run.round();
        Self { run, card: String::new(), files: Vec::new(), virtual_s: 0.0 }
    }
}

/// The report while flights are flown.
struct Report {
    folder: ReportFolder,
    flown_with: FlownWith,
    key: SealingKey,
    /// Flights of the grade that was interrupted.
    kept: HashMap<(String, u64), FlightDone>,
}

impl Report {
    /// Opens the report's folder, if there is to be one.
    fn open(
        args: &FlyArgs,
        flown_with: FlownWith,
        flights: &[(Variant, u64)],
    ) -> Result<Option<Self>> {
        let Some(root) = &args.report else { return Ok(None) };
        check_outputs(Some(root), &args.result, args.junit.as_deref())?;
        let folder =
            if args.resume { ReportFolder::resume(root)? } else { ReportFolder::begin(root)? };
        // The grading key itself stays where it is until the last plugin has ended.
        let key = SealingKey::of(&keys::signing_key(args.result.keys.as_deref())?);
        let mut report = Self { folder, flown_with, key, kept: HashMap::new() };
        let mut there = BTreeSet::new();
        for (variant, seed) in flights.iter().filter(|_| args.resume) {
            let path = format!("{FLIGHTS}/{variant}-{seed}.json");
            let text = match std::fs::read_to_string(report.folder.at(&path)) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                text => text.with_context(|| format!("cannot read {path}"))?,
            };
            let done = report.read(&path, &text, *variant, *seed);
            let done = done
                .with_context(|| format!("{} cannot be kept", report.folder.at(&path).display()))?;
            there.extend(done.files.iter().map(|file| file.path.clone()));
            report.kept.insert((variant.to_string(), *seed), done);
        }
        let other: Vec<String> =
            report.folder.records()?.into_iter().filter(|path| !there.contains(path)).collect();
        ensure!(
            other.is_empty(),
            "{} holds flights that are not asked for ({}): give the same seeds, variants and part, or another folder",
            root.display(),
            folder::list(&other)
        );
        report.folder.keep_only(&there)?;
        if !report.kept.is_empty() {
            print_error(format_args!(
                "{} of {} flights are finished already and are kept",
                report.kept.len(),
                flights.len()
            ));
        }
        Ok(Some(report))
    }

    fn read(&self, path: &str, text: &str, variant: Variant, seed: u64) -> Result<FlightDone> {
        let record = FlightRecord::parse(text, &self.key, &self.flown_with)?;
        let (run, card, mut files) = (record.run, record.card, record.files);
        if (&*run.variant, run.seed) != (&*variant.to_string(), seed) {
            bail!("it is the record of seed {}, {}", run.seed, run.variant);
        }
        self.folder.check(&files)?;
        files.push(SignedFile::of(path, text.as_bytes()));
        Ok(FlightDone { card, files, ..FlightDone::of(run) })
    }

    /// Returns a flight of the grade that was interrupted.
    fn kept(&self, variant: Variant, seed: u64) -> Option<FlightDone> {
        self.kept.get(&(variant.to_string(), seed)).cloned()
    }

    /// Writes what a flight leaves: images, log, and its record when they are on the medium.
    fn write(
        &self,
        course: &CourseInstance,
        flown: &TrialResult,
        log: Option<&std::fs::File>,
        done: &mut FlightDone,
    ) -> Result<()> {
        let (folder, run) = (&self.folder, &done.run);
        let CourseInstance { arena, field, .. } = course;
        let has_log = log.is_some();
        let (card, mut files) = report::card::write(folder, arena, field, run, flown, has_log)?;
        if let Some(log) = log {
            files.push(folder.write_file(&report::card::log_path(run), log)?);
        }
        let files = folder::sorted(files);
        let with = self.flown_with.clone();
        let record = FlightRecord::new(with, run.clone(), card.clone(), files.clone());
        let path = format!("{FLIGHTS}/{}.json", report::card::name(run));
        let record = folder.write(&path, record.to_text(&self.key)?.as_bytes())?;
        (done.card, done.files) = (card, files);
        done.files.push(record);
        Ok(())
    }
}

/// Checks that what else is written does not lie in the report's folder, where all is signed.
fn check_outputs(report: Option<&Path>, result: &ResultArgs, junit: Option<&Path>) -> Result<()> {
    let Some(root) = report else { return Ok(()) };
    let made = std::fs::create_dir_all(root).and_then(|()| root.canonicalize());
    let root = made.with_context(|| format!("cannot make {}", root.display()))?;
    let outputs = [("--output", result.output.as_deref(), folder::GRADE)];
    for (option, path, own) in outputs.into_iter().chain([("--junit", junit, folder::JUNIT)]) {
        let Some(path) = path else { continue };
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new(".")).canonicalize();
        let Ok(parent) = parent else { continue };
        let is_own = parent == root && path.file_name() == Some(own.as_ref());
        ensure!(
            is_own || !parent.starts_with(&root),
            "{option} {}: all that lies in a report is signed, and it holds {own} already; give another folder",
            path.display()
        );
    }
    Ok(())
}

fn delays(args: &FlyArgs) -> Result<Delays> {
    let within = |value: f64, low: f64, high: f64| value >= low && value <= high;
    let FlyArgs { image_rate, image_delay, answer_delay, .. } = *args;
    ensure!(within(image_rate, 1.0, 200.0), "--image-rate {image_rate}: give 1 to 200 Hz");
    ensure!(within(image_delay, 0.0, 200.0), "--image-delay {image_delay}: give 0 to 200 ms");
    ensure!(within(answer_delay, 0.0, 1000.0), "--answer-delay {answer_delay}: give 0 to 1000 ms");
    ensure!((1..=MAX_SEEDS).contains(&args.seeds), "--seeds {}: give 1 to {MAX_SEEDS}", args.seeds);
    Ok(Delays {
        image_period_ns: (1e9 / image_rate) as i64,
        image_ns: (image_delay * 1e6) as i64,
        answer_ns: (answer_delay * 1e6) as i64,
    })
}

/// Returns the variants that are flown, those that are drawn among them.
fn variants(args: &FlyArgs, project: &CourseProject) -> Result<Vec<Variant>> {
    let mut variants: Vec<Variant> = Vec::new();
    for choice in &args.variants {
        let chosen: Vec<Variant> = match *choice {
            VariantChoice::Named(variant) => vec![variant],
            VariantChoice::Random(count) => {
                let draw =
                    |number| Variant::drawn(args.first_seed.value, number, project.environments());
                (1..=count).map(draw).collect()
            }
        };
        for variant in chosen {
            let is_new = variants.iter().all(|other| other.to_string() != variant.to_string());
            ensure!(is_new, "--variants: {variant} is there twice");
            variants.push(variant);
        }
    }
    Ok(variants)
}

fn subject(
    args: &FlyArgs,
    plugin: &Plugin,
    project: &CourseProject,
    variants: &[Variant],
) -> Result<Subject> {
    let drawn = variants.iter().filter(|variant| variant.is_drawn());
    let tenth = |ms: f64| (ms * 10.0).round() / 10.0;
    let outputs = [&args.report, &args.junit, &args.result.output];
    let outputs: Vec<&Path> = outputs.into_iter().flatten().map(PathBuf::as_path).collect();
    Ok(Subject {
        plugin: plugin.name().to_string_lossy().into_owned(),
        plugin_sha256: keys::plugin_sha256(&plugin.watched(), &outputs)?,
        project: graded_name(project),
        level: args.level.to_string(),
        variants: variants.iter().map(Variant::to_string).collect(),
        environments: drawn.map(|drawn| (drawn.to_string(), drawn.environment())).collect(),
        first_seed: args.first_seed.value,
        seeds: args.seeds,
        delays: DelaysMs {
            image_period: tenth(1e3 / args.image_rate),
            image: tenth(args.image_delay),
            answer: tenth(args.answer_delay),
        },
        imu: (args.imu != ImuModel::default()).then(|| args.imu.to_string()),
        program: env!("CARGO_PKG_VERSION").to_owned(),
        program_sha256: keys::program_sha256()?,
        renderer: CpuRenderer::new(&Splats::default()).name().into_owned(),
    })
}

fn run_of(
    course: &CourseInstance,
    delays: &Delays,
    seed: u64,
    variant: Variant,
    flown: &TrialResult,
) -> Run {
    let verdict = &flown.verdict;
    Run {
        seed,
        variant: variant.to_string(),
        outcome: verdict.outcome,
        reason: verdict.reason.clone(),
        cause: probable_cause(&course.arena, &course.field, &flown.record(delays)),
        stages_passed: verdict.stages_passed,
        stages: verdict.stages.clone(),
        seconds: verdict.seconds,
        penalty_s: verdict.penalty_s,
        score: verdict.score,
        min_clearance_m: verdict.min_clearance_m,
        max_speed_mps: verdict.max_speed_mps,
        path_m: verdict.path_m,
        images: flown.images,
        odometry: odometry_score(&flown.truth, &flown.odometry),
        scene_sha256: course.scene_sha256.clone(),
        rules_sha256: course.rules_sha256.clone(),
        hash: hex(&flown.hash),
    }
}

/// Prints a grade, and writes it where it was asked for.
fn hand_over(grade: &Grade, args: &ResultArgs) -> Result<()> {
    if let Some(path) = &args.output {
        write(path, &grade.to_text()?)?;
    }
    if args.json {
        print_line(grade.to_text()?.trim_end());
        return Ok(());
    }
    let summary = &grade.summary;
    print_line(format!(
        "score       {:.1} (95 %: {:.1} to {:.1})",
        summary.score.value, summary.score.low, summary.score.high
    ));
    print_line(format!(
        "finished    {} of {} (95 %: {:.0} to {:.0} %)",
        summary.finished,
        summary.runs,
        summary.finish_share.low * 100.0,
        summary.finish_share.high * 100.0
    ));
    for VariantSummary { variant, summary } in &grade.by_variant {
        print_line(format!(
            "  {variant:<12}{:.1} (95 %: {:.1} to {:.1}), finished {} of {}",
            summary.score.value,
            summary.score.low,
            summary.score.high,
            summary.finished,
            summary.runs
        ));
    }
    if let Some(mean_s) = summary.mean_finish_s {
        print_line(format!("time        {mean_s:.1} s to the finish, on average"));
    }
    if let Some(clearance_m) = summary.min_clearance_m {
        print_line(format!("clearance   {clearance_m:.2} m at least"));
    }
    print_line(format!("hash        {}", grade.hash));
    Ok(())
}

fn write(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
