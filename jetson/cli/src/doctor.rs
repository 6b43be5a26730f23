//! `vizflyt doctor`: finds what is wrong before it flies.

mod localization;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::Geofence;
use vizflyt_runtime::airframe::{Difference, Room, Version, compare, parse_params, shipped};
use vizflyt_runtime::link::same;

use crate::terminal::tell;
use crate::vehicle::AutopilotArgs;

/// Finds what is wrong before it flies.
#[derive(Args, Debug)]
pub(crate) struct DoctorArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// Compares the autopilot's parameters with this airframe's, and names what is dangerous in a room.
    ///
    /// Ends with status 1 if something is.
    #[command(after_help = "Examples:
  vizflyt doctor vehicle                              what jetson.toml says, or udpin:0.0.0.0:14550
  vizflyt doctor vehicle --mavlink serial:/dev/ttyACM0
  vizflyt doctor vehicle --arena arena.toml --apply   with the fence that the arena's room asks for
  vizflyt doctor vehicle --ceiling 2.8 --radius 4 --apply")]
    Vehicle(VehicleArgs),
    /// Says where the vehicle is and which way it points, in plain words, while somebody lifts it, pushes it
    /// forward and turns it left; then which setting is wrong.
    ///
    /// Ends with status 1 if one is.
    #[command(after_help = "Examples:
  vizflyt doctor localization arena.toml
  vizflyt doctor localization --pose natnet:239.255.42.99:1511,up=y
  vizflyt doctor localization --pose vicon --watch        only says where it is, until Ctrl-C")]
    Localization(localization::LocalizationArgs),
}

#[derive(Args, Debug)]
struct VehicleArgs {
    #[command(flatten)]
    autopilot: AutopilotArgs,
    /// Parameters as they should be [default: hardware/airframe's, for the autopilot's version]
    #[arg(long, value_name = "FILE")]
    airframe: Option<PathBuf>,
    /// arena.toml whose room, from its spawn, the autopilot's fence shall hold
    #[arg(long, value_name = "FILE", conflicts_with_all = ["ceiling", "radius"])]
    arena: Option<PathBuf>,
    /// Height at which the autopilot's fence shall end, in metres
    #[arg(long, value_name = "METRES", value_parser = metres)]
    ceiling: Option<f64>,
    /// Distance from the take-off point at which it shall end, in metres
    #[arg(long, value_name = "METRES", value_parser = metres)]
    radius: Option<f64>,
    /// Writes the right values, after showing them
    #[arg(long)]
    apply: bool,
}

fn metres(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|value| (1.0..=100.0).contains(value));
    value.ok_or_else(|| format!("'{text}': give metres, from 1 to 100"))
}

/// Looks.
pub(crate) fn run(args: &DoctorArgs) -> Result<ExitCode> {
    let args = match &args.what {
        What::Vehicle(args) => args,
        What::Localization(args) => return localization::run(args),
    };
    let mut visit = args.autopilot.visit()?;
    let has = visit.read()?;
    let version = visit.version()?;
    let firmware = visit.link().firmware().map_or("ArduCopter".to_owned(), |f| f.to_string());
    let system = visit.link().system().unwrap_or(0);
    tell(format!("vehicle  system {system}, {firmware}, {} parameters", has.len()));
    let wanted = args.wanted(version)?;
    let room = args.room()?;
    let found = compare(version, &wanted, room, |name| has.get(name).copied());
    for difference in &found {
        tell(line(difference));
    }
    let dangers = found.iter().filter(|f| f.danger.is_some()).count();
    let wrong: Vec<_> = found.iter().filter(|f| f.has.is_some()).collect();
    tell(format!(
        "{dangers} dangerous, {} other differences, {} parameters that it does not have",
        wrong.len() - dangers,
        found.len() - wrong.len()
    ));
    if !args.apply {
        if !wrong.is_empty() {
            tell("`--apply` writes the right values");
        }
        return Ok(status(dangers));
    }
    let values: Vec<_> = wrong.iter().map(|f| (f.name.clone(), f.right)).collect();
    let mut failed = 0;
    for ((name, right), (_, now)) in values.iter().zip(visit.write(&values)?) {
        match now {
            Some(now) if same(now, *right) => tell(format!("written  {name} = {right}")),
            Some(now) => {
                failed += 1;
                tell(format!("FAILED   {name} is still {now}, not {right}"));
            }
            None => {
                failed += 1;
                tell(format!("FAILED   {name}: no answer"));
            }
        }
    }
    if !values.is_empty() {
        tell("restart the autopilot, then look again: some parameters appear only then");
    }
    Ok(status(failed))
}

impl VehicleArgs {
    fn room(&self) -> Result<Room> {
        let Some(path) = &self.arena else {
            return Ok(Room { ceiling_m: self.ceiling, radius_m: self.radius });
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("the arena {} cannot be read", path.display()))?;
        let arena = ArenaConfig::parse(&text).with_context(|| path.display().to_string())?;
        let room = room_of(&arena);
        if let Room { ceiling_m: Some(ceiling_m), radius_m: Some(radius_m) } = room {
            tell(format!(
                "arena    {}: a fence that ends {ceiling_m:.2} m over the start, {radius_m:.2} m around it",
                arena.name
            ));
        }
        Ok(room)
    }

    fn wanted(&self, version: Version) -> Result<BTreeMap<String, f64>> {
        let Some(path) = &self.airframe else {
            return parse_params(shipped(version)).context("the shipped parameters");
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("parameters {} cannot be read", path.display()))?;
        parse_params(&text).with_context(|| path.display().to_string())
    }
}

/// Returns the cylinder about the start that holds the arena's fence: the autopilot's own fence acts
/// where the guard's did not, never before it.
fn room_of(arena: &ArenaConfig) -> Room {
    let start = arena.spawn.position_m;
    let Geofence { min_m, max_m } = arena.geofence;
    let top_m = arena.limits.max_altitude_m.map_or(max_m.z, |most_m| most_m.min(max_m.z));
    let furthest = (start - min_m).max(max_m - start).truncate();
    Room { ceiling_m: Some(top_m - start.z), radius_m: Some(furthest.length()) }
}

fn status(wrong: usize) -> ExitCode {
    if wrong == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn line(difference: &Difference) -> String {
    let Difference { name, has, right, danger } = difference;
    match (has, danger) {
        (Some(has), Some(danger)) => {
            format!("DANGER   {name} is {has}, right is {right}: {danger}")
        }
        (Some(has), None) => format!("differs  {name} is {has}, right is {right}"),
        (None, _) => format!("absent   {name}, right is {right}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_autopilot_s_fence_holds_the_arena_s() {
        let text = r#"
            name = "room"
            scene = "scene.ply"
            body_radius_m = 0.12
            takeoff_height_m = 1.2
            spawn = { position_m = [1.0, 0.0, 0.1] }
            geofence = { min_m = [0.0, -3.0, -0.5], max_m = [5.0, 2.0, 3.6] }
            limits = { max_speed_mps = 3.0, max_acceleration_mps2 = 6.0, max_altitude_m = 2.6 }
            [[cameras]]
            name = "front"
            width_px = 320
            height_px = 240
            horizontal_fov_deg = 90.0
            position_m = [0.06, 0, 0.02]
        "#;
        let arena = ArenaConfig::parse(text).unwrap();
        // The furthest corner is 4 m east and 3 m south.
        let Room { ceiling_m, radius_m } = room_of(&arena);
        assert!((ceiling_m.unwrap() - 2.5).abs() < 1e-9, "{ceiling_m:?}");
        assert!((radius_m.unwrap() - 5.0).abs() < 1e-9, "{radius_m:?}");
    }
}
