//! `vizflyt doctor localization`: prints the pose in words, and checks it while the vehicle is
//! moved by hand.

mod delay;
mod gyro;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use clap::Args;
use vizflyt_guardian::port::MavlinkAddress;
use vizflyt_process::print_line;
use vizflyt_server::poses::drivers::{Measurement, PoseSource};
use vizflyt_server::poses::hand_check::description::describe_pose;
use vizflyt_server::poses::hand_check::{Change, Check, Diagnosis, HandCheckStep};
use vizflyt_server::poses::settings::{Driver, LocalizationConfig};
use vizflyt_server::poses::{drivers, settings};

use self::delay::{Delay, DelayMeter, NoDelay};
use self::gyro::Gyro;
use crate::vehicle::AutopilotArgs;

#[derive(Args, Debug)]
pub(crate) struct LocalizationArgs {
    /// arena.toml or its folder; its [[localization]] is checked
    arena: Option<PathBuf>,
    /// Source to check, as for `vizflyt serve`
    #[arg(long, value_name = "DRIVER:ADDR[,KEY=VALUE]", value_parser = LocalizationConfig::parse)]
    pose: Option<LocalizationConfig>,
    /// Name of the vehicle
    #[arg(long, value_name = "NAME", default_value = "vizflyt")]
    vehicle: String,
    /// Autopilot whose gyroscope measures the delay of the source, `latency_ms`
    ///
    /// Address as for `vizflyt doctor vehicle`.
    #[arg(long, value_name = "ADDRESS", conflicts_with = "watch")]
    mavlink: Option<MavlinkAddress>,
    /// File with the settings of the autopilot's link
    ///
    /// [default: ./jetson.toml, ~/.config/vizflyt/jetson.toml or /etc/vizflyt/jetson.toml]
    #[arg(long, value_name = "FILE", requires = "mavlink")]
    config: Option<PathBuf>,
    /// Only print the pose, until Ctrl-C
    #[arg(long)]
    watch: bool,
    /// Timeout of the check
    #[arg(long, value_name = "SECONDS", default_value_t = 180.0)]
    within: f64,
}

/// Runs `vizflyt doctor localization`.
pub(super) fn run(args: &LocalizationArgs) -> Result<ExitCode> {
    let config = args.source()?;
    let mut opened = drivers::open(std::slice::from_ref(&config))?;
    let address = opened.first_mut().map(|source| source.address()).unwrap_or_default();
    print_line(format!("listens  {} {address}", config.driver));
    let mut gyro = args.gyro()?;
    let mut source = drivers::track(opened, &[args.vehicle.as_str()])?;
    let mut check = Check::new(config.clone());
    let (start, mut printed_at) = (Instant::now(), None::<Instant>);
    let mut step = None;
    while args.watch || start.elapsed().as_secs_f64() < args.within {
        let now_s = start.elapsed().as_secs_f64();
        let Some(measured) = receive(&mut *source, gyro.as_mut()) else { continue };
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
        if check.step() == HandCheckStep::Done {
            let diagnosis = check.diagnosis();
            let delay =
                gyro.map(|mut gyro| measure_delay(&config, &diagnosis, &mut *source, &mut gyro));
            return Ok(report(&config, diagnosis, delay.as_ref()));
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
    bail!("timeout: the check was not completed within {:.0} s; use a longer --within", args.within)
}

/// Waits for a pose for at most 0.1 s, prints warnings, and passes data to the delay meter.
fn receive(source: &mut dyn PoseSource, gyro: Option<&mut Vehicle>) -> Option<Measurement> {
    let measured = source.receive(Duration::from_millis(100)).last().copied();
    while let Some(warning) = source.next_warning() {
        print_line(format!("note     {warning}"));
    }
    if let Some(vehicle) = gyro {
        let heard = vehicle.gyro.take();
        if heard.is_connected && !std::mem::replace(&mut vehicle.was_connected, true) {
            print_line("vehicle  heartbeats of its autopilot received");
        }
        vehicle.clock_off_ms = heard.clock_off_ms;
        if heard.wrong_vehicle.is_some() {
            vehicle.wrong_vehicle = heard.wrong_vehicle;
        }
        if heard.began_anew {
            vehicle.meter = DelayMeter::default();
        }
        for (at_s, rate_radps) in heard.readings {
            vehicle.meter.add_gyro(at_s, rate_radps);
        }
        if let Some(measured) = &measured {
            let at_s = measured.stamp.as_ns() as f64 * 1e-9;
            vehicle.meter.add_pose(at_s, measured.world_from_body.rotation);
        }
    }
    measured
}

/// Gyroscope of the vehicle, and the delay meter.
struct Vehicle {
    gyro: Gyro,
    meter: DelayMeter,
    was_connected: bool,
    wrong_vehicle: Option<String>,
    /// Error bound of the gyroscope's times. [ms]
    clock_off_ms: Option<f64>,
}

/// Returns the delay of the poses in addition to the configured one. If the motions were too
/// gentle, requests quicker ones.
fn measure_delay(
    config: &LocalizationConfig,
    diagnosis: &Diagnosis,
    source: &mut dyn PoseSource,
    vehicle: &mut Vehicle,
) -> Result<(Delay, Option<f64>), String> {
    if let Some(wrong) = vehicle.wrong_vehicle.take() {
        return Err(wrong);
    }
    if diagnosis.change.iter().any(|(key, _)| *key == "euler") {
        return Err("the delay needs correct angles: set `euler`, and repeat the check".to_owned());
    }
    let mut found = vehicle.meter.delay();
    if found == Err(NoDelay::Gentle) {
        print_line(format!(
            "do       turn the vehicle left and right by a quarter turn, quickly, for {:.0} seconds",
            SHAKE.as_secs_f64()
        ));
        let end = Instant::now() + SHAKE;
        while Instant::now() < end {
            receive(source, Some(vehicle));
        }
        found = vehicle.meter.delay();
    }
    match found {
        Ok(delay) => Ok((delay, vehicle.clock_off_ms)),
        Err(NoDelay::Gentle) => {
            Err("the turns were too slow for the noise of the poses; repeat them, faster"
                .to_owned())
        }
        Err(NoDelay::Unlike) => Err(format!(
            "poses and gyroscope do not show the same motion; check that the autopilot belongs to '{}', and that \
             the delay is less than 0.5 s",
            config.objects.values().next().map_or("the vehicle", String::as_str)
        )),
        Err(NoDelay::Silent) if !vehicle.was_connected => {
            Err("received no heartbeat of an autopilot; check power, link and address".to_owned())
        }
        Err(NoDelay::Silent) => {
            Err("gaps in the data of the autopilot's gyroscope; check its link".to_owned())
        }
    }
}

/// Delay in addition to the configured one, and error bound of the gyroscope's times [ms]; or why
/// it was not measured.
type Measured = Result<(Delay, Option<f64>), String>;

fn report(
    config: &LocalizationConfig,
    mut diagnosis: Diagnosis,
    delay: Option<&Measured>,
) -> ExitCode {
    let is_laid_right = diagnosis.faults.is_empty();
    let explained = !diagnosis.change.is_empty();
    if let Some(Ok((delay, clock_off_ms))) = delay {
        judge_delay(config, delay, *clock_off_ms, &mut diagnosis);
    }
    for line in &diagnosis.faults {
        print_line(format!("WRONG    {line}"));
    }
    print_change("set  ", config, &diagnosis.change);
    for other in &diagnosis.others {
        print_change("or   ", config, other);
    }
    if !diagnosis.others.is_empty() {
        print_line(
            "each of these settings explains all motions: set one, and repeat the check with another heading \
             of the vehicle",
        );
    }
    match delay {
        None => print_line(
            "note     the delay of the poses was not measured: power the vehicle, and add --mavlink \
             udpin:0.0.0.0:14550, or the autopilot's address",
        ),
        Some(Err(why)) => print_line(format!("note     the delay was not measured: {why}")),
        Some(Ok(_)) => {}
    }
    if is_laid_right {
        print_line("right    axes, units and turns are correct");
    } else if !explained {
        print_line(
            "no setting explains all of it: do it again, one motion at a time, straight up, straight \
             towards the nose, a quarter turn to the left; then check that the object's axes were laid \
             along the vehicle's when it was made",
        );
    }
    if diagnosis.faults.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Prints the settings to change: one line for each key, and all of them as a command line.
fn print_change(word: &str, config: &LocalizationConfig, change: &Change) {
    if change.is_empty() {
        return;
    }
    for (key, value) in change {
        let quote = if value.parse::<f64>().is_ok() { "" } else { "\"" };
        print_line(format!("{word}    {key} = {quote}{value}{quote} in [[localization]]"));
    }
    let pairs: Vec<_> = change.iter().map(|(key, value)| format!("{key}={value}")).collect();
    print_line(format!(
        "         or --pose {}:{},...,{}",
        config.driver,
        config.address(),
        pairs.join(",")
    ));
}

/// Prints the delay, and adds the settings to change.
fn judge_delay(
    config: &LocalizationConfig,
    delay: &Delay,
    clock_off_ms: Option<f64>,
    diagnosis: &mut Diagnosis,
) {
    let uncertain_ms = delay.uncertain_ms + clock_off_ms.unwrap_or(0.0);
    let link = match clock_off_ms {
        Some(_) => "",
        None => ", plus the unknown delay of the autopilot's link: it does not reply to TIMESYNC",
    };
    let total_ms = config.latency_ms + delay.ms;
    print_line(format!(
        "delay    poses show a turn {total_ms:.0} ms after the gyroscope (+-{uncertain_ms:.0} ms{link}); \
         latency_ms is {}",
        config.latency_ms
    ));
    if delay.ms.abs() <= DELAY_MATTERS_MS.max(uncertain_ms) {
        return;
    }
    let set_ms = total_ms.round().max(0.0);
    if set_ms == config.latency_ms {
        return;
    }
    diagnosis.faults.push(format!(
        "poses are {:.0} ms {} than their stamps",
        delay.ms.abs(),
        if delay.ms > 0.0 { "older" } else { "younger" }
    ));
    if set_ms <= MAX_LATENCY_MS {
        diagnosis.change.push(("latency_ms", set_ms.to_string()));
    }
}

impl LocalizationArgs {
    /// Opens the connection to the vehicle's gyroscope, if --mavlink is given.
    fn gyro(&self) -> Result<Option<Vehicle>> {
        let Some(mavlink) = &self.mavlink else { return Ok(None) };
        let (address, settings) = AutopilotArgs::at(mavlink.clone(), self.config.clone()).link()?;
        let gyro = Gyro::open(&address, settings)?;
        print_line(format!("listens  {address} for the autopilot's gyroscope"));
        let meter = DelayMeter::default();
        Ok(Some(Vehicle {
            gyro,
            meter,
            was_connected: false,
            wrong_vehicle: None,
            clock_off_ms: None,
        }))
    }

    /// Returns the source of the command line, or the first of the arena, or Vicon.
    fn source(&self) -> Result<LocalizationConfig> {
        if let Some(config) = &self.pose {
            return Ok(config.clone());
        }
        let Some(arena) = &self.arena else { return Ok(LocalizationConfig::new(Driver::Vicon)) };
        let sources = settings::of_arena(arena)?;
        if sources.len() > 1 {
            print_line(format!(
                "note     the first of {} sources is checked; select another with --pose",
                sources.len()
            ));
        }
        Ok(sources.into_iter().next().unwrap_or_else(|| LocalizationConfig::new(Driver::Vicon)))
    }
}

/// Duration of the quick turns.
const SHAKE: Duration = Duration::from_secs(6);
/// Smaller errors of `latency_ms` are negligible: 5 mm at 1 m/s. [ms]
const DELAY_MATTERS_MS: f64 = 5.0;
/// Maximum of `latency_ms`. [ms]
const MAX_LATENCY_MS: f64 = 500.0;
/// Period of the printed poses: frequent enough to follow, slow enough to read.
const PRINT_PERIOD: Duration = Duration::from_secs(1);
