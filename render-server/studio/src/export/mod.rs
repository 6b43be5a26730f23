//! `vizflyt export`: a flight's log as a data set that other people's programs read.
//!
//! ```text
//! log, without images -> Motion    poses, sigmas, IMU, setpoints, odometry: all in memory
//! log, with images    -> Pictures  one after the other, decoded -> euroc | tum -> folder
//! log, with images    -> sensors   readings of what is no camera
//! ```
//! Every image is named by the instant that it shows. The folder appears under its name when it is whole.

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

/// Writes a flight's log as a data set: EuRoC, TUM RGB-D, or tables.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt export flight.mcap --format euroc -o flight       mav0/cam0/data/NS.png, imu0, state_groundtruth_estimate0
  vizflyt export flight.mcap --format tum -o flight         rgb/, depth/ (5000 per metre), groundtruth.txt of the camera
  vizflyt export flight.mcap --format parquet -o flight     tables: poses, imu, images, setpoints; images as PNG

An image's name is the instant that it shows. Which images there are is up to --log of the flight; what each file holds
is in docs/guides/logs.md.")]
pub struct ExportArgs {
    /// The flight's log
    #[arg(value_name = "FLIGHT.mcap")]
    log: PathBuf,
    /// Whose layout
    #[arg(long, value_enum)]
    format: Format,
    /// A folder that is not there yet
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// The camera of a TUM data set, which has one [default: the first]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Of the micro aerial vehicle data sets of ETH Zurich: all cameras, IMU, truth of the body
    Euroc,
    /// Of the RGB-D benchmark of TU Munich: one camera, depth, truth of the camera
    Tum,
    /// Tables that pandas reads, and images as PNG
    Parquet,
}

/// Exports, and prints what was written.
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
        "--camera is of --format tum; the others have all cameras"
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
        print_line(format!("broken      {} images do not decode and are left out", written.broken));
    }
    print_line(format!("poses       {} ({:.1} s)", motion.poses.len(), motion.seconds()));
    print_line(format!(
        "imu         {}, setpoints {} asked, {} sent, odometry {}",
        motion.imu.len(),
        motion.asked.len(),
        motion.sent.len(),
        motion.odometry.len()
    ));
    if readings > 0 {
        print_line(format!("sensors     {readings} readings, in {above}NAME"));
    }
    if motion.is_cut {
        print_line("note        the log ends early: its flight was killed, or the file is damaged");
    }
    print_line(format!("folder      {}", args.output.display()));
    Ok(ExitCode::SUCCESS)
}

/// What was written.
#[derive(Clone, Copy, Debug, Default)]
struct Written {
    images: usize,
    /// Images that do not decode.
    broken: usize,
}

/// Returns why there is nothing to export, and what to do.
fn without_images(log: &Path, observations: usize, foreign: Option<u32>) -> String {
    let name = log.display();
    if let Some(protocol) = foreign {
        return format!(
            "{name} is of protocol {protocol}, whose images are not known here; export it with the version that flew it"
        );
    }
    match observations {
        0 => format!("{name} holds no observation: no plugin was shown an image in that flight"),
        _ => format!(
            "{name} holds the heads of {observations} observations and no image; fly with --log full, or --log reduced \
             and room on the disk"
        ),
    }
}

/// Reads a file's name for messages.
fn context(path: &Path) -> impl Fn() -> String {
    let name = path.display().to_string();
    move || format!("cannot write {name}")
}

/// Returns an instant as TUM's text has it. [s]
fn seconds_text(at_ns: u64) -> String {
    format!("{}.{:09}", at_ns / 1_000_000_000, at_ns % 1_000_000_000)
}

/// Writes a file's text.
fn write_text(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(context(path))
}
