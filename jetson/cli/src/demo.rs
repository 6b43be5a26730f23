//! `vizflyt demo`: the built-in example in the simulated lab, and its page in the browser.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use vizflyt_process::print_line;
use vizflyt_protocol::messages::OutcomeKind;
use vizflyt_runtime::args::LogArgs;

use crate::lab::{self, LabArgs, LabFlight};
use crate::plugins;

/// Flies the simulated lab on this machine: scene, render server, runtime, plugin, vehicle, page.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt demo                                  fly the forest and watch it in the browser
  vizflyt demo --scene race --seed 3            windows, a gap and a hand, by the plugin race
  vizflyt demo --headless --report out.json     no browser; figures as JSON; status 0 if finished
  vizflyt demo --through-bridge                 MAVLink goes through the vehicle's Wi-Fi bridge, emulated
  vizflyt demo --localization natnet            the motion capture is an OptiTrack
  vizflyt demo --localization tags              no motion capture: two simulated webcams see AprilTags
  vizflyt demo --localization mat               nor webcams in the room: one under the vehicle sees tags on the floor
  vizflyt demo --plugin ./my_plugin             your plugin instead of the example")]
pub(crate) struct DemoArgs {
    #[command(flatten)]
    lab: LabArgs,
    /// Plugin to fly: whatever `vizflyt fly` takes [default: race where a course ends with its last stage, else avoid].
    #[arg(long)]
    plugin: Option<String>,
    /// Lands after this many seconds of flight; without it the course's own time limit counts. [s]
    #[arg(long)]
    seconds: Option<f64>,
    /// Takes off when `start` is pressed on the page, not by itself.
    #[arg(long)]
    wait: bool,
    /// Writes the flight's figures to this file as JSON.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    #[command(flatten)]
    log: LogArgs,
}

/// Runs the demo; success only if the flight finished.
pub(crate) fn run(args: &DemoArgs, log_level: &str) -> Result<ExitCode> {
    // The demo is the same on every computer: nobody's jetson.toml counts.
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
