//! `vizflyt scene generate`: generates a scene with known geometry, and a phone's video of a walk through it.

mod film;
mod sink;
mod truth;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use film::Shoot;
use sink::Target;
use vizflyt_process::print_fmt;
use vizflyt_scenes::walk::Walk;
use vizflyt_scenes::{FilmSet, Generated, SceneKind, film_set};

use super::camera::ImageSize;

/// Generate a scene with known geometry: scene.ply, arena.toml, truth.json
#[derive(Args, Debug)]
#[command(
    after_help = "A capture is a phone's video of a walk through the scene: lens, rolling shutter, automatic exposure, motion
blur, noise. Next to hall.mp4 it writes hall.truth.json (true camera poses), hall.camera.toml (lens) and,
with --tags, hall.tags.toml (layout of the tags); in a folder, the names lack 'hall.'.
Videos require the program ffmpeg; a folder of images does not.

Examples:
  vizflyt scene generate forest --seed 7 -o my-forest
  vizflyt demo --scene my-forest
  vizflyt scene generate room --seed 3 --tags --capture hall.mp4
  vizflyt scene generate room --seed 3 --tags --capture images/ --frames 80"
)]
pub(crate) struct GenerateArgs {
    #[arg(help = format!("What to generate: {}", SceneKind::names()))]
    kind: SceneKind,
    /// Seed of scene, walk and phone
    #[arg(long, help_heading = "Scene", default_value_t = 7)]
    seed: u64,
    /// Video (.mp4, .mkv, .mov) or folder of JPEG images of a walk through the scene
    #[arg(long, help_heading = "Capture", value_name = "FILE|DIR")]
    capture: Option<PathBuf>,
    /// Put boards with AprilTags along the walk, also into the scene of --output
    #[arg(long, help_heading = "Capture", requires = "capture")]
    tags: bool,
    /// Duration of the walk, which ends at its start
    #[arg(
        long,
        help_heading = "Capture",
        value_name = "S",
        requires = "capture",
        default_value_t = 50.0
    )]
    seconds: f64,
    /// Number of images
    ///
    /// Of a folder: evenly spaced over the walk, 80 by default. Of a video: the first ones.
    #[arg(long, help_heading = "Capture", value_name = "N", requires = "capture")]
    frames: Option<u32>,
    /// Image size
    #[arg(
        long,
        help_heading = "Capture",
        value_name = "WxH",
        requires = "capture",
        default_value = "640x480"
    )]
    size: ImageSize,
    /// Animate moving objects during the walk; without this option they stand still
    #[arg(long, help_heading = "Capture", requires = "capture")]
    moving: bool,
    /// Output folder of the scene; created if missing
    #[arg(
        short,
        long,
        help_heading = "Output",
        value_name = "DIR",
        required_unless_present = "capture"
    )]
    output: Option<PathBuf>,
    /// Replace existing files
    #[arg(long, help_heading = "Output")]
    force: bool,
}

/// Runs `vizflyt scene generate`.
pub(super) fn run(args: &GenerateArgs) -> Result<()> {
    if let Some(output) = &args.output
        && output.join("arena.toml").exists()
        && !args.force
    {
        bail!(
            "{} already holds an arena.toml; give another folder, or --force to replace it",
            output.display()
        );
    }
    let Some(capture) = &args.capture else {
        return write_scene(
            &vizflyt_scenes::generate(args.kind, args.seed),
            args.output.as_deref(),
        );
    };
    let target = Target::of(capture)?;
    refuse_existing(&target.truth_file(), args.force)?;
    if let Target::Video(file) = &target {
        refuse_existing(file, args.force)?;
    }
    if !Walk::SECONDS.contains(&args.seconds) {
        let (least, most) = (Walk::SECONDS.start(), Walk::SECONDS.end());
        bail!("--seconds {}: a walk takes {least} to {most} s", args.seconds);
    }
    let shoot = Shoot::of(args, target)?;
    let set = film_set(args.kind, args.seed, args.seconds, args.tags)?;
    write_scene(&set.scene, args.output.as_deref())?;
    let FilmSet { walk, prints, .. } = &set;
    print_fmt!(
        "walk        {:.0} m in {:.0} s, and back where it began",
        walk.length_m(),
        walk.seconds()
    );
    if args.tags {
        print_fmt!("tags        {} boards along it", prints.len());
    }
    shoot.run(&set)
}

fn refuse_existing(path: &Path, force: bool) -> Result<()> {
    if path.exists() && !force {
        bail!("{} already exists; give another name, or --force to replace it", path.display());
    }
    Ok(())
}

fn write_scene(scene: &Generated, output: Option<&Path>) -> Result<()> {
    let Some(output) = output else { return Ok(()) };
    let written = scene.write(output)?;
    print_fmt!("{} splats     {}", scene.splats.len(), written.scene.display());
    print_fmt!("arena             {}", written.arena.display());
    print_fmt!("{} true solids   {}", scene.truth.len(), written.truth.display());
    Ok(())
}
