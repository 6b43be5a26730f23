//! `vizflyt fly PLUGIN`: the same command for the simulated and the real lab. One line prints which
//! lab it is before the vehicle is armed.

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::Args;
use serde_json::json;
use vizflyt_grading::plugin::{Plugin, watch};
use vizflyt_process::print_line;
use vizflyt_server::scene::BareArgs;

use crate::lab::{self, LabArgs, LabFlight};

/// Fly a plugin in the simulated lab, or in the configured real one
///
/// The real lab is used if `jetson.toml` or --server names a render server.
///
/// PLUGIN is a folder made by `vizflyt new`, a `.py` file, a Cargo project, a program, or the name
/// of a built-in (avoid, race).
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt new first && vizflyt fly first                   a new plugin in the simulated lab
  vizflyt fly first --watch                                reload the plugin in flight when a file is saved
  vizflyt fly race --scene race --seed 3                   a built-in plugin in another scene
  vizflyt fly first --headless --seconds 20 --report r.json
                                                           results as JSON; status 0 if finished or landed
  vizflyt fly --attach                                     wait for `python my_plugin.py` or a debugger
  vizflyt fly first --server 192.168.10.2:4433 --mavlink udpin:0.0.0.0:14550
                                                           the real lab

The vehicle lands when the plugin ends, hangs or is killed, when poses stop, and on Ctrl-C.
Options that are not given come from jetson.toml. Options under Scene, Localization, Vehicle,
Rendering and Web page are for the simulated lab.")]
pub(crate) struct FlyArgs {
    /// Restart the plugin when one of its files is saved; the vehicle holds meanwhile
    #[arg(long, help_heading = "Plugin", conflicts_with = "attach")]
    watch: bool,
    /// Fly in the simulated lab even if jetson.toml names a real one
    #[arg(long, conflicts_with = "at")]
    sim: bool,
    #[command(flatten)]
    lab: LabArgs,
    #[command(flatten)]
    runtime: vizflyt_runtime::FlyArgs,
}

/// Flies; returns success only if the flight finished, or landed as commanded.
pub(crate) fn run(mut args: FlyArgs, log_level: &str) -> Result<ExitCode> {
    let file = args.runtime.settle()?;
    let name = args.runtime.plugin.clone().unwrap_or_default();
    let plugin = if args.runtime.attach { None } else { Some(Plugin::find(&name)?) };
    let plugin = plugin.as_ref();
    // In a child process the parent has already printed which lab it is.
    if args.runtime.server.at.is_some() && !args.sim {
        fly_real(&args, plugin, file.as_deref())
    } else {
        fly_simulated(&mut args, plugin, file.as_deref(), log_level)
    }
}

fn fly_real(args: &FlyArgs, plugin: Option<&Plugin>, file: Option<&Path>) -> Result<ExitCode> {
    let runtime = &args.runtime;
    let lab = &args.lab;
    let place = lab.scene.is_some() || lab.seed.is_some() || lab.project.is_some();
    if place || lab.environment.is_some() || lab.bare != BareArgs::default() {
        bail!(
            "--scene, --project, --seed, --environment, --up and --scale are for the simulated lab; add \
             --sim to fly there"
        );
    }
    let limits = runtime.jetson.plugin.limits();
    let mut command = plugin.map_or(Ok(Vec::new()), |plugin| plugin.command(&limits))?;
    command.extend(runtime.plugin_arguments.iter().cloned());
    // In a child process the parent has already printed which lab it is.
    if !runtime.lifeline {
        let server = runtime.server.address()?;
        let from = file.map_or("the command line".into(), |file| file.display().to_string());
        print_lab(
            runtime.json,
            "real",
            &format!(
                "server {server}, vehicle {} on {}, by {from}; propellers will turn",
                runtime.vehicle_name(),
                runtime.mavlink_address(),
            ),
        );
    }
    let reloads = match plugin {
        Some(plugin) if args.watch => Some(watch::watch(plugin.clone(), limits)?),
        _ => None,
    };
    let end = vizflyt_runtime::fly_command(runtime, command, reloads)?;
    Ok(if end.outcome().is_good() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn fly_simulated(
    args: &mut FlyArgs,
    plugin: Option<&Plugin>,
    file: Option<&Path>,
    log_level: &str,
) -> Result<ExitCode> {
    let runtime = &args.runtime;
    // Only options of the command line are rejected: jetson.toml may describe the real vehicle.
    for (given, option) in [
        (runtime.server.fingerprint.is_some() && !args.sim, "--fingerprint"),
        (runtime.server.keys.is_some() && !args.sim, "--keys"),
        (runtime.mavlink.is_some() && runtime.jetson.vehicle.mavlink.is_none(), "--mavlink"),
        (runtime.vehicle.is_some() && runtime.jetson.vehicle.name.is_none(), "--vehicle"),
    ] {
        if given {
            bail!(
                "{option} is for the real lab, and no server is known; give --server, or [server] \
                 in jetson.toml"
            );
        }
    }
    // Build the plugin here, so that the child process does not build it after the server has
    // started.
    plugin.map(|plugin| plugin.command(&runtime.jetson.plugin.limits())).transpose()?;
    if let Some(lab) = plugin.and_then(Plugin::lab) {
        if args.lab.scene.is_none() && args.lab.project.is_none() {
            args.lab.scene.clone_from(&lab.scene);
            args.lab.project = lab.project()?;
            args.lab.level = args.lab.level.or(lab.level()?);
        }
        args.lab.seed = args.lab.seed.or(lab.seed);
    }
    print_lab(runtime.json, "simulated", "all on this computer; nothing can break");
    let mut fly = vec![
        plugin.map_or("--attach".into(), |plugin| plugin.name().to_owned()),
        format!("--seconds={}", runtime.seconds).into(),
        format!("--ready-within={}", runtime.ready_within).into(),
    ];
    if runtime.wait {
        fly.push("--wait".into());
    }
    if let Some(address) = runtime.foxglove {
        fly.push(format!("--foxglove={address}").into());
    }
    match file {
        Some(file) => fly.extend(["--config".into(), file.into()]),
        None => fly.push("--no-config".into()),
    }
    if args.watch {
        fly.push("--watch".into());
    }
    let flight = LabFlight {
        lab: &args.lab,
        fly,
        plugin_arguments: &runtime.plugin_arguments,
        log: &runtime.log,
        json: runtime.json,
        log_level,
    };
    let Some(report) = lab::fly(&flight)? else { return Ok(ExitCode::FAILURE) };
    if let Some(path) = &runtime.report {
        report.write(path)?;
    }
    if runtime.json {
        print_line(json!({"report": report}));
    } else {
        print_line(report.summary());
    }
    Ok(if report.outcome.is_good() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Prints which of the two labs is used.
fn print_lab(json: bool, which: &str, what: &str) {
    if json {
        print_line(json!({"lab": which, "text": what}));
    } else {
        print_line(format!("lab         {which}: {what}"));
    }
}
