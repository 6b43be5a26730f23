//! `vizflyt grade judge LOG`: judges the logged track of a flight in the lab by the rules of
//! grades.
//!
//! ```text
//! LOG: poses, events of the runtime --> referee, with the scene's obstacles --> verdict
//! ```
//! Decisions of the lab's referee in the log are ignored and made again. The runtime writes the
//! log: the result shows how a flight is judged, and proves nothing about who flew it.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use clap::Args;
use vizflyt_arena::pose::Measured;
use vizflyt_arena::verdict::{Sample, Verdict, judge};
use vizflyt_arena::{ArenaConfig, BakeSpec, Obstacles, Referee};
use vizflyt_process::print_line;
use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::messages::{Event, EventKind};
use vizflyt_runtime::log::read::{LogReader, RecordedTrack};
use vizflyt_scenes::Variant;
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_server::scene::{BareArgs, bake_with, load, obstacles};
use vizflyt_studio::stage::{Place, Stage};

#[derive(Args, Clone, Debug)]
pub(super) struct JudgeArgs {
    /// Log of the flight
    #[arg(value_name = "FILE.mcap")]
    log: PathBuf,
    /// Arena of the flight: scene folder, arena.toml, scene file or generated scene
    ///
    /// [default: forest]
    #[arg(long, help_heading = "Scene", value_name = "SCENE")]
    scene: Option<String>,
    /// Course project of the flight; replaces --scene
    #[arg(long, help_heading = "Scene", value_name = "NAME")]
    project: Option<String>,
    /// Level of the project
    #[arg(long, help_heading = "Scene", value_name = "ug|g", requires = "project")]
    level: Option<Level>,
    /// Light and weather of the project
    #[arg(long, help_heading = "Scene", value_name = "NAME", requires = "project")]
    variant: Option<Variant>,
    /// Seed of a generated scene or course
    #[arg(long, help_heading = "Scene")]
    seed: Option<u64>,
    #[command(flatten)]
    bare: BareArgs,
    /// Print the verdict as JSON
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Judges a logged flight, and prints the verdict.
///
/// # Errors
/// If the log contains no flight, or if the scene cannot be loaded or has moving objects.
pub(super) fn run(args: &JudgeArgs) -> Result<ExitCode> {
    let cannot = || format!("{} cannot be judged", args.log.display());
    let track = RecordedTrack::read(LogReader::open(&args.log).with_context(cannot)?)
        .with_context(cannot)?;
    ensure!(
        !track.poses.is_empty(),
        "{} does not contain a flight of this version, with poses and the plugin's course information",
        args.log.display()
    );
    let seed = args.seed.unwrap_or(Place::SEED);
    let stage = Stage::prepare(&Place {
        scene: args.project.as_deref().or(args.scene.as_deref()).unwrap_or("forest"),
        project: args.project.as_deref().map(CourseProject::find).transpose()?,
        level: args.level.unwrap_or_default(),
        variant: args.variant.unwrap_or_default(),
        environment: None,
        bare: args.bare,
        seed,
    })?;
    let scene = load(&stage.arena, &BareArgs::default())?;
    ensure!(
        scene.arena.objects.iter().all(|object| object.motion.is_none()),
        "{} has moving objects, whose positions are not in a log; only its server can judge such a flight",
        scene.arena.name
    );
    let baked =
        bake_with(&scene.splats, &BakeSpec::of(&scene.arena), scene.seen.as_ref(), None, &|_| ());
    let still = obstacles(&scene.arena, &scene.objects, Arc::new(baked.field), seed);
    let verdict = judge_track(&scene.arena, still, track);
    if args.json {
        print_line(serde_json::to_string_pretty(&verdict)?);
        return Ok(ExitCode::SUCCESS);
    }
    let Verdict { outcome, reason, score, seconds, penalty_s, .. } = &verdict;
    print_line(format!("outcome     {}: {reason}", outcome.name()));
    print_line(format!("score       {score:.1}"));
    print_line(format!("time        {seconds:.1} s, and {penalty_s:.0} s of penalties"));
    for stage in &verdict.stages {
        let passed = stage.passed_s.map_or("not passed".to_owned(), |at_s| format!("{at_s:.1} s"));
        print_line(format!("            {}: {passed}", stage.name));
    }
    if let Some(clearance_m) = verdict.min_clearance_m {
        print_line(format!("clearance   {clearance_m:.2} m minimum"));
    }
    Ok(ExitCode::SUCCESS)
}

fn judge_track(arena: &ArenaConfig, obstacles: Obstacles, track: RecordedTrack) -> Verdict {
    let mut referee = Referee::new(arena, obstacles);
    let (mut events, mut samples): (Vec<Event>, _) = (Vec::new(), Vec::new());
    let mut told = track.events.into_iter().filter(|event| !is_of_referee(&event.kind)).peekable();
    for (stamp, world_from_body) in track.poses {
        while let Some(event) = told.next_if(|event| event.stamp <= stamp) {
            referee.handle_event(&event);
            events.push(event);
        }
        referee.handle_timeout(stamp);
        if let Ok(sample) = referee.handle_measurement(&Measured::new(stamp, world_from_body)) {
            let p_world_m = sample.world_from_body.translation_m;
            samples.push(Sample {
                stamp: sample.stamp,
                p_world_m,
                v_world_mps: sample.twist.linear_mps,
                yaw_rad: yaw_of(sample.world_from_body.rotation),
                clearance_m: referee.clearance_m(p_world_m),
            });
        }
        events.extend(std::iter::from_fn(|| referee.poll_event()));
    }
    events.extend(told);
    // Merge the two ordered lists into one.
    events.sort_by_key(|event| event.stamp);
    judge(arena, &events, &samples)
}

/// Whether the referee reports this event.
fn is_of_referee(kind: &EventKind) -> bool {
    matches!(
        kind,
        EventKind::Collision(_)
            | EventKind::Geofence(_)
            | EventKind::Stage { .. }
            | EventKind::Finished { .. }
            | EventKind::TimeLimit { .. }
            | EventKind::PoseLost { .. }
            | EventKind::PoseRegained
    )
}
