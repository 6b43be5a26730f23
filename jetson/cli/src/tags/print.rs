//! `vizflyt tags print`: writes a PDF, and the layout file next to it.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::{Args, Subcommand, ValueEnum};
use glam::{DVec2, DVec3};
use vizflyt_process::print_line;
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::print::{
    BAR_MM, CUBE_FACES, Cube, Floor, Mat, Pad, Paper, Printed, checkerboard, pdf,
};

use super::family;

/// Print tags: cube for the vehicle, mat for the floor, calibration board
///
/// Writes a PDF, and the layout file next to it.
#[derive(Args, Debug)]
#[command(
    after_help = "Print at 100 %, then measure the bar at the bottom of a sheet. If it is not
100.0 mm long, run the same command again with --bar-mm: the sheets do not change, and the layout
file gets the real sizes of the tags."
)]
pub(super) struct PrintArgs {
    #[command(subcommand)]
    object: PrintCommand,
}

#[derive(Subcommand, Debug)]
enum PrintCommand {
    /// Cube with tags for the vehicle, seen by cameras in the room
    Cube {
        /// Id of the front face; left, back, right, top, bottom follow
        #[arg(long, help_heading = "Tags", value_name = "ID", default_value_t = 0)]
        first_id: u32,
        /// Number of faces; 5: without the bottom
        #[arg(long, help_heading = "Tags", value_name = "N", default_value_t = 5)]
        faces: u32,
        /// Edge of the cube [mm]
        #[arg(long, help_heading = "Tags", value_name = "MM", default_value_t = 170.0)]
        face_mm: f64,
        /// Edge of a tag's black square [mm]
        #[arg(long, help_heading = "Tags", value_name = "MM", default_value_t = 132.0)]
        tag_mm: f64,
        /// Centre of the cube relative to the vehicle's: forward, left, up [m]
        #[arg(long, help_heading = "Tags", value_name = "X,Y,Z", default_value = "0,0,0", value_parser = three, allow_hyphen_values = true)]
        middle_m: DVec3,
        #[command(flatten)]
        common: Common,
    },
    /// Grid of tags for floor or wall, seen by a camera on the vehicle
    ///
    /// Printed on as many sheets as needed. Cameras in the room are also surveyed with it.
    Mat {
        /// Size the tags for a hall of this length, width and height [m]
        ///
        /// The tags are large enough for a survey of webcams in the upper corners. The paper size
        /// follows from the tag size.
        #[arg(long, help_heading = "Tags", value_name = "LxWxH", value_parser = hall,
            conflicts_with_all = ["columns", "rows", "pitch_mm", "tag_mm", "paper", "fly_over"])]
        for_hall: Option<DVec3>,
        /// Size of the area that a vehicle with a webcam under it flies over [m]
        ///
        /// Length is east, width is north. Prints large tags half a metre apart, one per sheet of
        /// A3.
        #[arg(long, help_heading = "Tags", value_name = "LxW", value_parser = area,
            conflicts_with_all = ["columns", "rows", "pitch_mm", "tag_mm", "paper"])]
        fly_over: Option<DVec2>,
        /// Pad for take-off and landing: centre east, north and size; can be repeated
        ///
        /// Small tags for a camera 80 mm or more above the floor. In metres, frame of the room.
        /// [default size: 0.5,0.35]
        #[arg(long = "pad", help_heading = "Tags", value_name = "X,Y[,LENGTH,WIDTH]", value_parser = pad, allow_hyphen_values = true, requires = "fly_over")]
        pads: Vec<Pad>,
        /// Id of the first tag; ids increase eastwards, then northwards
        #[arg(long, help_heading = "Tags", value_name = "ID", default_value_t = 100)]
        first_id: u32,
        /// Number of tags from west to east
        #[arg(long, help_heading = "Tags", value_name = "N", default_value_t = 4)]
        columns: u32,
        /// Number of tags from south to north
        #[arg(long, help_heading = "Tags", value_name = "N", default_value_t = 6)]
        rows: u32,
        /// Distance between the centres of neighbouring tags [mm]
        #[arg(long, help_heading = "Tags", value_name = "MM", default_value_t = 95.0)]
        pitch_mm: f64,
        /// Edge of a tag's black square [mm]
        #[arg(long, help_heading = "Tags", value_name = "MM", default_value_t = 70.0)]
        tag_mm: f64,
        /// Centre of the grid in the room: east, north, up [m]
        #[arg(long, help_heading = "Tags", value_name = "X,Y,Z", default_value = "0,0,0", value_parser = three, allow_hyphen_values = true)]
        middle_m: DVec3,
        #[command(flatten)]
        common: Common,
    },
    /// Calibration board: one sheet of tags, to glue on a flat, stiff surface
    Board {
        /// Id of the first tag
        #[arg(long, help_heading = "Tags", value_name = "ID", default_value_t = 300)]
        first_id: u32,
        /// Edge of a tag's black square [mm]
        #[arg(long, help_heading = "Tags", value_name = "MM", default_value_t = 30.0)]
        tag_mm: f64,
        #[command(flatten)]
        common: Common,
    },
    /// Checkerboard: one sheet, to glue on a flat, stiff surface
    ///
    /// For use of the same images with other calibration programs. The whole checkerboard must be
    /// visible in an image; of the board of tags, any part is enough.
    Checkers {
        /// Edge of a square [mm]
        #[arg(long, help_heading = "Tags", value_name = "MM", default_value_t = 25.0)]
        square_mm: f64,
        /// PDF to write; its layout goes into a .toml file of the same name
        #[arg(short, long, help_heading = "Output", value_name = "FILE.pdf")]
        output: PathBuf,
        /// Paper size
        #[arg(long, help_heading = "Output", value_enum, default_value_t = PaperName::A4)]
        paper: PaperName,
        /// Measured length of the printed scale bar [mm]
        #[arg(long, help_heading = "Output", value_name = "MM", default_value_t = BAR_MM)]
        bar_mm: f64,
    },
}

#[derive(Args, Debug)]
struct Common {
    /// PDF to write; its layout goes into a .toml file of the same name
    #[arg(short, long, help_heading = "Output", value_name = "FILE.pdf")]
    output: PathBuf,
    /// Paper size
    #[arg(long, help_heading = "Output", value_enum, default_value_t = PaperName::A4)]
    paper: PaperName,
    /// Measured length of the printed scale bar [mm]
    #[arg(long, help_heading = "Output", value_name = "MM", default_value_t = BAR_MM)]
    bar_mm: f64,
    /// Tag family
    #[arg(long, help_heading = "Tags", value_name = "NAME", default_value = "tag36h11", value_parser = family)]
    family: TagFamily,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum PaperName {
    A4,
    Letter,
    A3,
}

impl From<PaperName> for Paper {
    fn from(name: PaperName) -> Self {
        match name {
            PaperName::A4 => Self::A4,
            PaperName::Letter => Self::Letter,
            PaperName::A3 => Self::A3,
        }
    }
}

/// Runs `vizflyt tags print`.
pub(super) fn run(args: &PrintArgs) -> Result<()> {
    match args.object {
        PrintCommand::Cube { ref common, first_id, faces, face_mm, tag_mm, middle_m } => {
            let &Common { family, paper, bar_mm, .. } = common;
            let paper = paper.into();
            let cube = Cube { family, first_id, faces, face_mm, tag_mm, middle_m, paper, bar_mm };
            let printed = cube.print()?;
            finish("cube", common, paper, &printed)?;
            for (tag, (name, ..)) in printed.layout.tags.iter().zip(CUBE_FACES) {
                print_line(format_args!("  {name:<6} {} {}", tag.family, tag.id));
            }
            print_line(format_args!(
                "Glue it on a cube of {:.1} mm, each face where its name says.",
                face_mm * bar_mm / BAR_MM
            ));
        }
        PrintCommand::Mat {
            ref common,
            first_id,
            columns,
            rows,
            pitch_mm,
            tag_mm,
            for_hall,
            fly_over,
            ref pads,
            middle_m,
        } => {
            let &Common { family, paper, bar_mm, .. } = common;
            if let Some(size_m) = fly_over {
                let pads = pads.clone();
                return print_floor(
                    common,
                    &Floor { family, first_id, size_m, middle_m, pads, bar_mm },
                );
            }
            let paper = paper.into();
            let mat = match for_hall {
                Some(hall_m) => {
                    let (mat, px) = Mat::for_hall(hall_m, family, first_id, middle_m, bar_mm)?;
                    let (tag_mm, paper) = (mat.tag_mm, mat.paper);
                    print_line(format_args!(
                        "tags of {tag_mm:.0} mm on {paper}: a webcam of 900 px in a corner sees them with {px:.0} px"
                    ));
                    if px < READ_FROM_PX {
                        print_line(format_args!(
                            "That is too small: put the mat nearer to the cameras, one after the other, \
                             or use narrower lenses."
                        ));
                    }
                    mat
                }
                None => Mat {
                    family,
                    first_id,
                    columns,
                    rows,
                    pitch_mm,
                    tag_mm,
                    middle_m,
                    paper,
                    bar_mm,
                },
            };
            finish("mat", common, mat.paper, &mat.print()?)?;
            print_line(format_args!(
                "Join the sheets edge to edge, columns to the east, rows to the north; then survey it: \
                 glued paper has errors of millimetres."
            ));
        }
        PrintCommand::Board { ref common, first_id, tag_mm } => {
            let &Common { family, paper, bar_mm, .. } = common;
            let board = Mat::board(family, first_id, tag_mm, paper.into(), bar_mm)?;
            finish("board", common, board.paper, &board.print()?)?;
            print_line(format_args!(
                "Glue it on a flat, stiff surface: a bent board gives a wrong calibration."
            ));
        }
        PrintCommand::Checkers { ref output, paper, square_mm, bar_mm } => {
            let (sheet, board) = checkerboard(paper.into(), square_mm, bar_mm)?;
            let file = beside(output)?;
            write(output, &pdf("VizFlyt checkerboard", &[sheet]))?;
            write(&file, board.to_toml()?.as_bytes())?;
            print_line(format_args!(
                "{}: {} x {} inner corners, {:.2} mm apart",
                output.display(),
                board.columns,
                board.rows,
                board.square_m * 1e3
            ));
            print_line(format_args!("{}: layout, for `tags calibrate --board`", file.display()));
            print_line(format_args!(
                "Glue it on a flat, stiff surface: a bent board gives a wrong calibration."
            ));
        }
    }
    Ok(())
}

/// Prints a mat to fly over, and the positions of its pads.
fn print_floor(common: &Common, floor: &Floor) -> Result<()> {
    finish("mat", common, Paper::A3, &floor.print()?)?;
    for Mat { first_id, columns, rows, middle_m, .. } in floor.pads() {
        print_line(format_args!(
            "  pad at {:.2}, {:.2}: tags {first_id} to {}",
            middle_m.x,
            middle_m.y,
            first_id + columns * rows - 1
        ));
    }
    print_line(format_args!(
        "Put the centre of each large tag at the position on its sheet, \
         and join a pad's sheets edge to edge; then survey it all: \
         a tape measure has errors of millimetres."
    ));
    Ok(())
}

/// Returns the path of the layout file, next to the PDF.
fn beside(pdf: &Path) -> Result<PathBuf> {
    let layout = pdf.with_extension("toml");
    if layout == *pdf {
        anyhow::bail!(
            "{}: this is the path of the layout; use a PDF name ending in .pdf",
            pdf.display()
        );
    }
    Ok(layout)
}

fn finish(title: &str, common: &Common, paper: Paper, printed: &Printed) -> Result<()> {
    let path = &common.output;
    let layout = beside(path)?;
    write(path, &pdf(&format!("VizFlyt {title}"), &printed.sheets))?;
    write(&layout, printed.layout.to_toml()?.as_bytes())?;
    let (sheets, tags) = (printed.sheets.len(), printed.layout.tags.len());
    print_line(format_args!("{}: {sheets} sheets of {paper}, {tags} tags", path.display()));
    print_line(format_args!("{}: their positions", layout.display()));
    Ok(())
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}

/// Parses the size of a hall: `11x4.5x3.65`. [m]
fn hall(text: &str) -> Result<DVec3, String> {
    three(&text.replace('x', ","))
        .map_err(|_| "give LENGTHxWIDTHxHEIGHT in metres: 11x4.5x3.65".into())
}

/// Parses an area: `11x4.5`. [m]
fn area(text: &str) -> Result<DVec2, String> {
    let numbers = numbers(&text.replace('x', ","));
    match numbers.as_deref() {
        Ok([length, width]) => Ok(DVec2::new(*length, *width)),
        _ => Err("give LENGTHxWIDTH in metres: 11x4.5".into()),
    }
}

/// Parses a pad: `0.9,0` or `10,0,1.2,0.35`. [m]
pub(super) fn pad(text: &str) -> Result<Pad, String> {
    match numbers(text)?[..] {
        [x, y] => Ok(Pad { middle_m: DVec2::new(x, y), size_m: Pad::SIZE_M }),
        [x, y, length, width] if length > 0.0 && width > 0.0 => {
            Ok(Pad { middle_m: DVec2::new(x, y), size_m: DVec2::new(length, width) })
        }
        _ => Err("give X,Y or X,Y,LENGTH,WIDTH in metres".into()),
    }
}

/// Minimum size of a tag for reliable detection. [px]
const READ_FROM_PX: f64 = 20.0;

/// Parses three numbers separated by commas.
fn three(text: &str) -> Result<DVec3, String> {
    let [x, y, z] = numbers(text)?[..] else { return Err("give three numbers: X,Y,Z".into()) };
    Ok(DVec3::new(x, y, z))
}

/// Parses finite numbers separated by commas.
fn numbers(text: &str) -> Result<Vec<f64>, String> {
    let number = |part: &str| part.trim().parse().ok().filter(|number: &f64| number.is_finite());
    text.split(',')
        .map(|part| number(part).ok_or_else(|| format!("{part:?} is not a number")))
        .collect()
}
