//! `vizflyt`: the one command people type. Each subcommand is a library of its own; this file only
//! reads the command line and starts one.

// `println!` panics where its reader has gone, as `head` does.
#![deny(clippy::print_stdout, clippy::print_stderr)]

mod bench;
mod bridge;
#[cfg(feature = "crazyflie")]
mod crazyflie;
// What of it needs no radio is tested in every build.
#[cfg(all(test, not(feature = "crazyflie")))]
#[path = "crazyflie/estimate.rs"]
mod crazyflie_estimate;
mod demo;
mod doctor;
#[cfg(test)]
mod endings;
mod fly;
mod lab;
mod lab_day;
mod leaderboard;
mod new;
mod pair;
mod password;
mod plugins;
mod replay;
mod server_page;
mod stats;
mod tags;
mod vehicle;

use std::io::IsTerminal;
use std::process::ExitCode;

use anyhow::Result;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::prelude::*;
use vizflyt_grading::class;
use vizflyt_process::{print_error, print_line};
use vizflyt_server::settings;
use vizflyt_studio::{arena, dataset, evaluate, export, scene};

/// A drone flies in an empty net while its cameras see a photorealistic world.
#[derive(Parser, Debug)]
#[command(version, propagate_version = true)]
#[command(after_help = "Start here:
  vizflyt demo                       fly a simulated drone through a forest and watch it in the browser
  vizflyt new first                  a plugin of your own that flies
  vizflyt fly first                  fly it in the simulated lab")]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// What to log on standard error: error, warn, info, debug, trace; or a filter as
    /// `vizflyt_runtime=debug`. Without it: info, and warn in `demo` and `fly`.
    #[arg(long, global = true, value_name = "LEVEL")]
    log_level: Option<String>,
}

#[derive(Subcommand, Debug)]
#[allow(clippy::large_enum_variant)] // Why: there is one of it, for a moment.
enum Command {
    /// Everything on this machine: generated scene, simulated vehicle, example plugin, page.
    Demo(demo::DemoArgs),
    /// Makes a folder with a plugin that flies.
    New(new::NewArgs),
    /// Flies a plugin: in the simulated lab, or in the real one if it is configured.
    Fly(fly::FlyArgs),
    /// Flies a project's course in lock-step, once for each seed, and scores the plugin.
    Grade(vizflyt_grading::GradeArgs),
    /// Packs a plugin's folder as a team hands it in.
    Submit(class::SubmitArgs),
    /// Grades every team of a class, and makes one table of all.
    GradeClass(class::ClassArgs),
    /// Flies courses for a program that learns; Python's `vizflyt.Env` starts it.
    Gym(vizflyt_gym::GymArgs),
    /// The render server: pose in, RGB-D out, page and events.
    Serve(vizflyt_server::ServeArgs),
    /// Pairs this computer with a render server, once, by a short code.
    Pair(pair::PairArgs),
    Password(password::PasswordArgs),
    /// Finds what is wrong before it flies: the autopilot's parameters, the localization's axes.
    Doctor(doctor::DoctorArgs),
    #[cfg(feature = "crazyflie")]
    Crazyflie(crazyflie::CrazyflieArgs),
    #[cfg(feature = "ros2")]
    Ros2(vizflyt_ros2::Ros2Args),
    /// Sets up the vehicle: the key for MAVLink signing.
    Vehicle(vehicle::VehicleArgs),
    Lab(lab_day::LabDayArgs),
    /// Teams, runs and standings of the lab's flights.
    Leaderboard(leaderboard::LeaderboardArgs),
    /// The simulated lab: vehicle, autopilot, motion capture.
    Sim(vizflyt_simulator::SimArgs),
    /// The Wi-Fi bridge of a vehicle: emulated here, or configured over the network.
    Bridge(bridge::BridgeArgs),
    /// Makes, inspects and renders scenes.
    Scene(scene::SceneArgs),
    Arena(arena::ArenaArgs),
    Tags(tags::TagsArgs),
    /// Measures how fast this machine renders.
    Bench(bench::BenchArgs),
    /// Latency of images, stage by stage, and why images were skipped.
    Stats(stats::StatsArgs),
    Evaluate(evaluate::EvaluateArgs),
    Export(export::ExportArgs),
    Dataset(Box<dataset::DatasetArgs>),
    /// Feeds a flight's recorded images to a plugin and reports where its answers differ.
    Replay(replay::ReplayArgs),
    /// Runs a built-in example plugin; started by `vizflyt fly`.
    #[command(hide = true)]
    Plugin(plugins::PluginArgs),
    /// The last process of a flight to die; started by `vizflyt fly`.
    #[command(hide = true, name = vizflyt_guardian::SUBCOMMAND)]
    Guardian {
        /// Where the autopilot is.
        mavlink: String,
    },
}

/// Reads the command line, runs what it says, and returns the exit status.
pub fn main() -> ExitCode {
    quiet_mesa();
    let cli = match command_line() {
        Ok(Some(cli)) => cli,
        Ok(None) => return ExitCode::SUCCESS,
        Err(error) => {
            print_error(format_args!("error: {error:#}"));
            return ExitCode::from(2);
        }
    };
    let log_level = cli.log_level.unwrap_or_else(|| match cli.command {
        // These print their own report; logs would bury it.
        Command::Demo(_) | Command::Fly(_) | Command::Replay(_) | Command::Grade(_) => {
            "warn".to_owned()
        }
        // What they print is the result; a load of seconds still shows its progress.
        Command::Bench(_) | Command::Dataset(_) | Command::Gym(_) => {
            "warn,vizflyt_server::scene=info".to_owned()
        }
        #[cfg(feature = "ros2")]
        Command::Ros2(_) => vizflyt_ros2::LOG_LEVEL.to_owned(),
        _ => "info,quinn=warn".to_owned(),
    });
    if let Err(error) = start_log(&log_level) {
        print_error(format_args!("error: --log-level '{log_level}': {error}"));
        return ExitCode::from(2);
    }
    match run(cli.command, &log_level) {
        Ok(code) => code,
        Err(error) => {
            print_error(format_args!("error: {error:#}"));
            ExitCode::FAILURE
        }
    }
}

/// Reads the command line, with what the file of `serve --config` adds; `None` if the settings were
/// only to be printed.
fn command_line() -> Result<Option<Cli>> {
    let mut matches = Cli::command().get_matches();
    if let Some(("serve", serve)) = matches.subcommand() {
        let line = settings::with_file(std::env::args_os().collect(), serve)?;
        matches = Cli::command().get_matches_from(line);
    }
    if let Some(("serve", serve)) = matches.subcommand()
        && serve.get_flag("print_config")
    {
        print_line(settings::to_toml(serve).trim_end());
        return Ok(None);
    }
    Ok(Some(Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())))
}

fn run(command: Command, log_level: &str) -> Result<ExitCode> {
    match command {
        Command::Demo(args) => demo::run(&args, log_level),
        Command::Serve(args) => vizflyt_server::serve(args).map(|()| ExitCode::SUCCESS),
        Command::Fly(args) => fly::run(args, log_level),
        Command::Grade(args) => vizflyt_grading::run(&args),
        Command::Submit(args) => class::submit(&args),
        Command::GradeClass(args) => class::grade_class(&args),
        Command::Gym(args) => vizflyt_gym::run(&args),
        Command::New(args) => new::run(&args),
        Command::Pair(args) => pair::run(&args),
        #[cfg(feature = "crazyflie")]
        Command::Crazyflie(args) => crazyflie::run(&args),
        #[cfg(feature = "ros2")]
        Command::Ros2(args) => vizflyt_ros2::run(&args),
        Command::Password(args) => password::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Vehicle(args) => vehicle::run(&args),
        Command::Lab(args) => lab_day::run(&args),
        Command::Leaderboard(args) => leaderboard::run(&args),
        Command::Sim(args) => vizflyt_simulator::run(args).map(|()| ExitCode::SUCCESS),
        Command::Bridge(args) => bridge::run(args).map(|()| ExitCode::SUCCESS),
        Command::Scene(args) => scene::run(args),
        Command::Arena(args) => arena::run(&args),
        Command::Tags(args) => tags::run(&args),
        Command::Bench(args) => bench::run(args),
        Command::Stats(args) => stats::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Dataset(args) => dataset::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Plugin(args) => Ok(plugins::run(&args)),
        Command::Guardian { mavlink } => Ok(vizflyt_guardian::run(&mavlink)),
    }
}

/// Keeps one of Mesa's Vulkan layers from looking for a screen where there is none: it would print
/// `error: XDG_RUNTIME_DIR is invalid` at every start, and we render to memory.
#[allow(unsafe_code, reason = "sets an environment variable before any thread starts")]
fn quiet_mesa() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: the first statement of `main`: no other thread reads the environment yet.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

/// Sends logs to standard error; standard output is for results.
fn start_log(filter: &str) -> Result<()> {
    let printed = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        // No colours into files and pipes.
        .with_ansi(std::io::stderr().is_terminal())
        // Told on standard error itself, which may be what is gone.
        .log_internal_errors(false);
    // What wgpu says of a card that works; errors reach the user as the renderer's.
    let filter = format!("wgpu_core::instance=error,wgpu_hal=error,{filter}").parse::<Targets>()?;
    tracing_subscriber::registry().with(printed).with(filter).init();
    Ok(())
}
