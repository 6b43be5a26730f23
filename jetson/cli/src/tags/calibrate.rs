//! `vizflyt tags calibrate`: calibrates a camera's lens with images of the printed board.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail};
use clap::Args;
use vizflyt_process::{on_interrupt, print_line};
use vizflyt_tags::calibrate::{Board, Calibrator, LensModel, Session, ViewOutcome};
use vizflyt_tags::camera::{Mounting, TagCamera};
use vizflyt_tags::capture;

/// Calibrate a camera's lens with images of the printed board
///
/// Estimates focal lengths, principal point and distortion, and writes the camera's file.
#[derive(Args, Debug)]
#[command(after_help = "Focus and zoom must not change afterwards: turn autofocus off
(v4l2-ctl -d /dev/video0 --set-ctrl focus_automatic_continuous=0).
Move the board slowly through the whole image, near and far, tilted to all sides. The command prints
where to hold it next, and ends automatically.")]
pub(super) struct CalibrateArgs {
    /// Source of images: device, folder, video file, or a command's output
    ///
    /// Devices are /dev/video0 or /dev/video0:1280x720@60. - and '| COMMAND' read YUV4MPEG2.
    source: String,
    /// Layout of the board, written by `vizflyt tags print board` or `print checkers`
    #[arg(long, value_name = "FILE.toml")]
    board: PathBuf,
    /// Camera file to write
    #[arg(short, long, value_name = "FILE.toml")]
    output: PathBuf,
    /// Name of the camera [default: name of the file]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Fisheye lens with a field of view of more than about 110 degrees
    #[arg(long)]
    fisheye: bool,
}

/// Runs `vizflyt tags calibrate`.
pub(super) fn run(args: &CalibrateArgs) -> Result<()> {
    let stem = args.output.file_stem().and_then(|stem| stem.to_str());
    let Some(name) = args.name.as_deref().or(stem) else {
        bail!("{}: the camera file needs a name; give --name", args.output.display());
    };
    let model = if args.fisheye { LensModel::KannalaBrandt } else { LensModel::BrownConrady };
    let mut session = Session::new(Board::read(&args.board)?, model);
    let mut source = capture::open(&args.source)?;
    let is_live = source.is_live();
    let stop = Arc::new(AtomicBool::new(false));
    if is_live {
        let stop = Arc::clone(&stop);
        on_interrupt(move || {
            stop.store(true, Ordering::Relaxed);
            false
        })?;
        print_line("show the board to the camera; Ctrl-C ends early");
    }
    let mut printed = String::new();
    while let Some(exposure) = source.next()? {
        let verdict = session.take(exposure.image, is_live)?;
        if let Some(calibrator) = session.progress() {
            let line = guide(calibrator, verdict, is_live);
            if line != printed {
                let tells = matches!(verdict, ViewOutcome::Kept | ViewOutcome::AnotherBoard(..));
                if is_live || tells {
                    print_line(&line);
                }
                printed = line;
            }
            if is_live && calibrator.views() >= LIVE_VIEWS && calibrator.wanted().is_empty() {
                break;
            }
        }
        if stop.load(Ordering::Relaxed) {
            break;
        }
    }
    drop(source);
    if let Some(calibrator) = session.progress() {
        print_line(format_args!("{} views; corners per image region:", calibrator.views()));
        for row in calibrator.coverage().map() {
            print_line(format_args!("  {row}"));
        }
    }
    let found = session.finish().context("no camera file was written")?;
    let (k, quality) = (found.intrinsics, found.calibration);
    let camera = TagCamera {
        name: name.to_owned(),
        source: is_device(&args.source).then(|| args.source.clone()),
        intrinsics: k,
        mounting: Mounting::Unknown,
        calibration: Some(quality),
        survey: None,
        latency_ms: 0.0,
    };
    camera.write(&args.output)?;
    let [fx, fy, cx, cy] = found.sigma_px;
    print_line(format_args!(
        "focal length {:.1} +- {fx:.1}, {:.1} +- {fy:.1} px; middle {:.1} +- {cx:.1}, {:.1} +- {cy:.1} px",
        k.fx_px, k.fy_px, k.cx_px, k.cy_px
    ));
    print_line(format_args!(
        "corners are {:.2} px off in the {} views used, {:.2} px in those held back",
        quality.rms_px, quality.images, quality.held_out_rms_px
    ));
    print_line(format_args!("{}: written", args.output.display()));
    Ok(())
}

/// Returns the next instruction for the user, in one line.
fn guide(calibrator: &Calibrator, verdict: ViewOutcome, is_live: bool) -> String {
    let wanted = calibrator.wanted();
    let next = match (verdict, wanted.first()) {
        (ViewOutcome::AnotherBoard(..), _) => verdict.to_string(),
        (ViewOutcome::Moving | ViewOutcome::TooFewTags | ViewOutcome::NoBoard, _) if is_live => {
            verdict.to_string()
        }
        (_, Some(wanted)) => wanted.clone(),
        (_, None) => "more views, near and far, improve the accuracy".into(),
    };
    let share = 100.0 * calibrator.coverage().share();
    format!("{:>3} views, {share:>3.0} % of the image: {next}", calibrator.views())
}

/// Whether a source is a device, which stays the same across runs.
fn is_device(source: &str) -> bool {
    source.starts_with("/dev/") || source.starts_with('|')
}

/// A live calibration ends after this many views if all regions and tilts are covered.
const LIVE_VIEWS: usize = 30;
