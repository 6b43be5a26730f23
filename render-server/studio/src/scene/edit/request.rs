//! Steps of the command line, in their order. Parameters that are not given are derived from the scene.

use std::str::FromStr;

use clap::{ArgMatches, Command, FromArgMatches};
use glam::{DQuat, DVec3, EulerRot};
use vizflyt_arena::config::Up;
use vizflyt_server::scene::{bounds, core};
use vizflyt_splat::Splats;
use vizflyt_splat::edit::{Axis, Carve, EditStep, Region};

/// Requested step.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Request {
    /// Step with all parameters.
    Step(EditStep),
    /// Cell, and minimum number of splats.
    Floaters(Option<f64>, u32),
    /// Cell, and number of parts to keep.
    Parts(Option<f64>, u32),
    /// Path; the other parameters are in [`CarveSettings`].
    Carve(Vec<[f64; 3]>),
    /// Share of the splats, 0 to 1.
    Share(f64),
}

/// Optional parameters of a carve. [scene]
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CarveSettings {
    pub(super) radius: Option<f64>,
    pub(super) depth: Option<f64>,
    pub(super) cell: Option<f64>,
    pub(super) reach: Option<f64>,
}

impl Request {
    /// Returns the step for a scene. Missing parameters are derived from the size of its core.
    pub(super) fn step(&self, splats: &Splats, carve: &CarveSettings) -> EditStep {
        let size = || {
            let [min, max] = bounds(core(splats, |p| p));
            max - min
        };
        // For a captured room of about 3 m height, this gives cells of 5 cm.
        let cell_of = |share: f64| rounded((size().min_element() / share).max(1e-6));
        let usual_cell = || cell_of(60.0);
        match self {
            Self::Step(step) => step.clone(),
            Self::Floaters(cell, least) => {
                EditStep::Floaters { cell: cell.unwrap_or_else(usual_cell), least: *least }
            }
            Self::Parts(cell, keep) => {
                EditStep::Parts { cell: cell.unwrap_or_else(usual_cell), keep: *keep }
            }
            Self::Carve(path) => {
                // Coarser cells, because a room needs two million of them.
                let cell = carve.cell.unwrap_or_else(|| cell_of(30.0));
                EditStep::Carve(Carve {
                    path: path.clone(),
                    radius: carve.radius.unwrap_or_else(|| rounded(2.0 * cell)),
                    depth: carve.depth.unwrap_or_else(|| rounded(3.0 * cell)),
                    cell,
                    reach: carve.reach.unwrap_or_else(|| rounded(size().max_element())),
                })
            }
            Self::Share(share) => {
                EditStep::Decimate { count: ((share * splats.len() as f64).round() as u32).max(1) }
            }
        }
    }
}

/// Rounds a derived parameter to two digits, because it is stored in the list of steps.
fn rounded(value: f64) -> f64 {
    format!("{value:.1e}").parse().unwrap_or(value)
}

/// Steps of a command line, in their order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Requests(pub(super) Vec<Request>);

/// Option: name, value name, help, and parser.
type Flag = (&'static str, &'static str, &'static str, fn(&str) -> Result<Request, String>);

const FLAGS: [Flag; 17] = [
    ("crop-box", "MIN:MAX", "Keep only a box along the scene's axes: X,Y,Z:X,Y,Z", |text| {
        Ok(crop(boxed(text)?))
    }),
    ("crop-sphere", "CENTER:RADIUS", "Keep only a sphere: X,Y,Z:R", |text| Ok(crop(sphere(text)?))),
    (
        "crop-prism",
        "AXIS:LOW,HIGH:P:P:P...",
        "Keep only a prism, LOW to HIGH along AXIS; points in the other two coordinates",
        |text| Ok(crop(prism(text)?)),
    ),
    ("remove-box", "MIN:MAX", "Remove a box", |text| Ok(remove(boxed(text)?))),
    ("remove-sphere", "CENTER:RADIUS", "Remove a sphere", |text| Ok(remove(sphere(text)?))),
    ("remove-prism", "AXIS:LOW,HIGH:P:P:P...", "Remove a prism", |text| Ok(remove(prism(text)?))),
    ("min-opacity", "OPACITY", "Remove splats with a lower opacity, 0 to 1", |text| {
        Ok(Request::Step(EditStep::Faint { below: number(text)? }))
    }),
    ("max-size", "SIZE", "Remove splats with a larger maximum standard deviation", |text| {
        Ok(Request::Step(EditStep::Large { above: number(text)? }))
    }),
    ("min-size", "SIZE", "Remove splats with a smaller maximum standard deviation", |text| {
        Ok(Request::Step(EditStep::Small { below: number(text)? }))
    }),
    (
        "drop-floaters",
        "CELL:LEAST",
        "Remove parts of less than LEAST (50) splats, and haze; CELL: linking distance",
        |text| cells(text, 50).map(|(cell, least)| Request::Floaters(cell, least)),
    ),
    ("keep-parts", "CELL:COUNT", "Keep only the largest COUNT (1) connected parts", |text| {
        cells(text, 1).map(|(cell, keep)| Request::Parts(cell, keep))
    }),
    (
        "carve",
        "P:P...",
        "Keep only what is visible from the free space around points: X,Y,Z:X,Y,Z",
        |text| text.split(':').map(point).collect::<Result<_, _>>().map(Request::Carve),
    ),
    (
        "decimate",
        "COUNT",
        "Keep only this number or percentage of splats: the most opaque and largest",
        share,
    ),
    (
        "up",
        "AXIS",
        "Rotate the scene so that this axis becomes +z: x, -x, y, -y, z or -z",
        |text| {
            let up = Up::from_str(text).map_err(|error| error.to_string())?;
            Ok(Request::Step(EditStep::Turn { rotation: up.world_from_scene().to_array() }))
        },
    ),
    (
        "rotate",
        "X,Y,Z",
        "Rotate the scene about x, then y, then z, counter-clockwise [deg]",
        |text| {
            let rad = DVec3::from(point(text)?).map(f64::to_radians);
            let rotation = DQuat::from_euler(EulerRot::ZYX, rad.z, rad.y, rad.x).to_array();
            Ok(Request::Step(EditStep::Turn { rotation }))
        },
    ),
    ("scale", "FACTOR", "Scale the scene by this factor", |text| {
        Ok(Request::Step(EditStep::Scale { factor: number(text)? }))
    }),
    ("move", "X,Y,Z", "Translate the scene", |text| {
        Ok(Request::Step(EditStep::Move { by: point(text)? }))
    }),
];

impl clap::Args for Requests {
    fn augment_args(mut command: Command) -> Command {
        for (name, value, help, read) in FLAGS {
            let may_be_bare = matches!(name, "drop-floaters" | "keep-parts");
            let arg = clap::Arg::new(name)
                .long(name)
                .value_name(value)
                .help(help)
                .help_heading("Steps, in the order in which they are given")
                .allow_hyphen_values(!may_be_bare)
                .action(clap::ArgAction::Append)
                .value_parser(move |text: &str| {
                    let request = read(text)?;
                    if let Request::Step(step) = &request {
                        step.check().map_err(|error| error.to_string())?;
                    }
                    Ok::<_, String>(request)
                });
            command = command.arg(if may_be_bare {
                arg.num_args(0..=1).require_equals(true).default_missing_value("")
            } else {
                arg
            });
        }
        command
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Requests {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut found = Vec::new();
        for (name, ..) in FLAGS {
            let values = matches.get_many::<Request>(name).into_iter().flatten();
            let places = matches.indices_of(name).into_iter().flatten();
            found.extend(places.zip(values.cloned()));
        }
        found.sort_by_key(|(place, _)| *place);
        Ok(Self(found.into_iter().map(|(_, request)| request).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

fn crop(region: Region) -> Request {
    Request::Step(EditStep::Crop { within: vec![region] })
}

fn remove(region: Region) -> Request {
    Request::Step(EditStep::Remove { within: vec![region] })
}

fn number(text: &str) -> Result<f64, String> {
    text.trim().parse().map_err(|_| format!("'{text}' is not a number"))
}

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let found: Vec<f64> = text.split(',').map(number).collect::<Result<_, _>>()?;
    let example = &"1.5,-2,0.3"[..if N == 3 { 10 } else { 6 }];
    found.try_into().map_err(|_| format!("'{text}' is not {N} numbers; write them as {example}"))
}

pub(super) fn point(text: &str) -> Result<[f64; 3], String> {
    numbers(text)
}

fn boxed(text: &str) -> Result<Region, String> {
    let (min, max) = text
        .split_once(':')
        .ok_or("write the minimum corner, a colon, and the maximum corner: 0,0,0:4,3,2.5")?;
    Ok(Region::Box { min: point(min)?, max: point(max)? })
}

fn sphere(text: &str) -> Result<Region, String> {
    let (center, radius) =
        text.split_once(':').ok_or("write the centre, a colon, and the radius: 0,0,1:2.5")?;
    Ok(Region::Sphere { center: point(center)?, radius: number(radius)? })
}

fn prism(text: &str) -> Result<Region, String> {
    let wrong = "write axis, bounds and corners: z:0,2.5:0,0:4,0:4,3";
    let mut parts = text.split(':');
    let axis = match parts.next() {
        Some("x") => Axis::X,
        Some("y") => Axis::Y,
        Some("z") => Axis::Z,
        _ => return Err(wrong.into()),
    };
    let [low, high] = numbers(parts.next().ok_or(wrong)?)?;
    let outline = parts.map(numbers).collect::<Result<_, _>>()?;
    Ok(Region::Prism { axis, outline, low, high })
}

/// Parses a cell and a count, which are both optional.
fn cells(text: &str, usual: u32) -> Result<(Option<f64>, u32), String> {
    let (cell, count) = text.split_once(':').unwrap_or((text, ""));
    let cell = if cell.is_empty() { None } else { Some(number(cell)?) };
    let wrong = || {
        format!("'{count}' is not a count; write the cell's side, a colon, and the count: 0.2:50")
    };
    let count = if count.is_empty() { usual } else { count.parse().map_err(|_| wrong())? };
    // Checked here, because loading the scene takes long.
    let step = EditStep::Floaters { cell: cell.unwrap_or(1.0), least: count };
    step.check().map_err(|error| error.to_string())?;
    Ok((cell, count))
}

fn share(text: &str) -> Result<Request, String> {
    if let Some(percent) = text.strip_suffix('%') {
        let percent = number(percent)?;
        let is_meant = percent > 0.0 && percent <= 100.0;
        let wrong = || format!("'{text}' is not a share; give more than 0 % and up to 100 %");
        return is_meant.then_some(Request::Share(percent / 100.0)).ok_or_else(wrong);
    }
    let count = text
        .parse()
        .map_err(|_| format!("'{text}' is not a count; give splats, or per cent: 50%"))?;
    Ok(Request::Step(EditStep::Decimate { count }))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        requests: Requests,
    }

    fn read(line: &str) -> Result<Vec<Request>, String> {
        let words = std::iter::once("edit").chain(line.split_whitespace());
        Cli::try_parse_from(words).map(|cli| cli.requests.0).map_err(|error| error.to_string())
    }

    #[test]
    fn keeps_the_order_of_the_command_line() {
        let step = Request::Step;
        let line = "--scale 2 --drop-floaters --crop-box -1,0,0:1,2,3 --scale 0.5 --drop-floaters=0.2:9 --move -1,0,0";
        let within = vec![Region::Box { min: [-1.0, 0.0, 0.0], max: [1.0, 2.0, 3.0] }];
        let expected = [
            step(EditStep::Scale { factor: 2.0 }),
            Request::Floaters(None, 50),
            step(EditStep::Crop { within }),
            step(EditStep::Scale { factor: 0.5 }),
            Request::Floaters(Some(0.2), 9),
            step(EditStep::Move { by: [-1.0, 0.0, 0.0] }),
        ];
        assert_eq!(read(line).unwrap(), expected);
        assert_eq!(read("").unwrap(), []);
    }

    #[test]
    fn parses_an_example_of_each_option() {
        for (flag, example) in [
            ("crop-sphere", "0,0,1:2.5"),
            ("remove-sphere", "0,0,1:2.5"),
            ("remove-box", "0,0,0:1,1,1"),
            ("crop-prism", "z:0,2.5:0,0:4,0:4,3"),
            ("remove-prism", "x:-1,2.5:0,0:4,0:4,3"),
            ("min-opacity", "0.05"),
            ("max-size", "2"),
            ("min-size", "0.001"),
            ("carve", "0,0,1:2,0,1"),
            ("decimate", "1000"),
            ("decimate", "50%"),
            ("up", "-y"),
            ("rotate", "0,0,90"),
        ] {
            assert_eq!(read(&format!("--{flag} {example}")).unwrap().len(), 1, "{flag}");
        }
        assert_eq!(read("--keep-parts=:2").unwrap(), [Request::Parts(None, 2)]);
        // The rotation about x comes first: y becomes z, which the rotation about z keeps.
        let [Request::Step(EditStep::Turn { rotation })] = read("--rotate 90,0,90").unwrap()[..]
        else {
            panic!("a turn")
        };
        assert!((DQuat::from_array(rotation) * DVec3::Y).abs_diff_eq(DVec3::Z, 1e-12));
    }

    #[test]
    fn rejects_invalid_values_with_advice() {
        for (line, expected) in [
            ("--crop-box 0,0,0", "the maximum corner"),
            ("--crop-box 0,0,0:0,1,1", "must exceed"),
            ("--crop-box 0,0:1,1,1", "not 3 numbers"),
            ("--crop-sphere 0,0,0:-1", "length above 0"),
            ("--crop-prism w:0,1:0,0:1,0:1,1", "axis, bounds and corners"),
            ("--crop-prism z:0,1:0,0:1,0", "3 to 2000 corners"),
            ("--min-opacity 5", "0 to 1"),
            ("--drop-floaters=0", "length above 0"),
            ("--drop-floaters=0.1:x", "not a count"),
            ("--decimate 0%", "more than 0 %"),
            ("--decimate 0", "at least 1"),
            ("--up w", "unknown axis"),
            ("--scale 0", "1e-6"),
            ("--carve 1,2", "not 3 numbers"),
        ] {
            let error = read(line).unwrap_err();
            assert!(error.contains(expected), "{line}: '{error}' lacks '{expected}'");
        }
    }
}
