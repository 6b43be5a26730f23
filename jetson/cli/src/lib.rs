//! The command line of `vizflyt`. Each subcommand is a separate module or crate; this file parses
//! the command line and starts one.

// `println!` panics if the reader of the pipe has closed it, as `head` does.
#![deny(clippy::print_stdout, clippy::print_stderr)]

mod bench;
mod bridge;
#[cfg(feature = "crazyflie")]
mod crazyflie;
// The part that needs no radio is tested in every build.
#[cfg(all(test, not(feature = "crazyflie")))]
#[path = "crazyflie/estimate.rs"]
mod crazyflie_estimate;
mod demo;
mod docs;
mod doctor;
#[cfg(test)]
mod endings;
mod fly;
mod help;
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
use vizflyt_process::{LogWriter, finish_output, never_wait_for_readers, print_error, print_line};
use vizflyt_server::settings;
use vizflyt_studio::{arena, dataset, evaluate, export, scene};

/// A drone flies in an empty net while its cameras see a photorealistic world.
#[derive(Parser, Debug)]
#[command(version, propagate_version = true)]
#[command(after_help = "Start here:
  vizflyt demo         fly a drone through a forest; watch it in the browser
  vizflyt new first    make a plugin that flies
  vizflyt fly first    fly it in the simulated lab
  vizflyt docs         open the documentation, offline")]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Log level of standard error: error, warn, info, debug, trace, or a filter
    ///
    /// A filter is for example `vizflyt_runtime=debug`. Default: info; in commands that print their
    /// own report (`demo`, `fly`, `grade`, ...) warn.
    #[arg(long, global = true, value_name = "LEVEL")]
    log_level: Option<String>,
}

#[derive(Subcommand, Debug)]
#[allow(clippy::large_enum_variant)] // Why: only one value exists, for a short time.
enum Command {
    /// Fly a simulated drone here: scene, vehicle, plugin, web page
    Demo(demo::DemoArgs),
    /// Make a folder with a plugin that flies
    New(new::NewArgs),
    /// Fly a plugin in the simulated lab, or in the configured real one
    Fly(fly::FlyArgs),
    /// Fly a course once per seed in lock-step, and score the plugin
    Grade(vizflyt_grading::GradeArgs),
    /// Pack the folder of a plugin for submission
    Submit(class::SubmitArgs),
    /// Grade every team of a class, and write one table of results
    GradeClass(class::ClassArgs),
    /// Run courses for Python's reinforcement-learning environments
    Gym(vizflyt_gym::GymArgs),
    /// Run the render server: poses in; images, web page, events out
    Serve(vizflyt_server::ServeArgs),
    /// Pair this computer with a render server by a short code
    Pair(pair::PairArgs),
    Password(password::PasswordArgs),
    /// Check a vehicle before flight: parameters, localization axes
    Doctor(doctor::DoctorArgs),
    #[cfg(feature = "crazyflie")]
    Crazyflie(crazyflie::CrazyflieArgs),
    #[cfg(feature = "ros2")]
    Ros2(vizflyt_ros2::Ros2Args),
    /// Set up the vehicle: key for MAVLink signing
    Vehicle(vehicle::VehicleArgs),
    Lab(lab_day::LabDayArgs),
    /// Show teams, runs and standings of the lab's flights
    Leaderboard(leaderboard::LeaderboardArgs),
    /// Run the simulated lab: vehicle, autopilot, motion capture
    Sim(vizflyt_simulator::SimArgs),
    /// Emulate, inspect and configure the Wi-Fi bridge of a vehicle
    Bridge(bridge::BridgeArgs),
    /// Make, inspect, edit and render scenes
    Scene(scene::SceneArgs),
    Arena(arena::ArenaArgs),
    Tags(tags::TagsArgs),
    /// Measure this machine: rendering, streaming, decoding, bridge
    Bench(bench::BenchArgs),
    /// Show the latency of images by stage, and why images were skipped
    Stats(stats::StatsArgs),
    Evaluate(evaluate::EvaluateArgs),
    Export(export::ExportArgs),
    Dataset(Box<dataset::DatasetArgs>),
    /// Feed recorded images to a plugin, and compare its answers
    Replay(replay::ReplayArgs),
    /// Open the documentation in a browser, without the internet
    Docs(docs::DocsArgs),
    /// Print shell completions for bash, zsh, fish, ...
    Completions(help::CompletionsArgs),
    /// Write manual pages to a folder; used by the packages
    #[command(hide = true)]
    Man(help::ManArgs),
    /// Run a built-in example plugin; started by `vizflyt fly`
    #[command(hide = true)]
    Plugin(plugins::PluginArgs),
    /// Land the vehicle if the runtime dies; started by `vizflyt fly`
    #[command(hide = true, name = vizflyt_guardian::SUBCOMMAND)]
    Guardian {
        /// Address of the autopilot
        mavlink: String,
    },
}

/// Parses the command line, runs the command and returns the exit status.
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
        // These commands print their own report; logs would hide it.
        Command::Demo(_) | Command::Fly(_) | Command::Replay(_) | Command::Grade(_) => {
            "warn".to_owned()
        }
        // These print results on standard output; loading a scene takes seconds and still shows
        // progress.
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
    if cli.command.flies_or_serves() {
        never_wait_for_readers();
    }
    let code = run(cli.command, &log_level).unwrap_or_else(|error| {
        print_error(format_args!("error: {error:#}"));
        ExitCode::FAILURE
    });
    finish_output();
    code
}

impl Command {
    /// Returns whether a vehicle depends on this process, so that it must not wait for the reader of its output.
    fn flies_or_serves(&self) -> bool {
        let has_flight = matches!(
            self,
            Self::Demo(_)
                | Self::Fly(_)
                | Self::Serve(_)
                | Self::Sim(_)
                | Self::Bridge(_)
                | Self::Tags(_)
        );
        #[cfg(feature = "crazyflie")]
        let has_flight = has_flight || matches!(self, Self::Crazyflie(_));
        #[cfg(feature = "ros2")]
        let has_flight = has_flight || matches!(self, Self::Ros2(_));
        has_flight
    }
}

/// Parses the command line and adds the settings of `serve --config`. Returns `None` if the
/// settings were only printed (`--print-config`).
fn command_line() -> Result<Option<Cli>> {
    let mut matches = help::grouped(Cli::command()).get_matches();
    if let Some(("serve", serve)) = matches.subcommand() {
        let line = settings::with_file(std::env::args_os().collect(), serve)?;
        matches = help::grouped(Cli::command()).get_matches_from(line);
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
        Command::Docs(args) => docs::run(&args),
        Command::Completions(args) => help::print_completions(&args, Cli::command()),
        Command::Man(args) => help::write_manual(&args, Cli::command()),
        Command::Plugin(args) => Ok(plugins::run(&args)),
        Command::Guardian { mavlink } => Ok(vizflyt_guardian::run(&mavlink)),
    }
}

/// Stops a Vulkan layer of Mesa from looking for a display: without one it prints `error:
/// XDG_RUNTIME_DIR is invalid` at every start. Rendering goes to memory and needs no display.
#[allow(unsafe_code, reason = "sets an environment variable before any thread starts")]
fn quiet_mesa() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: this is the first statement of `main`, so no other thread reads the environment
        // yet.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

/// Sends logs to standard error; standard output is for results.
fn start_log(filter: &str) -> Result<()> {
    let printed = tracing_subscriber::fmt::layer()
        .with_writer(|| LogWriter)
        // No colours in files and pipes.
        .with_ansi(std::io::stderr().is_terminal())
        // Internal errors are printed to standard error, which may itself be closed.
        .log_internal_errors(false);
    // wgpu logs messages about cards that work; the renderer reports real errors to the user.
    let filter = format!("wgpu_core::instance=error,wgpu_hal=error,{filter}").parse::<Targets>()?;
    tracing_subscriber::registry().with(printed).with(filter).init();
    Ok(())
}
