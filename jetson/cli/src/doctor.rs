//! `vizflyt doctor`: finds what is wrong before it flies.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
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
  vizflyt doctor vehicle --ceiling 2.8 --radius 4 --apply")]
    Vehicle(VehicleArgs),
}

#[derive(Args, Debug)]
struct VehicleArgs {
    #[command(flatten)]
    autopilot: AutopilotArgs,
    /// Parameters as they should be [default: hardware/airframe's, for the autopilot's version]
    #[arg(long, value_name = "FILE")]
    airframe: Option<PathBuf>,
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
    let What::Vehicle(args) = &args.what;
    let mut visit = args.autopilot.visit()?;
    let has = visit.read()?;
    let version = visit.version()?;
    let firmware = visit.link().firmware().map_or("ArduCopter".to_owned(), |f| f.to_string());
    let system = visit.link().system().unwrap_or(0);
    tell(format!("vehicle  system {system}, {firmware}, {} parameters", has.len()));
    let wanted = args.wanted(version)?;
    let room = Room { ceiling_m: args.ceiling, radius_m: args.radius };
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
    fn wanted(&self, version: Version) -> Result<BTreeMap<String, f64>> {
        let Some(path) = &self.airframe else {
            return parse_params(shipped(version)).context("the shipped parameters");
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("parameters {} cannot be read", path.display()))?;
        parse_params(&text).with_context(|| path.display().to_string())
    }
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
