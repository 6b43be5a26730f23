//! `vizflyt export`: exports a flight's log as a data set for other programs.
//!
//! ```text
//! log, without images -> FlightTracks  poses, sigmas, IMU, setpoints, odometry: all in memory
//! log, with images    -> Pictures      decoded one after the other -> euroc | tum | table -> folder
//! log, with images    -> sensors       readings of sensors that are not cameras
//! ```
//! Each image is named by the time that it shows. The folder gets its name when it is complete.

mod columns;
pub(crate) mod euroc;
mod files;
mod motion;
mod parquet;
mod pictures;
mod sensors;
mod table;
mod tum;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use clap::{Args, ValueEnum};
use vizflyt_process::print_line;

use self::files::Folder;
use self::motion::FlightTracks;
use self::pictures::Pictures;

/// Export a flight's log as a data set: EuRoC, TUM RGB-D, or tables
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt export flight.mcap --format euroc -o flight       mav0/cam0/data/NS.png, imu0, state_groundtruth_estimate0
  vizflyt export flight.mcap --format tum -o flight         rgb/, depth/ (5000 per metre), groundtruth.txt of the camera
  vizflyt export flight.mcap --format parquet -o flight     tables: poses, imu, images, setpoints; images as PNG

The name of an image is the time that it shows. The option --log of the flight determines which images are recorded.
docs/guides/logs.md describes all files.")]
pub struct ExportArgs {
    /// Log of the flight
    #[arg(value_name = "FLIGHT.mcap")]
    log: PathBuf,
    /// Layout of the data set
    #[arg(long, value_enum)]
    format: Format,
    /// Output folder, which must not exist
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Camera of a TUM data set [default: the first]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// EuRoC (ETH Zurich): all cameras, IMU, ground truth of the body
    Euroc,
    /// TUM RGB-D (TU Munich): one camera, depth, ground truth of the camera
    Tum,
    /// Tables for pandas, and images as PNG
    Parquet,
}

/// Runs `vizflyt export`.
pub fn run(args: &ExportArgs) -> Result<ExitCode> {
    let motion = FlightTracks::read(&args.log)?;
    let folder = Folder::begin(&args.output)?;
    ensure!(
        motion.images > 0,
        "{}",
        without_images(&args.log, motion.observations, motion.foreign_protocol)
    );
    ensure!(
        args.camera.is_none() || args.format == Format::Tum,
        "--camera is for --format tum; the other formats have all cameras"
    );
    let pictures = Pictures::open(&args.log)?;
    let written = match args.format {
        Format::Euroc => euroc::write(&folder, &motion, pictures)?,
        Format::Tum => tum::write(&folder, &motion, pictures, args.camera.as_deref())?,
        Format::Parquet => table::write(&folder, &motion, pictures)?,
    };
    let above = if args.format == Format::Euroc { "mav0/" } else { "sensors/" };
    let readings = sensors::write(&folder, &args.log, above)?;
    folder.finish()?;
    let left_out = motion.observations - motion.with_images;
    let reduced = match left_out {
        0 => String::new(),
        _ => format!(
            "; {left_out} of {} observations are in this log without their images (--log full keeps all)",
            motion.observations
        ),
    };
    print_line(format!("images      {}{reduced}", written.images));
    if written.broken > 0 {
        print_line(format!("broken      {} images do not decode and are skipped", written.broken));
    }
    print_line(format!("poses       {} ({:.1} s)", motion.poses.len(), motion.seconds()));
    print_line(format!(
        "imu         {}, setpoints {} requested, {} sent, odometry {}",
        motion.imu.len(),
        motion.asked.len(),
        motion.sent.len(),
        motion.odometry.len()
    ));
    if readings > 0 {
        print_line(format!("sensors     {readings} readings, in {above}NAME"));
    }
    if motion.is_cut {
        print_line(
            "note        the log is incomplete: its flight was killed, or the file is damaged",
        );
    }
    print_line(format!("folder      {}", args.output.display()));
    Ok(ExitCode::SUCCESS)
}

/// Counts of written images.
#[derive(Clone, Copy, Debug, Default)]
struct Written {
    images: usize,
    /// Number of images that do not decode.
    broken: usize,
}

/// Returns the error for a log without images, with advice.
fn without_images(log: &Path, observations: usize, foreign: Option<u32>) -> String {
    let name = log.display();
    if let Some(protocol) = foreign {
        return format!(
            "{name} has protocol {protocol}, whose images this version cannot read; export it with the version that recorded it"
        );
    }
    match observations {
        0 => format!("{name} contains no observation: no plugin received an image in that flight"),
        _ => format!(
            "{name} contains {observations} observations without images; fly with --log full, or --log reduced \
             and enough space on the disk"
        ),
    }
}

/// Returns the context of a write error.
fn context(path: &Path) -> impl Fn() -> String {
    let name = path.display().to_string();
    move || format!("cannot write {name}")
}

/// Returns a time as text in TUM's format. [s]
fn seconds_text(at_ns: u64) -> String {
    format!("{}.{:09}", at_ns / 1_000_000_000, at_ns % 1_000_000_000)
}

fn write_text(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(context(path))
}
