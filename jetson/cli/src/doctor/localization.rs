//! `vizflyt doctor localization`: the pose in plain words, and the check by hand.

mod check;
mod description;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use clap::Args;
use vizflyt_server::poses::settings::{Driver, LocalizationConfig};
use vizflyt_server::poses::{drivers, settings};

use self::check::{Check, Diagnosis, Step};
use self::description::describe_pose;
use crate::terminal::print_line;

/// What is looked at.
#[derive(Args, Debug)]
pub(crate) struct LocalizationArgs {
    /// arena.toml, or its folder: its [[localization]] is checked
    arena: Option<PathBuf>,
    /// The source that is checked, as for `vizflyt serve`
    #[arg(long, value_name = "DRIVER:ADDR[,KEY=VALUE]", value_parser = LocalizationConfig::parse)]
    pose: Option<LocalizationConfig>,
    /// The vehicle
    #[arg(long, value_name = "NAME", default_value = "vizflyt")]
    vehicle: String,
    /// Only prints the pose, until Ctrl-C
    #[arg(long)]
    watch: bool,
    /// Gives up after so long
    #[arg(long, value_name = "SECONDS", default_value_t = 180.0)]
    within: f64,
}

/// Runs the check.
pub(super) fn run(args: &LocalizationArgs) -> Result<ExitCode> {
    let config = args.source()?;
    let mut opened = drivers::open(std::slice::from_ref(&config))?;
    let address = opened.first_mut().map(|source| source.address()).unwrap_or_default();
    print_line(format!("listens  {} {address}", config.driver));
    let mut source = drivers::track(opened, &[args.vehicle.as_str()])?;
    let mut check = Check::new(config.clone());
    let (start, mut printed_at) = (Instant::now(), None::<Instant>);
    let mut step = None;
    while args.watch || start.elapsed().as_secs_f64() < args.within {
        let now_s = start.elapsed().as_secs_f64();
        let measured = source.receive(Duration::from_millis(100)).last().copied();
        while let Some(warning) = source.next_warning() {
            print_line(format!("note     {warning}"));
        }
        let Some(measured) = measured else { continue };
        let pose = measured.world_from_body;
        if printed_at.is_none_or(|at| at.elapsed() >= PRINT_PERIOD) {
            printed_at = Some(Instant::now());
            print_line(format!("pose     {}", describe_pose(&pose)));
        }
        if args.watch {
            continue;
        }
        if step.is_none() {
            step = Some(check.step());
            print_line(format!("do       {}", check.step().ask()));
        }
        if !check.handle_pose(now_s, &pose) {
            continue;
        }
        print_line(format!("seen     {}", check.seen()));
        if check.step() == Step::Done {
            return Ok(report(&config, &check.diagnosis()));
        }
        step = Some(check.step());
        print_line(format!("do       {}", check.step().ask()));
    }
    let counters = source.counters(0);
    if counters.poses == 0 {
        bail!(
            "no pose of '{}' has come to {} {address} within {:.0} s ({} bad packets); see the notes \
             above, and docs/guides/localization.md",
            config.object_of(&args.vehicle),
            config.driver,
            args.within,
            counters.bad_packets
        );
    }
    bail!("the check was not done within {:.0} s; --within gives more time", args.within)
}

fn report(config: &LocalizationConfig, diagnosis: &Diagnosis) -> ExitCode {
    for line in &diagnosis.faults {
        print_line(format!("WRONG    {line}"));
    }
    for (key, value) in &diagnosis.change {
        print_line(format!(
            "set      {key} = \"{value}\" in [[localization]], or --pose {}:{},...,{key}={value}",
            config.driver,
            config.address()
        ));
    }
    if diagnosis.faults.is_empty() {
        print_line("right    axes, units and turns are as they must be");
        return ExitCode::SUCCESS;
    }
    if diagnosis.change.is_empty() {
        print_line(
            "no setting explains all of it: do it again, one motion at a time, straight up, straight \
             towards the nose, a quarter turn to the left; then look whether the object's axes were laid \
             along the vehicle's when it was made",
        );
    }
    ExitCode::FAILURE
}

impl LocalizationArgs {
    /// Returns the source: that of the command line, else the arena's first, else Vicon.
    fn source(&self) -> Result<LocalizationConfig> {
        if let Some(config) = &self.pose {
            return Ok(config.clone());
        }
        let Some(arena) = &self.arena else { return Ok(LocalizationConfig::new(Driver::Vicon)) };
        let sources = settings::of_arena(arena)?;
        if sources.len() > 1 {
            print_line(format!(
                "note     the first of {} sources is checked; --pose names another",
                sources.len()
            ));
        }
        Ok(sources.into_iter().next().unwrap_or_else(|| LocalizationConfig::new(Driver::Vicon)))
    }
}

/// Period of the printed poses: often enough to follow, slow enough to read.
const PRINT_PERIOD: Duration = Duration::from_secs(1);
