//! The built-in example plugins. Each runs as a child process, like any other plugin: `vizflyt
//! plugin NAME`.

use std::process::ExitCode;

use clap::Args;
use vizflyt_grading::plugin::built_in::BuiltIn;
use vizflyt_scenes::projects::CourseProject;

/// Returns the default built-in plugin for a scene or a project of the course.
pub(crate) fn default_for(scene: &str) -> &'static str {
    let is_race = CourseProject::find(scene).map_or(scene == "race", |project| project.is_race());
    if is_race { "race" } else { "avoid" }
}

#[derive(Args, Debug)]
pub(crate) struct PluginArgs {
    name: BuiltIn,
    /// Shared memory of the runtime that started the plugin
    #[arg(long = "vizflyt-service", value_name = "PREFIX")]
    service: String,
}

/// Runs a built-in plugin in this process.
pub(crate) fn run(args: &PluginArgs) -> ExitCode {
    match args.name {
        BuiltIn::Avoid => vizflyt_sdk::attach(vizflyt_avoid::Avoid::default(), &args.service),
        BuiltIn::Race => vizflyt_sdk::attach(vizflyt_race::Race::default(), &args.service),
    }
}
