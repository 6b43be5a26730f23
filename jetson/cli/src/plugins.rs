//! The built-in example plugins. One runs as a child process like any other: `vizflyt plugin NAME`.

use std::process::ExitCode;

use clap::{Args, ValueEnum};
use vizflyt_scenes::projects::CourseProject;

/// A plugin that is linked into this program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum BuiltIn {
    /// Flies to the goal through obstacles, by a potential field on the depth image.
    Avoid,
    /// Flies windows, a gap and a rotating hand from images alone.
    Race,
}

impl BuiltIn {
    /// Returns the names of all, as the command line takes them.
    pub(crate) fn names() -> String {
        let values = Self::value_variants().iter().filter_map(ValueEnum::to_possible_value);
        values.map(|value| value.get_name().to_owned()).collect::<Vec<_>>().join(", ")
    }
}

/// Whether a plugin of this name is linked into this program.
pub(crate) fn is_built_in(name: &str) -> bool {
    !name.contains('/') && BuiltIn::from_str(name, true).is_ok()
}

/// Returns the built-in that flies a scene or a project of the course.
pub(crate) fn default_for(scene: &str) -> &'static str {
    let is_race = CourseProject::find(scene).map_or(scene == "race", |project| project.is_race());
    if is_race { "race" } else { "avoid" }
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
        BuiltIn::Race => vizflyt_sdk::attach(vizflyt_race::Race::default(), &args.service),
    }
}
