//! Flies a plugin through a project's course once per seed and variant, and makes the grade.

use std::cell::Cell;
use std::collections::HashMap;
use std::hash::{BuildHasher, RandomState};
use std::num::NonZero;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use anyhow::{Context, Error, Result, ensure};
use vizflyt_arena::crash::probable_cause;
use vizflyt_process::{print_error, print_line, stop_flag};
use vizflyt_runtime::supervisor::{Confinement, PluginLimits};
use vizflyt_scenes::projects::CourseProject;
use vizflyt_scenes::{Variant, VariantChoice};
use vizflyt_simulator::imu::ImuModel;
use vizflyt_splat::{CpuRenderer, Rasterizer, Splats};
use vizflyt_studio::course::{CourseInstance, graded_name};
use vizflyt_trust::{CourseSecret, Purpose, hex};

use super::args::FlyArgs;
use super::document::{DelaysMs, Grade, MAX_SEEDS, Run, Subject};
use super::finished::{FlightDone, LiveReport};
use super::odometry::odometry_score;
use super::progress::Progress;
use super::record::FlownWith;
use super::trial::{AnotherWay, Delays, Trial, TrialLog, TrialResult};
use super::{changes, figures, folder, junit, keys, pool, report};
use crate::plugin::Plugin;
use crate::plugin::submission::Submission;

/// Runs `vizflyt grade`: flies, judges, reports.
pub(super) fn grade(args: &FlyArgs) -> Result<ExitCode> {
    let typed = args.plugin.as_ref().context("no plugin given")?;
    let plugin = Plugin::find(typed)?;
    let project = CourseProject::find(&args.project)?;
    let (delays, imu) = (delays(args)?, args.imu);
    let secret = args.course_secret().context("--secret")?;
    let variants = variants(args, &secret, &project)?;
    // Paths and memory that a plugin of the same user could read or forge: keys, and this process
    // (proc(5)).
    let keys = vizflyt_trust::KeysFolder::open(args.result.keys.as_deref())?;
    nix::sys::prctl::set_dumpable(false).context("cannot protect the memory of this process")?;
    let mut hide = vec![keys.file("")];
    hide.extend(args.first_seed.file.clone());
    hide.extend(args.secret.clone());
    // The report may be in the plugin's own folder, and contains logs of finished flights.
    hide.extend(args.report.clone());
    hide.extend(args.hide.clone());
    let outputs = [&args.junit, &args.result.output].into_iter().flatten().cloned();
    let except: Vec<PathBuf> = hide.iter().cloned().chain(outputs).collect();
    let submission = Submission::read(&plugin, &except)?;
    let mut subject = subject(args, &submission, &plugin, &project, &variants)?;
    subject.courses = secret.name();
    let earlier = changes::earlier(args)?;
    if let Some(earlier) = earlier.as_ref().filter(|_| args.since.is_some()) {
        changes::check(&earlier.subject, &subject)?;
    }
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
        .with_context(|| format!("--answer-within {}: not a valid duration", args.answer_within))?;
    let stop: &AtomicBool = &*stop_flag(false)?;
    let limits = PluginLimits { hide, graded: true, ..PluginLimits::default() };
    let plugin = submission.check(&limits, args.build_in.as_deref())?;
    let flown_with = FlownWith::new(&subject, args.answer_within, args.log.name());
    let report = LiveReport::open(args, flown_with, &flights)?;
    let fly = |&(variant, seed): &(Variant, u64)| -> Result<Option<FlightDone>> {
        if let Some(done) = report.as_ref().and_then(|report| report.kept(variant, seed)) {
            return Ok(Some(done));
        }
        let named = || format!("seed {seed}, {variant}");
        let course =
            CourseInstance::make(&project, args.level, variant, secret.seed(Purpose::Course, seed))
                .with_context(named)?;
        let (course, secret) = (&course, &secret);
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
            let copy = plugin.copy()?;
            let limits = PluginLimits { map: course.map.clone(), ..copy.limits.clone() };
            let (command, limits, reached) = (&copy.command[..], &limits, &reached);
            let trial = Trial {
                course,
                secret,
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
    // Random order, so that a plugin cannot predict the next flight.
    let (mut order, lots): (Vec<usize>, _) = ((0..flights.len()).collect(), RandomState::new());
    order.sort_by_key(|index| lots.hash_one(index));
    let fly = |&index: &usize| fly(&flights[index]);
    let done = pool::run(&order, jobs, stop, fly, |done| progress.flown(&done.run, done.virtual_s));
    progress.end();
    let resumed = match &report {
        Some(_) => "; --resume keeps the finished flights",
        None => "",
    };
    let done = done.with_context(|| format!("nothing is graded{resumed}"))?;
    let Some(done) = done else {
        print_error(format_args!("interrupted; nothing is graded{resumed}"));
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
    // All plugins have ended.
    let key = keys::signing_key(args.result.keys.as_deref())?;
    let copy = plugin.copy()?;
    let unsealed = Confinement::prepare(&copy.limits, &copy.command).unsealed();
    if let Some(why) = &unsealed {
        print_error(format_args!(
            "this grade is NOT signed: a plugin here could have accessed protected data ({why})"
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
    figures::hand_over(&grade, &args.result)?;
    let earlier = earlier.filter(|earlier| {
        !args.result.json && changes::check(&earlier.subject, &grade.subject).is_ok()
    });
    if let Some(lines) = earlier.map(|earlier| changes::lines(&earlier, &grade)) {
        if !lines.is_empty() {
            print_line("since the last attempt");
        }
        for line in lines {
            print_line(format!("  {line}"));
        }
    }
    if let (Some(folder), false) = (&args.report, args.result.json) {
        print_line(format!("report      {}", folder.join(folder::PAGE).display()));
    }
    let is_enough = args.least.is_none_or(|least| grade.summary.score.value >= least);
    Ok(if is_enough { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Maximum number of attempts, if a flight fails for reasons outside the plugin.
const ATTEMPTS: u32 = 3;
/// Pause after the first failure; longer after the second.
const PAUSE: Duration = Duration::from_secs(2);

/// Repeats a flight that failed for a reason outside the plugin: no memory, a process killed by
/// another one. Such a failure must not become a grade.
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

/// Returns the variants to fly, including random ones.
fn variants(
    args: &FlyArgs,
    secret: &CourseSecret,
    project: &CourseProject,
) -> Result<Vec<Variant>> {
    let seed = secret.seed(Purpose::Environments, args.first_seed.value);
    let mut variants: Vec<Variant> = Vec::new();
    for choice in &args.variants {
        let chosen: Vec<Variant> = match *choice {
            VariantChoice::Named(variant) => vec![variant],
            VariantChoice::Random(count) => {
                let draw = |number| Variant::drawn(seed, number, project.environments());
                (1..=count).map(draw).collect()
            }
        };
        for variant in chosen {
            let is_new = variants.iter().all(|other| other.to_string() != variant.to_string());
            ensure!(is_new, "--variants: {variant} occurs twice");
            variants.push(variant);
        }
    }
    Ok(variants)
}

fn subject(
    args: &FlyArgs,
    submission: &Submission<'_>,
    plugin: &Plugin,
    project: &CourseProject,
    variants: &[Variant],
) -> Result<Subject> {
    let drawn = variants.iter().filter(|variant| variant.is_drawn());
    let tenth = |ms: f64| (ms * 10.0).round() / 10.0;
    Ok(Subject {
        plugin: plugin.name().to_string_lossy().into_owned(),
        plugin_sha256: submission.sha256()?,
        team: args.team.clone(),
        project: graded_name(project),
        level: args.level.to_string(),
        variants: variants.iter().map(Variant::to_string).collect(),
        environments: drawn.map(|drawn| (drawn.to_string(), drawn.environment())).collect(),
        first_seed: args.first_seed.value,
        seeds: args.seeds,
        courses: None,
        points: project.points(args.level).copied(),
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
