//! `vizflyt scene train`: trains a scene from photos with known poses.

mod kept;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Serialize;
use vizflyt_process::print_fmt;
use vizflyt_server::render::RendererKind;
use vizflyt_splat::format::{self, Format};
use vizflyt_twin::train::Quality;
use vizflyt_twin::{Dataset, Options, Passes, Times, Trainer};

use self::kept::Kept;
use super::progress::Progress;

/// Train a scene from photos with known poses, on a graphics card or the processor
#[derive(Args, Debug)]
#[command(after_help = "DATASET is a folder of one of these kinds:
  COLMAP      sparse/0 with cameras, images, points3D (.bin or .txt), and images/; masks/NAME.png may
              mask out pixels (black). Lenses: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL,
              OPENCV, OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE
  nerfstudio  transforms.json, with masks, depth images and a PLY of points if it names them
Images are PNG or JPEG. The scene keeps the dataset's frame and unit of length.

A graphics card of any vendor (Vulkan) renders and computes derivatives, if its results for a test scene match the
processor's; loss and optimiser run on the processor. If the card is lost, the processor continues.

Examples:
  vizflyt scene train my-hall -o my-hall.ply
  vizflyt scene train my-hall -o my-hall.ply --resume      (after an interruption)
  vizflyt scene train my-hall -o my-hall.ply --width 640 --steps 7000 --splats 200000 --report my-hall.json
  vizflyt scene view my-hall.ply")]
pub(crate) struct TrainArgs {
    /// Folder with photos and their poses
    dataset: PathBuf,
    /// Number of steps, one photo each
    #[arg(long, help_heading = "Training", default_value_t = 3000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    steps: u32,
    /// Maximum number of splats
    #[arg(long, help_heading = "Training", default_value_t = 60_000, value_name = "N", value_parser = splats)]
    splats: usize,
    /// Maximum image width; wider photos are downscaled [px]
    #[arg(long, help_heading = "Training", default_value_t = 320, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    width: u32,
    /// Degree of spherical harmonics: how colours vary with the viewing direction
    #[arg(long, help_heading = "Training", default_value_t = 2, value_name = "0..3", value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: u8,
    /// Hold out every N-th photo for evaluation; 0: none
    #[arg(long, help_heading = "Training", default_value_t = 8, value_name = "N")]
    hold_out: usize,
    /// Assume equal brightness and colour of all photos, instead of solving for them
    #[arg(long, help_heading = "Training")]
    no_exposure: bool,
    /// Train for a renderer that dims splats smaller than a pixel (mip-splatting)
    #[arg(long, help_heading = "Training")]
    antialiased: bool,
    /// Renderer of photos and derivatives
    #[arg(long, help_heading = "Training", value_enum, default_value_t, value_name = "KIND")]
    renderer: RendererKind,
    /// Random seed
    ///
    /// The same dataset, options and seed give the same scene on the same kind of processor or
    /// card.
    #[arg(long, help_heading = "Training", default_value_t = 1)]
    seed: u64,
    /// Resume an interrupted training with the same photos and options
    ///
    /// The state is saved every minute.
    #[arg(long, help_heading = "Training")]
    resume: bool,
    /// Scene file to write; its name determines the format: .ply, .spz, .sog, ...
    #[arg(short, long, help_heading = "Output", value_name = "FILE")]
    output: PathBuf,
    /// Replace an existing file
    #[arg(long, help_heading = "Output")]
    force: bool,
    /// File for settings, quality and times of the training, as JSON
    #[arg(long, help_heading = "Output", value_name = "FILE.json")]
    report: Option<PathBuf>,
}

/// Output of `--report`.
#[derive(Debug, Serialize)]
struct TrainingReport {
    dataset: String,
    photos: usize,
    points: usize,
    width_px: usize,
    height_px: usize,
    steps: u32,
    splats: usize,
    seed: u64,
    antialiased: bool,
    /// Renderer at the end: `cpu avx2`, or `gpu` and the adapter's name.
    renderer: String,
    seconds: f64,
    /// Mean times of the parts of a step, over the steps of this run.
    ms_a_step: Times,
    /// Quality on the held-out photos; absent if there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    held_out: Option<Quality>,
}

fn splats(text: &str) -> Result<usize, String> {
    let count: usize = text.parse().map_err(|_| format!("'{text}' is not a whole number"))?;
    if (1000..=20_000_000).contains(&count) {
        return Ok(count);
    }
    Err(format!("{count} is outside 1000 to 20000000"))
}

/// Runs `vizflyt scene train`.
pub(crate) fn run(args: &TrainArgs) -> Result<()> {
    check_output(&args.output, args.force)?;
    if args.hold_out == 1 {
        bail!("--hold-out 1 leaves no photo to train with; give 0 to hold out none");
    }
    let mut kept = Kept::beside(&args.output);
    let checkpoint = kept.find(args.resume, args.force)?;
    let start = Instant::now();
    let dataset = Dataset::read(&args.dataset, Some(args.width))?;
    let view = &dataset.photos[0].view;
    print_fmt!(
        "dataset      {} photos, the first {} x {}, {} points, read in {:.1} s",
        dataset.photos.len(),
        view.width,
        view.height,
        dataset.points.len(),
        start.elapsed().as_secs_f64()
    );
    if let Some(first) = dataset.absent.first() {
        let absent = dataset.absent.len();
        print_fmt!("absent       {absent} photos with a pose are missing, such as {first}");
    }
    let observed: usize = dataset.photos.iter().map(|photo| photo.target.points.len()).sum();
    if observed == 0 && dataset.photos.iter().all(|photo| photo.target.depth.is_empty()) {
        print_fmt!(
            "no depth     neither points seen by three photos nor depth images: surfaces will be inaccurate"
        );
    }
    let options = Options {
        steps: args.steps,
        splats: args.splats,
        degree: args.sh_degree,
        seed: args.seed,
        hold_out: args.hold_out,
        antialiased: args.antialiased,
        exposure: !args.no_exposure,
        ..Options::default()
    };
    let (passes, reason) = Passes::choose(args.renderer.into())?;
    print_fmt!("renderer     {} ({reason})", passes.name());
    let mut trainer = match checkpoint {
        Some(checkpoint) => {
            print_fmt!("resumed      after {} of {} steps", checkpoint.steps(), args.steps);
            Trainer::resume(&dataset, options, passes, checkpoint)
                .context("cannot resume the saved training")?
        }
        None => Trainer::with(&dataset, options, passes),
    };
    let mut progress = Progress::new("");
    while trainer.steps() < args.steps {
        let parts = trainer.step();
        let (step, splats) = (trainer.steps(), trainer.gaussians().len());
        if let Some(lost) = trainer.passes().take_lost() {
            let now = trainer.passes().name();
            tracing::warn!("step {step}: {lost}; {now} continues from here, at its own speed");
        }
        progress.show(f64::from(step) / f64::from(args.steps), || {
            format!("step {step} of {}, {splats} splats, error {:.4}", args.steps, parts.l1)
        });
        kept.keep(&trainer);
    }
    drop(progress);
    let ms_a_step = trainer.times();
    let held_out = trainer.judge();
    let mut splats = trainer.splats();
    splats.antialiased = args.antialiased;
    format::write(&args.output, &splats)?;
    kept.remove();
    let report = TrainingReport {
        dataset: args.dataset.display().to_string(),
        photos: dataset.photos.len(),
        points: dataset.points.len(),
        width_px: view.width,
        height_px: view.height,
        steps: args.steps,
        splats: splats.len(),
        seed: args.seed,
        antialiased: args.antialiased,
        renderer: trainer.passes().name().to_owned(),
        seconds: start.elapsed().as_secs_f64(),
        ms_a_step,
        held_out,
    };
    print_fmt!("trained      {} steps in {:.0} s", report.steps, report.seconds);
    print_fmt!("ms a step    {ms_a_step}");
    if let Some(quality) = &report.held_out {
        print_fmt!(
            "held out     {} photos: PSNR {:.2} dB, SSIM {:.3}",
            quality.photos,
            quality.psnr_db,
            quality.ssim
        );
    }
    print_fmt!("scene        {} splats in {}", report.splats, args.output.display());
    if let Some(path) = &args.report {
        let text = serde_json::to_string_pretty(&report)?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(())
}

/// Rejects outputs that would only fail after the training.
fn check_output(output: &Path, force: bool) -> Result<()> {
    if Format::of_name(output).is_none() {
        bail!("{}: no format has this ending; try .ply", output.display());
    }
    if output.exists() && !force {
        bail!("{} already exists; give another name, or --force to replace it", output.display());
    }
    let folder = output.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        bail!("the folder {} does not exist; create it first", folder.display());
    }
    Ok(())
}
