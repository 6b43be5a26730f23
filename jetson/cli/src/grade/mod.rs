//! `vizflyt grade`: flies a plugin through a project's course, once for each seed, and scores
//! it.
//!
//! ```text
//! project, level, variant, seed -> course  in memory: splats, arena, distance field
//!                               -> trial   one flight in lock-step, a plugin process of its own
//!                               -> vizflyt_arena::crash  what a failure probably was
//! flights                       -> document  figures, hash, signature -> report/, junit, JSON
//! parts of a grade              -> merge     the whole
//! ```
//! The guides are `docs/guides/grading.md` and `grading-at-scale.md`.

mod course;
mod document;
mod junit;
mod keys;
mod merge;
mod pool;
mod progress;
mod report;
mod statistics;
mod trial;

use std::ffi::OsString;
use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;
use std::thread::available_parallelism;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use clap::{Args, Subcommand};
use ed25519_dalek::SigningKey;
use vizflyt_arena::crash::probable_cause;
use vizflyt_runtime::supervisor::PluginLimits;
use vizflyt_scenes::Variant;
use vizflyt_scenes::projects::{self, CourseProject, Level};
use vizflyt_splat::{CpuRenderer, Rasterizer, Splats};

use self::course::CourseInstance;
pub(crate) use self::document::Grade;
use self::document::{DelaysMs, MAX_SEEDS, Run, Shard, Subject, hex};
use self::progress::Progress;
use self::trial::{Delays, Trial, TrialResult};
use crate::fly::plugin::Plugin;
use crate::terminal::{print_error, print_line, stop_flag};

/// Flies a project's course in lock-step, once for each seed, and scores the plugin.
#[derive(Args, Clone, Debug)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[command(after_help = "Examples:
  vizflyt grade ./first --project p4 --seeds 20 --report out      flies 20 courses; open out/index.html
  vizflyt grade avoid --project forest --variants day,night       in other light, too
  vizflyt grade ./first --project p5 --level g --json > me.json   the signed grade, for programs
  vizflyt grade ./first --project p5 --shard 1/8 -o 1.json        an eighth of the flights, on a cluster
  vizflyt grade merge *.json -o whole.json --report out           all eighths make the whole
  vizflyt grade verify whole.json                                 checks its signature

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
    #[arg(long, value_name = "NAME", default_value = "p4", help = format!(
        "The project whose course is flown: {}", projects::NAMES.join(", ")
    ))]
    project: String,
    /// Sensors: ug has depth, g has not
    #[arg(long, value_name = "ug|g", default_value_t)]
    level: Level,
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "day", help = format!(
        "Light and fog that each seed is flown in: {}", Variant::names()
    ))]
    variants: Vec<Variant>,
    /// Number of seeds: each is another course
    #[arg(long, value_name = "N", default_value_t = 10)]
    seeds: u64,
    /// The first seed; keep it secret, so that nobody prepares for the courses
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    first_seed: u64,
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
    /// Wall-clock limit of one answer: a plugin that takes longer has failed
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0)]
    answer_within: f64,
    /// Writes a report there: index.html, a crash card for each failure, grade.json
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Writes JUnit XML there
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Ends with status 1 if the mean score is less than this, 0 to 100
    #[arg(long, value_name = "SCORE")]
    least: Option<f64>,
    #[command(flatten)]
    result: ResultArgs,
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
    /// Verifies the signature of a grade; status 1 if it is not valid
    Verify {
        /// The grade
        file: PathBuf,
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
        Some(GradeCommand::Verify { file, key, keys }) => {
            let grade = verified(file, key.as_deref(), keys.as_deref())?;
            print_line(format!(
                "{}: as signed with {}; score {:.1}, {} of {} finished",
                file.display(),
                grade.signature.as_ref().map_or("", |signed| &signed.key),
                grade.summary.score.value,
                grade.summary.finished,
                grade.summary.runs
            ));
            Ok(ExitCode::SUCCESS)
        }
        Some(GradeCommand::Merge { files, key, report, result }) => {
            let read = |path: &PathBuf| Ok((path.display().to_string(), Grade::read(path)?));
            let parts = files.iter().map(read).collect::<Result<Vec<_>>>()?;
            let key = keys::verifying_key(key.as_deref(), result.keys.as_deref())?;
            let grade = signed(merge::merge(&parts, &key)?, result)?;
            if let Some(folder) = report {
                let failed = grade.runs.iter().filter(|run| run.cause.is_some());
                let cards: Vec<String> = failed.map(report::card::without_images).collect();
                report::write(folder, &grade, &cards)?;
            }
            hand_over(&grade, result)?;
            if let (Some(folder), false) = (report, result.json) {
                print_line(format!("report      {}", folder.join("index.html").display()));
            }
            Ok(ExitCode::SUCCESS)
        }
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
    let plugin = Plugin::find(args.plugin.as_deref().context("no plugin is named")?)?;
    let project = CourseProject::named(&args.project)?;
    let delays = delays(args)?;
    let subject = subject(args, &plugin, &project)?;
    let flights: Vec<(Variant, u64)> = subject
        .flights()
        .enumerate()
        .filter(|(index, _)| args.shard.is_none_or(|shard| shard.holds(*index)))
        .map(|(_, (variant, seed))| Ok((variant.parse()?, seed)))
        .collect::<Result<_>>()?;
    let stop: &AtomicBool = &*stop_flag(false)?;
    // What a plugin of the same user could read, forge or look up: keys, our memory (proc(5)).
    let keys = vizflyt_trust::KeysFolder::open(args.result.keys.as_deref())?;
    nix::sys::prctl::set_dumpable(false).context("this process cannot be kept to itself")?;
    let hide = vec![keys.file("")];
    let limits = PluginLimits { hide, graded: true, ..PluginLimits::default() };
    let command = plugin.command(&limits)?;
    let answer_within = Duration::try_from_secs_f64(args.answer_within)
        .with_context(|| format!("--answer-within {}: that is no time", args.answer_within))?;
    let fly = |&(variant, seed): &(Variant, u64)| -> Result<Option<Done>> {
        let named = || format!("seed {seed}, {variant}");
        let course =
            CourseInstance::make(&project, args.level, variant, seed).with_context(named)?;
        let limits = PluginLimits { map: course.map.clone(), ..limits.clone() };
        let (course, command, limits) = (&course, &command[..], &limits);
        let trial = Trial { course, seed, command, limits, answer_within, delays, stop };
        let Some(flown) = trial.fly().with_context(named)? else { return Ok(None) };
        let run = run_of(course, &delays, seed, variant, &flown);
        let card = match (&args.report, &run.cause) {
            (Some(folder), Some(_)) => {
                Some(report::card::write(folder, &course.arena, &course.field, &run, &flown)?)
            }
            _ => None,
        };
        Ok(Some(Done { run, card, virtual_s: flown.virtual_s }))
    };
    let jobs =
        args.jobs.unwrap_or_else(|| available_parallelism().unwrap_or(NonZero::<usize>::MIN));
    let mut progress = Progress::new(flights.len());
    let done =
        pool::run(&flights, jobs, stop, fly, |done| progress.flown(&done.run, done.virtual_s));
    progress.end();
    let Some(done) = done? else {
        print_error("ended on request; nothing is graded");
        return Ok(ExitCode::FAILURE);
    };
    let (runs, cards): (Vec<Run>, Vec<Option<String>>) =
        done.into_iter().map(|done| (done.run, done.card)).unzip();
    let grade = signed(Grade::new(subject, args.shard, runs), &args.result)?;
    if let Some(folder) = &args.report {
        let cards: Vec<String> = cards.into_iter().flatten().collect();
        report::write(folder, &grade, &cards)?;
    }
    if let Some(path) = &args.junit {
        junit::write(path, &grade)?;
    }
    hand_over(&grade, &args.result)?;
    if let (Some(folder), false) = (&args.report, args.result.json) {
        print_line(format!("report      {}", folder.join("index.html").display()));
    }
    let is_enough = args.least.is_none_or(|least| grade.summary.score.value >= least);
    Ok(if is_enough { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// A flight that was flown and judged.
struct Done {
    run: Run,
    card: Option<String>,
    virtual_s: f64,
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

fn subject(args: &FlyArgs, plugin: &Plugin, project: &CourseProject) -> Result<Subject> {
    let mut variants: Vec<String> = Vec::new();
    for variant in args.variants.iter().map(Variant::to_string) {
        ensure!(!variants.contains(&variant), "--variants: {variant} is there twice");
        variants.push(variant);
    }
    let tenth = |ms: f64| (ms * 10.0).round() / 10.0;
    Ok(Subject {
        plugin: plugin.name().to_string_lossy().into_owned(),
        plugin_sha256: keys::plugin_sha256(&plugin.watched())?,
        project: project.name().to_owned(),
        level: args.level.to_string(),
        variants,
        first_seed: args.first_seed,
        seeds: args.seeds,
        delays: DelaysMs {
            image_period: tenth(1e3 / args.image_rate),
            image: tenth(args.image_delay),
            answer: tenth(args.answer_delay),
        },
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
        scene_sha256: course.scene_sha256.clone(),
        rules_sha256: course.rules_sha256.clone(),
        hash: hex(&flown.hash),
    }
}

/// Signs a grade. The key is read only now that no plugin runs any more.
fn signed(mut grade: Grade, args: &ResultArgs) -> Result<Grade> {
    let key: SigningKey = keys::signing_key(args.keys.as_deref())?;
    grade.sign(&key)?;
    Ok(grade)
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
