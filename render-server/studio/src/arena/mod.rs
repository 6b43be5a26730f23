//! `vizflyt arena`: creates arenas for captured scenes, edits their courses, and checks them before a flight.

mod edit;
pub(crate) mod file;
mod new;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use vizflyt_arena::check::{Checked, check};
use vizflyt_arena::config::line_of;
use vizflyt_process::print_fmt;
use vizflyt_scenes::Variant;
use vizflyt_scenes::projects::{self, CourseProject, Level};
use vizflyt_server::poses::settings;
use vizflyt_server::render::sensors::SensorSet;
use vizflyt_server::scene::{self, BareArgs};

/// Make and check arenas for captured scenes, and edit their courses
#[derive(Args, Debug)]
pub struct ArenaArgs {
    #[command(subcommand)]
    command: ArenaCommand,
}

#[derive(Subcommand, Debug)]
enum ArenaCommand {
    Check(CheckArgs),
    New(new::NewArgs),
    Edit(edit::EditArgs),
}

/// Check that a course can be flown
///
/// Checks placement of the scene, free space at the start, size of the gates, a path through all
/// gates, and that moving objects do not block it permanently.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt arena check my-room/arena.toml        errors with the line of the file; status 0 if it can be flown
  vizflyt arena check --project p5 --seeds 20   the course's project, on seeds 0 to 19")]
struct CheckArgs {
    /// arena.toml or its folder
    #[arg(required_unless_present = "project", conflicts_with = "project")]
    arena: Option<PathBuf>,
    #[arg(long, value_name = "NAME", help = format!(
        "Project: {}; or FILE.toml", projects::NAMES.join(", ")
    ))]
    project: Option<String>,
    /// Check only this seed of the project
    #[arg(long, requires = "project", conflicts_with = "seeds")]
    seed: Option<u64>,
    /// Number of seeds of the project, from 0
    #[arg(long, value_name = "N", default_value_t = 10)]
    seeds: u64,
}

/// Runs `vizflyt arena`.
pub fn run(args: &ArenaArgs) -> Result<ExitCode> {
    match &args.command {
        ArenaCommand::Check(args) => check_all(args),
        ArenaCommand::New(args) => new::run(args).map(|()| ExitCode::SUCCESS),
        ArenaCommand::Edit(args) => edit::run(args).map(|()| ExitCode::SUCCESS),
    }
}

fn check_all(args: &CheckArgs) -> Result<ExitCode> {
    let good = match (&args.project, &args.arena) {
        (Some(project), _) => {
            let project = CourseProject::find(project)?;
            for level in Level::ALL {
                let arena = project.generate(0, level, Variant::default()).arena;
                SensorSet::new(&arena.sensors).with_context(|| format!("level {level}"))?;
            }
            let seeds = args.seed.map_or(0..args.seeds, |seed| seed..seed + 1);
            if seeds.is_empty() {
                bail!("--seeds 0 checks nothing; give at least 1");
            }
            let bad = seeds.filter(|&seed| !check_seed(&project, seed)).count();
            bad == 0
        }
        (None, Some(arena)) => check_file(arena)?,
        (None, None) => bail!("give an arena.toml, or --project"),
    };
    Ok(if good { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn check_seed(project: &CourseProject, seed: u64) -> bool {
    // Levels only differ in sensors, variants only in light and weather: neither changes the free space.
    let generated = project.generate(seed, Level::default(), Variant::default());
    let still = Arc::new(scene::bake(&generated.splats, &generated.arena, None));
    let obstacles = scene::obstacles(&generated.arena, &generated.objects, still, seed);
    let checked = check(&generated.arena, &obstacles);
    print_summary(
        &format!("{} seed {seed}", project.name()),
        generated.arena.stages.len(),
        &checked,
    );
    for finding in &checked.findings {
        print_fmt!("  {finding}");
    }
    checked.findings.is_empty()
}

fn check_file(path: &Path) -> Result<bool> {
    let file = if path.is_dir() { path.join("arena.toml") } else { path.to_owned() };
    let is_toml = file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml"));
    if !is_toml {
        bail!("{} is not an arena.toml: a bare scene has no course to check", file.display());
    }
    let text = std::fs::read_to_string(&file)
        .with_context(|| format!("cannot read {}", file.display()))?;
    settings::of_arena(&file)?;
    let scene = scene::load_to_fly(&file, &BareArgs::default())?;
    SensorSet::new(&scene.arena.sensors).with_context(|| file.display().to_string())?;
    let still = Arc::new(scene::bake(&scene.splats, &scene.arena, scene.seen.as_ref()));
    let mut findings = scene::check_fit(&scene.splats, &scene.arena, &still);
    let obstacles = scene::obstacles(&scene.arena, &scene.objects, still, 0);
    let mut checked = check(&scene.arena, &obstacles);
    findings.append(&mut checked.findings);
    checked.findings = findings;
    for finding in &checked.findings {
        let line = line_of(&text, &finding.key).map_or_else(String::new, |line| format!(":{line}"));
        print_fmt!("{}{line}: {finding}", file.display());
    }
    print_summary(&file.display().to_string(), scene.arena.stages.len(), &checked);
    Ok(checked.findings.is_empty())
}

fn print_summary(what: &str, stages: usize, checked: &Checked) {
    if !checked.findings.is_empty() {
        print_fmt!("{what}: cannot be flown, problems: {}", checked.findings.len());
        return;
    }
    let room = if checked.least_room_m.is_finite() {
        format!(", {:.2} m of room in the narrowest", checked.least_room_m)
    } else {
        String::new()
    };
    print_fmt!("{what}: can be flown; {stages} stages{room}; a path of {:.1} m", checked.way_m);
}
