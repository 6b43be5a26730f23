//! `vizflyt scene align`: estimates the pose and scale of a captured scene in the room, checks their accuracy, and
//! writes them into arena.toml.

mod page;
mod report;
mod tags;
pub(super) mod track;
mod write;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{ArgGroup, Args};
use glam::DVec3;
use vizflyt_arena::ArenaConfig;
use vizflyt_process::print_fmt;
use vizflyt_server::render::RendererKind;
use vizflyt_twin::align::floor::{self, Floor};

use self::report::PlacementReport;
pub(super) use self::track::ClockArgs;
use self::write::Changes;
use crate::arena::file;

/// Align a captured scene with the room
///
/// Estimates position, rotation and scale, and writes them into `[scene]` of the arena.toml.
#[derive(Args, Debug)]
#[command(
    group(ArgGroup::new("by").args(["tags", "floor", "track", "page"])),
    after_help = "Without --tags, --floor or --track, a page opens to click points of the floor and a length.

Examples:
  vizflyt scene align my-hall
  vizflyt scene align my-hall --tags mat.toml --capture my-capture
  vizflyt scene align my-hall --floor 0.1,1.2,3.3 --floor 2.0,1.1,3.1 --floor 0.3,1.2,5.0 \\
      --above 0,-1,3 --length 0.1,1.2,3.3:0.1,-0.4,3.3=2.0

  vizflyt scene align my-hall --track hall.csv --capture my-capture --times times.csv

--capture is the dataset from which the scene was trained: a folder of COLMAP, or of nerfstudio (transforms.json).
Points are in the axes and units of the scene file.

A track is a CSV of the poses of a marker that is fixed to the camera, with a header: t or stamp [s] (or stamp_ns),
x, y, z [m]. It can also be a TUM file (stamp tx ty tz qx qy qz qw), or an export of Motive or Vicon Tracker."
)]
pub(crate) struct AlignArgs {
    /// Arena with a scene file, as made by `vizflyt arena new`
    arena: PathBuf,
    /// Photos with poses from which the scene was trained
    #[arg(long, help_heading = "Photos", value_name = "DATASET")]
    capture: Option<PathBuf>,
    /// Layout of printed tags in the capture, surveyed in the room
    ///
    /// `vizflyt tags print` writes the layout.
    #[arg(long, help_heading = "Scale and frame", value_name = "LAYOUT", requires = "capture")]
    tags: Option<PathBuf>,
    /// Motion capture track of a marker fixed to the camera during the capture
    #[arg(long, help_heading = "Scale and frame", value_name = "TRACK", requires = "capture")]
    track: Option<PathBuf>,
    /// Point on the floor; give at least three
    ///
    /// The first becomes the origin. The second defines the x axis.
    #[arg(long, help_heading = "Scale and frame", value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true, requires_all = ["above", "length"])]
    floor: Vec<DVec3>,
    /// Point above the floor
    #[arg(long, help_heading = "Scale and frame", value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    above: Option<DVec3>,
    /// Two points, and their distance in the room [m]
    #[arg(long, help_heading = "Scale and frame", value_name = "P:P=METRES", value_parser = length, allow_hyphen_values = true)]
    length: Option<([DVec3; 2], f64)>,
    /// Standard deviation of picked points or surveyed tags [mm]
    #[arg(long, help_heading = "Scale and frame", value_name = "MM", default_value_t = 5.0)]
    sigma_mm: f64,
    /// Maximum position error of the twin within the fence [m]
    #[arg(long, help_heading = "Scale and frame", value_name = "METRES", default_value_t = 0.1)]
    allow_m: f64,
    #[command(flatten)]
    clocks: track::ClockArgs,
    /// Open the page, as without any method
    #[arg(long, help_heading = "Web page")]
    page: bool,
    /// Address of the page; port 0 selects a free one
    #[arg(long, help_heading = "Web page", value_name = "ADDR", default_value = "127.0.0.1:0")]
    http: SocketAddr,
    /// Renderer of the page's images
    #[arg(long, help_heading = "Web page", value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Only print the page's address
    #[arg(long, help_heading = "Web page")]
    no_browser: bool,
    /// Write the alignment even if it is too uncertain
    #[arg(long, help_heading = "Output")]
    force: bool,
}

/// Runs `vizflyt scene align`.
pub(crate) fn run(args: &AlignArgs) -> Result<ExitCode> {
    let path = file::find(&args.arena)?;
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let arena = ArenaConfig::parse(&text).with_context(|| path.display().to_string())?;
    let sigma_m = args.sigma_mm * 1e-3;
    let fit = match (&args.tags, &args.track, &args.capture, &args.above, &args.length) {
        (Some(layout), _, Some(capture), ..) => tags::find(layout, capture, sigma_m)?,
        (None, Some(track), Some(capture), ..) => {
            track::find(&args.clocks, track, capture, sigma_m)?
        }
        (None, None, _, Some(above), Some((ends, length_m))) => floor::fit(&Floor {
            points: args.floor.clone(),
            above: *above,
            length: *ends,
            length_m: *length_m,
            length_sigma_m: LENGTH_SHARE * length_m,
            click_sigma_m: sigma_m,
        })?,
        (None, None, None, None, None) => {
            page::run(args, &path)?;
            return Ok(ExitCode::SUCCESS);
        }
        _ => bail!(
            "give --tags or --track with --capture, or --floor with --above and --length; or none of them, to open the page"
        ),
    };
    let PlacementReport { lines, is_known } = report::report(&fit, &arena.geofence, args.allow_m);
    for line in lines {
        print_fmt!("{:<11} {}", line.key, line.text);
    }
    if !(is_known || args.force) {
        print_fmt!("unchanged   {}", path.display());
        return Ok(ExitCode::FAILURE);
    }
    write::write(&path, &Changes { place: fit.world_from_scene, fence: None, spawn: None })?;
    print_fmt!("written     {}", path.display());
    if arena.scene.crop.is_some() {
        print_fmt!("note        {CROP}");
    }
    print_fmt!("next        vizflyt arena check {}", args.arena.display());
    Ok(ExitCode::SUCCESS)
}

fn point(text: &str) -> Result<DVec3, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z]) if DVec3::new(x, y, z).is_finite() => Ok(DVec3::new(x, y, z)),
        _ => Err(format!("'{text}' is not a point; write it as 0.1,-2,3.5")),
    }
}

fn length(text: &str) -> Result<([DVec3; 2], f64), String> {
    let wrong = || format!("'{text}' is not a known length; write it as 0,1,2:0,1,4=2.0");
    let (ends, metres) = text.split_once('=').ok_or_else(wrong)?;
    let (from, to) = ends.split_once(':').ok_or_else(wrong)?;
    let metres: f64 = metres.trim().parse().map_err(|_| wrong())?;
    if !(metres > 0.0 && metres.is_finite()) {
        return Err(wrong());
    }
    Ok(([point(from)?, point(to)?], metres))
}

/// Note if the arena has a crop box, which the alignment does not change.
const CROP: &str =
    "scene.crop is in metres of the room and was not transformed; correct or remove it";
/// Relative standard deviation of a length that was measured with a tape.
const LENGTH_SHARE: f64 = 0.001;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_points_and_lengths() {
        assert_eq!(point("1, -2,3.5"), Ok(DVec3::new(1.0, -2.0, 3.5)));
        assert_eq!(length("0,0,0:0,0,4=2.5"), Ok(([DVec3::ZERO, DVec3::Z * 4.0], 2.5)));
        for wrong in ["1,2", "1,2,x", "1,2,inf", ""] {
            assert!(point(wrong).is_err(), "{wrong}");
        }
        for wrong in ["0,0,0:0,0,4", "0,0,0=2", "0,0,0:0,0,4=-1", "0,0,0:0,0=1"] {
            assert!(length(wrong).is_err(), "{wrong}");
        }
    }
}
