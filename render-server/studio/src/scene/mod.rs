//! `vizflyt scene`: creates, captures, trains, edits, bakes, inspects, packs and renders scenes.

mod align;
mod bake;
pub mod camera;
mod capture;
mod carve;
mod convert;
mod edit;
mod events;
mod generate;
mod inspect;
mod npy;
mod pack;
mod progress;
mod render;
mod train;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Args, Subcommand};
pub use render::MEMORY_MIB;

use crate::page::show_page;

/// Make, train, edit, bake, inspect, pack and render scenes
#[derive(Args, Debug)]
pub struct SceneArgs {
    #[command(subcommand)]
    command: SceneCommand,
}

#[derive(Subcommand, Debug)]
enum SceneCommand {
    Generate(generate::GenerateArgs),
    Align(align::AlignArgs),
    Bake(bake::BakeArgs),
    Capture(capture::CaptureArgs),
    Carve(carve::CarveArgs),
    Convert(convert::ConvertArgs),
    // Boxed because it is large: it has an option for every kind of step.
    Edit(Box<edit::EditArgs>),
    Events(events::EventsArgs),
    Inspect(inspect::InspectArgs),
    Pack(pack::PackArgs),
    Render(render::RenderArgs),
    Train(train::TrainArgs),
    View(vizflyt_server::ViewArgs),
}

/// Runs `vizflyt scene`.
pub fn run(args: SceneArgs) -> Result<ExitCode> {
    match args.command {
        SceneCommand::Align(args) => return align::run(&args),
        SceneCommand::Capture(args) => return capture::run(&args),
        SceneCommand::Generate(args) => generate::run(&args)?,
        SceneCommand::Bake(args) => bake::run(&args)?,
        SceneCommand::Carve(args) => carve::run(&args)?,
        SceneCommand::Convert(args) => convert::run(&args)?,
        SceneCommand::Edit(args) => edit::run(&args)?,
        SceneCommand::Events(args) => events::run(&args)?,
        SceneCommand::Inspect(args) => inspect::run(&args)?,
        SceneCommand::Pack(args) => pack::run(&args)?,
        SceneCommand::Render(args) => render::run(&args)?,
        SceneCommand::Train(args) => train::run(&args)?,
        SceneCommand::View(args) => view(args)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn view(args: vizflyt_server::ViewArgs) -> Result<()> {
    let quiet = args.no_browser;
    vizflyt_server::web::view(args, show_page(quiet))
}
