//! `vizflyt demo`: flies a built-in example in the simulated lab and opens its web page.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use vizflyt_process::print_line;
use vizflyt_protocol::messages::OutcomeKind;
use vizflyt_runtime::args::LogArgs;

use crate::lab::{self, LabArgs, LabFlight};
use crate::plugins;

/// Fly a simulated drone here: scene, vehicle, plugin, web page
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt demo                                  fly the forest and watch it in the browser
  vizflyt demo --scene race --seed 3            windows, a gap and a hand; flown by the plugin race
  vizflyt demo --headless --report out.json     no browser; figures as JSON; status 0 if finished
  vizflyt demo --through-bridge                 MAVLink goes through the vehicle's Wi-Fi bridge, emulated
  vizflyt demo --localization natnet            simulated OptiTrack motion capture
  vizflyt demo --localization tags              no motion capture: two simulated webcams track AprilTags
  vizflyt demo --localization mat               no motion capture: a webcam under the vehicle sees tags on the floor
  vizflyt demo --plugin ./my_plugin             your plugin instead of the example")]
pub(crate) struct DemoArgs {
    /// Plugin to fly, as for `vizflyt fly`
    ///
    /// [default: race if the course ends at its last stage, else avoid]
    #[arg(long, help_heading = "Flight")]
    plugin: Option<String>,
    /// Maximum flight time; then the vehicle lands [s] [default: limit of the course]
    #[arg(long, help_heading = "Flight")]
    seconds: Option<f64>,
    /// Take off when `start` is pressed on the page, not automatically
    #[arg(long, help_heading = "Flight")]
    wait: bool,
    #[command(flatten)]
    lab: LabArgs,
    /// File for the results of the flight, as JSON
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    report: Option<PathBuf>,
    #[command(flatten)]
    log: LogArgs,
}

/// Runs the demo; returns success only if the flight finished.
pub(crate) fn run(args: &DemoArgs, log_level: &str) -> Result<ExitCode> {
    // The demo is the same on every computer, so jetson.toml is not read.
    let plugin = args.plugin.as_deref().unwrap_or(plugins::default_for(args.lab.scene()));
    let mut fly = vec![plugin.into(), "--no-config".into()];
    if let Some(seconds) = args.seconds {
        fly.push(format!("--seconds={seconds}").into());
    }
    if args.wait {
        fly.push("--wait".into());
    }
    let flight = LabFlight {
        lab: &args.lab,
        fly,
        plugin_arguments: &[],
        log: &args.log,
        json: false,
        log_level,
    };
    let Some(report) = lab::fly(&flight)? else { return Ok(ExitCode::FAILURE) };
    if let Some(path) = &args.report {
        report.write(path)?;
    }
    print_line(report.summary());
    Ok(if report.outcome == OutcomeKind::Finished { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
