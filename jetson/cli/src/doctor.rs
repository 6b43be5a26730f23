//! `vizflyt doctor`: checks of the vehicle before flight.

mod localization;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use vizflyt_arena::ArenaConfig;
use vizflyt_process::print_line;
use vizflyt_runtime::airframe::{
    AutopilotFence, Difference, FenceCylinder, ParamSession, Version, compare, parse_params,
    shipped,
};
use vizflyt_runtime::link::same;
use vizflyt_server::flights::lab_day::{FenceParameter, Finding};
use vizflyt_server::web::Evidence;

use crate::server_page::ServerPage;
use crate::vehicle::AutopilotArgs;

/// Check a vehicle before flight: parameters, localization axes
#[derive(Args, Debug)]
pub(crate) struct DoctorArgs {
    #[command(subcommand)]
    check: CheckCommand,
}

#[derive(Subcommand, Debug)]
enum CheckCommand {
    /// Compare the autopilot's parameters with those of this airframe
    ///
    /// Lists parameters that are dangerous in a room. Ends with status 1 if there are any.
    #[command(after_help = "Examples:
  vizflyt doctor vehicle                              the autopilot of jetson.toml, or udpin:0.0.0.0:14550
  vizflyt doctor vehicle --mavlink serial:/dev/ttyACM0
  vizflyt doctor vehicle --arena arena.toml --apply   also write the fence of the arena's room
  vizflyt doctor vehicle --ceiling 2.8 --radius 4 --apply
  vizflyt doctor vehicle --arena arena.toml --report http://192.168.10.2:8080 --key KEY   for `vizflyt lab`")]
    Vehicle(VehicleArgs),
    /// Check axes, units and angles of the localization by moving the vehicle by hand
    ///
    /// Prints position and heading while the vehicle is lifted, pushed forward and turned left;
    /// then the settings that are wrong. With --mavlink, also measures the delay of the poses with
    /// the autopilot's gyroscope. Ends with status 1 if a setting is wrong.
    #[command(after_help = "Examples:
  vizflyt doctor localization arena.toml
  vizflyt doctor localization arena.toml --mavlink udpin:0.0.0.0:14550     also measure the delay (latency_ms)
  vizflyt doctor localization --pose natnet:239.255.42.99:1511,up=y
  vizflyt doctor localization --pose vicon --watch        only print the pose, until Ctrl-C")]
    Localization(localization::LocalizationArgs),
}

#[derive(Args, Debug)]
struct VehicleArgs {
    #[command(flatten)]
    autopilot: AutopilotArgs,
    /// File of correct parameters [default: hardware/airframe's, by autopilot version]
    #[arg(long, help_heading = "Parameters", value_name = "FILE")]
    airframe: Option<PathBuf>,
    /// arena.toml for the autopilot's fence: its room, relative to its spawn
    #[arg(long, help_heading = "Parameters", value_name = "FILE", conflicts_with_all = ["ceiling", "radius"])]
    arena: Option<PathBuf>,
    /// Maximum height of the autopilot's fence [m]
    #[arg(long, help_heading = "Parameters", value_name = "METRES", value_parser = metres)]
    ceiling: Option<f64>,
    /// Radius of the autopilot's fence around the take-off point [m]
    #[arg(long, help_heading = "Parameters", value_name = "METRES", value_parser = metres)]
    radius: Option<f64>,
    /// Write the correct values, after printing them
    #[arg(long, help_heading = "Parameters")]
    apply: bool,
    /// Page of a server that records the result in its lab day: http://HOST:PORT
    #[arg(long, help_heading = "Lab day", value_name = "URL", conflicts_with = "apply")]
    report: Option<String>,
    /// Name of the vehicle on that server
    #[arg(
        long,
        help_heading = "Lab day",
        value_name = "NAME",
        default_value = "vizflyt",
        requires = "report"
    )]
    vehicle: String,
    /// Instructor's key of that page; not needed on the server's own computer
    ///
    /// The key is in the address /enter?key=KEY.
    #[arg(long, help_heading = "Lab day", value_name = "KEY", requires = "report")]
    key: Option<String>,
}

fn metres(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|value| (1.0..=100.0).contains(value));
    value.ok_or_else(|| format!("'{text}': give metres, from 1 to 100"))
}

/// Runs `vizflyt doctor`.
pub(crate) fn run(args: &DoctorArgs) -> Result<ExitCode> {
    let args = match &args.check {
        CheckCommand::Vehicle(args) => args,
        CheckCommand::Localization(args) => return localization::run(args),
    };
    let mut session = args.autopilot.open_session()?;
    for neighbor in session.neighbors() {
        print_line(format!("note     {neighbor}"));
    }
    let has = session.read()?;
    let version = session.version()?;
    let firmware = session.link().firmware().map_or("ArduCopter".to_owned(), |f| f.to_string());
    let system = session.link().system().unwrap_or(0);
    print_line(format!("vehicle  system {system}, {firmware}, {} parameters", has.len()));
    let wanted = args.wanted(version)?;
    let arena = args.arena()?;
    let cylinder = args.fence_cylinder(arena.as_ref());
    let found = compare(version, &wanted, cylinder, |name| has.get(name).copied());
    for difference in &found {
        print_line(line(difference));
    }
    let dangers = found.iter().filter(|f| f.danger.is_some()).count();
    let absent = found.iter().filter(|f| f.has.is_none()).count();
    let tuned = found.iter().filter(|f| f.is_tuned).count();
    let wrong: Vec<_> = found.iter().filter(|f| f.has.is_some() && !f.is_tuned).collect();
    print_line(format!(
        "{dangers} dangerous, {} other differences, {absent} missing parameters, {tuned} tuned",
        wrong.len() - dangers,
    ));
    if let Some(page) = &args.report {
        let fence = fence_parameters(&wanted, &found, &has);
        args.bring(page, finding(&firmware, has.len(), &found), fence)?;
    }
    if !args.apply {
        if !wrong.is_empty() || arena.is_some() {
            let also = if arena.is_some() { ", and the arena's polygons" } else { "" };
            print_line(format!("`--apply` writes the right values{also}"));
        }
        return Ok(status(dangers));
    }
    let values: Vec<_> = wrong.iter().map(|f| (f.name.clone(), f.right)).collect();
    let mut failed = 0;
    for ((name, right), (_, now)) in values.iter().zip(session.write(&values)?) {
        failed += usize::from(!now.is_some_and(|now| same(now, *right)));
        print_line(result_line(name, *right, now));
    }
    if let Some(arena) = &arena {
        failed += usize::from(!upload_fence(&mut session, arena)?);
    }
    if !values.is_empty() {
        print_line(
            "restart the autopilot, then repeat the check: some parameters appear only then",
        );
    }
    Ok(status(failed))
}

impl VehicleArgs {
    /// Sends the result to the lab day of a server.
    fn bring(&self, page: &str, finding: Finding, fence: Vec<FenceParameter>) -> Result<()> {
        let vehicle = self.vehicle.clone();
        let by = format!("vizflyt doctor vehicle {}", env!("CARGO_PKG_VERSION"));
        // Without an arena, the required fence is unknown.
        let fence = if self.arena.is_some() { fence } else { Vec::new() };
        let json = serde_json::to_string(&Evidence { vehicle, finding, fence, by })?;
        let server = ServerPage::at(page).with_key(self.key.as_deref());
        let (status, body) = server.post("/api/lab/evidence", &json)?;
        let said = String::from_utf8_lossy(&body);
        if status != 200 {
            bail!(
                "{page} rejected the evidence: {said} (HTTP status {status}); check --vehicle and --key"
            );
        }
        print_line(format!("reported {page}: {said}"));
        Ok(())
    }

    fn arena(&self) -> Result<Option<ArenaConfig>> {
        let Some(path) = &self.arena else { return Ok(None) };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("the arena {} cannot be read", path.display()))?;
        Ok(Some(ArenaConfig::parse(&text).with_context(|| path.display().to_string())?))
    }

    fn fence_cylinder(&self, arena: Option<&ArenaConfig>) -> FenceCylinder {
        let given = FenceCylinder { ceiling_m: self.ceiling, floor_m: None, radius_m: self.radius };
        let Some(arena) = arena else { return given };
        let cylinder = FenceCylinder::of(&arena.info(), arena.spawn.position_m).unwrap_or(given);
        if let FenceCylinder {
            ceiling_m: Some(ceiling_m),
            floor_m: Some(floor_m),
            radius_m: Some(radius_m),
        } = cylinder
        {
            print_line(format!(
                "arena    {}: a fence from {floor_m:.2} m to {ceiling_m:.2} m over the start, {radius_m:.2} m \
                 around it, and polygons",
                arena.name
            ));
        }
        cylinder
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

/// Returns the result in a few words as evidence: dangerous parameters with their values.
fn finding(firmware: &str, count: usize, found: &[Difference]) -> Finding {
    let dangers: Vec<_> = found.iter().filter(|f| f.danger.is_some()).collect();
    let others =
        found.iter().filter(|f| f.danger.is_none() && f.has.is_some() && !f.is_tuned).count();
    let name = |f: &&Difference| match f.has.map(shown) {
        Some(has) => format!("{} is {has}", f.name),
        None => f.name.clone(),
    };
    let names: Vec<_> = dangers.iter().take(NAMED).map(name).collect();
    let named = if names.is_empty() { String::new() } else { format!(" ({})", names.join(", ")) };
    let evidence = format!(
        "{firmware}, {count} parameters: {} dangerous{named}, {others} other differences",
        dangers.len()
    );
    let todo = (!dangers.is_empty())
        .then(|| "vizflyt doctor vehicle --arena arena.toml --apply".to_owned());
    Finding::of(evidence, todo.as_slice())
}

/// Returns the autopilot's FENCE_* parameters, with the correct values for the arena.
fn fence_parameters(
    wanted: &BTreeMap<String, f64>,
    found: &[Difference],
    has: &BTreeMap<String, f64>,
) -> Vec<FenceParameter> {
    let parameter = |name: &&str| {
        let (&file, has) = (wanted.get(*name)?, has.get(*name).copied());
        let differs = found.iter().find(|difference| difference.name == **name);
        // A parameter without a difference has the correct value.
        let right = differs.map_or_else(|| has.unwrap_or(file), |difference| difference.right);
        Some(FenceParameter { name: (*name).to_owned(), has, right })
    };
    FENCE.iter().filter_map(parameter).collect()
}

/// Parameters of the autopilot's fence.
const FENCE: [&str; 6] = [
    "FENCE_ENABLE",
    "FENCE_ACTION",
    "FENCE_TYPE",
    "FENCE_ALT_MAX",
    "FENCE_ALT_MIN",
    "FENCE_RADIUS",
];
/// Maximum number of dangerous parameters that the evidence names.
const NAMED: usize = 8;

/// Uploads the arena's polygons; returns whether the autopilot accepted them.
fn upload_fence(session: &mut ParamSession, arena: &ArenaConfig) -> Result<bool> {
    let info = arena.info();
    let fence = AutopilotFence::of(&info);
    if let Some(warning) = fence.warning(&info) {
        print_line(format!("note     {warning}"));
    }
    let accepted = session.upload_fence(fence.polygons)?;
    match &accepted {
        Ok(polygons) => print_line(format!("written  fence of {polygons} polygons")),
        Err(why) => print_line(format!("FAILED   fence of polygons: {why}")),
    }
    Ok(accepted.is_ok())
}

fn status(wrong: usize) -> ExitCode {
    if wrong == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Returns a parameter's value for printing: integers exactly, others with the six digits that MAVLink's floats carry
/// through a conversion of units. 0.135, not 0.13500000536441803.
fn shown(value: f64) -> f64 {
    let exact = value as f32;
    if exact.fract() == 0.0 {
        return f64::from(exact);
    }
    format!("{exact:.5e}").parse().unwrap_or(value)
}

/// Returns the result of writing a parameter; `now` is the value of the autopilot after that.
fn result_line(name: &str, right: f64, now: Option<f64>) -> String {
    let wanted = shown(right);
    match now {
        Some(now) if same(now, right) => format!("written  {name} = {wanted}"),
        Some(now) => format!("FAILED   {name} is still {}, not {wanted}", shown(now)),
        None => format!("FAILED   {name}: no reply"),
    }
}

fn line(difference: &Difference) -> String {
    let Difference { name, has, right, danger, is_tuned } = difference;
    let right = shown(*right);
    match (has.map(shown), danger) {
        (Some(has), _) if *is_tuned => {
            format!("tuned    {name} is {has}, and stays; tuning begins at {right}")
        }
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

    /// The sum of 0.35 and 3.3 has the digits of its rounding.
    #[test]
    fn prints_no_digits_of_rounding() {
        let noisy = [0.35 + 3.3, f64::from(0.135_f32), 0.1 + 0.2, f64::from(2.4_f32) * 3.0];
        for (value, expected) in noisy.into_iter().zip(["3.65", "0.135", "0.3", "7.2"]) {
            for (danger, is_tuned) in [(None, false), (Some("far".to_owned()), false), (None, true)]
            {
                for has in [None, Some(value)] {
                    let name = "FENCE_ALT_MAX".to_owned();
                    let danger = danger.clone().filter(|_| has.is_some());
                    let difference = Difference { name, has, right: value, danger, is_tuned };
                    let lines = [
                        line(&difference),
                        result_line("FENCE_ALT_MAX", value, has),
                        result_line("FENCE_ALT_MAX", value, Some(value)),
                        result_line("FENCE_ALT_MAX", 1.0, has),
                        finding("ArduCopter 4.6", 1, std::slice::from_ref(&difference)).evidence,
                    ];
                    for text in lines {
                        let words = text.split([' ', ',', ':', ';', ')', '(']);
                        assert!(words.clone().all(|word| word.len() < 14), "{text}");
                        assert!(
                            !text.contains(&value.to_string()) || value.to_string() == expected
                        );
                    }
                }
            }
            assert_eq!(shown(value).to_string(), expected);
        }
    }

    #[test]
    fn evidence_names_dangers_and_the_fence() {
        let difference = |name: &str, has, right, danger: Option<&str>| Difference {
            name: name.to_owned(),
            has,
            right,
            danger: danger.map(str::to_owned),
            is_tuned: false,
        };
        let found = [
            difference("FENCE_ALT_MAX", Some(100.0), 3.5, Some("far above")),
            difference("LOG_BITMASK", Some(1.0), 2.0, None),
            difference("NEW_ONE", None, 2.0, None),
        ];
        let told = finding("ArduCopter 4.6", 900, &found);
        assert_eq!(
            told.evidence,
            "ArduCopter 4.6, 900 parameters: 1 dangerous (FENCE_ALT_MAX is 100), 1 other differences"
        );
        assert!(!told.ok && told.todo.contains("--apply"));
        assert!(finding("ArduCopter 4.6", 900, &found[1..]).ok);
        let map = |pairs: &[(&str, f64)]| {
            pairs.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect()
        };
        let wanted = map(&[("FENCE_ALT_MAX", 3.0), ("FENCE_ENABLE", 1.0), ("FENCE_RADIUS", 4.0)]);
        let has = map(&[("FENCE_ALT_MAX", 100.0), ("FENCE_ENABLE", 1.0)]);
        let fence = fence_parameters(&wanted, &found, &has);
        let fence: Vec<_> = fence.iter().map(|p| (p.name.as_str(), p.has, p.right)).collect();
        let expected = [
            ("FENCE_ENABLE", Some(1.0), 1.0),
            ("FENCE_ALT_MAX", Some(100.0), 3.5),
            ("FENCE_RADIUS", None, 4.0),
        ];
        assert_eq!(fence, expected);
    }
}
