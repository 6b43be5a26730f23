//! The built-in example plugins, and `vizflyt fly`, which knows their names.
//!
//! A built-in runs as a child process like any other: `vizflyt plugin NAME`.

use std::ffi::OsString;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use vizflyt_runtime::FlyArgs;

/// A plugin that is linked into this program.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum BuiltIn {
    /// Flies to the goal through obstacles, by a potential field on the depth image.
    Avoid,
}

/// Arguments of the hidden `vizflyt plugin`.
#[derive(Args, Debug)]
pub(crate) struct PluginArgs {
    name: BuiltIn,
    /// The shared memory of the runtime that started it.
    #[arg(long = "vizflyt-service", value_name = "PREFIX")]
    service: String,
}

/// Runs a built-in plugin in this process.
pub(crate) fn run(args: &PluginArgs) -> ExitCode {
    match args.name {
        BuiltIn::Avoid => vizflyt_sdk::attach(vizflyt_avoid::Avoid::default(), &args.service),
    }
}

/// Runs `vizflyt fly`; success only if the flight finished or landed as asked.
pub(crate) fn fly(args: &FlyArgs) -> Result<ExitCode> {
    let command = command(&args.plugin, args.plugin_command())?;
    let outcome = vizflyt_runtime::fly_command(args, command)?;
    Ok(if outcome.is_good() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Whether a plugin of this name is linked into this program.
pub(crate) fn is_built_in(name: &str) -> bool {
    !name.contains('/') && BuiltIn::from_str(name, true).is_ok()
}

/// Returns the command that starts the plugin, a file, or else a built-in's name; `command` is the
/// plugin as typed, then its arguments.
pub(crate) fn command(
    plugin: &std::ffi::OsStr,
    mut command: Vec<OsString>,
) -> Result<Vec<OsString>> {
    let name = plugin.to_string_lossy().into_owned();
    let is_bare_name = !name.contains('/');
    if is_built_in(&name) {
        let program = std::env::current_exe().context("cannot find this program's own path")?;
        command.splice(0..1, [program.into(), "plugin".into(), name.into()]);
    } else if !is_bare_name && !std::path::Path::new(&name).exists() {
        let built_in: Vec<_> = BuiltIn::value_variants()
            .iter()
            .filter_map(|plugin| Some(plugin.to_possible_value()?.get_name().to_owned()))
            .collect();
        bail!(
            "there is no plugin at {name}; give the path of a program, or a built-in: {}",
            built_in.join(", ")
        );
    }
    Ok(command)
}
