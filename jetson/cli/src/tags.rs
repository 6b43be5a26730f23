//! `vizflyt tags`: localization by printed AprilTags.

mod calibrate;
mod locate;
mod print;
mod survey;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
use vizflyt_tags::family::TagFamily;

/// Localize by AprilTags: print, calibrate, survey, locate
#[derive(Args, Debug)]
#[command(after_help = "Steps:
  vizflyt tags print cube -o cube.pdf       cube for the vehicle; `print mat` for the floor
  vizflyt tags print board -o board.pdf     board for the calibration
  vizflyt tags calibrate /dev/video0 --board board.toml -o left.toml
  vizflyt tags survey mat walk.mp4 --camera left.toml --layout mat.toml -o room.toml
  vizflyt tags survey cameras left.toml right.toml --mat room.toml --cube cube.toml
  vizflyt tags locate lab.toml --to SERVER:PORT   send live poses to the render server")]
pub(crate) struct TagsArgs {
    #[command(subcommand)]
    command: TagsCommand,
}

#[derive(Subcommand, Debug)]
enum TagsCommand {
    Print(print::PrintArgs),
    Calibrate(calibrate::CalibrateArgs),
    Survey(survey::SurveyArgs),
    Locate(locate::LocateArgs),
}

/// Runs `vizflyt tags`.
pub(crate) fn run(args: &TagsArgs) -> Result<ExitCode> {
    match &args.command {
        TagsCommand::Print(args) => print::run(args)?,
        TagsCommand::Calibrate(args) => calibrate::run(args)?,
        TagsCommand::Survey(args) => survey::run(args)?,
        TagsCommand::Locate(args) => locate::run(args)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Parses the name of a tag family.
fn family(name: &str) -> Result<TagFamily, String> {
    TagFamily::from_name(name).ok_or_else(|| {
        format!("unknown tag family; known: {}", TagFamily::ALL.map(TagFamily::name).join(", "))
    })
}
