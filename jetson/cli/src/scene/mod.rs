//! `vizflyt scene`: makes, trains, bakes, inspects and renders scenes.

mod bake;
pub(crate) mod camera;
mod convert;
mod inspect;
mod npy;
mod render;
mod train;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use vizflyt_scenes::SceneKind;

use crate::terminal::{open_browser, print_fmt, print_line};

/// Makes, trains, bakes, inspects and renders scenes.
#[derive(Args, Debug)]
pub(crate) struct SceneArgs {
    #[command(subcommand)]
    command: SceneCommand,
}

#[derive(Subcommand, Debug)]
enum SceneCommand {
    /// Generates a scene with known geometry: scene.ply, arena.toml, truth.json.
    #[command(after_help = "Example:
  vizflyt scene generate forest --seed 7 -o my-forest
  vizflyt demo --scene my-forest")]
    Generate {
        #[arg(help = format!("What to generate: {}", SceneKind::names()))]
        kind: SceneKind,
        /// Same seed, same scene.
        #[arg(long, default_value_t = 7)]
        seed: u64,
        /// Folder to write to; made if absent.
        #[arg(short, long, value_name = "DIR")]
        output: PathBuf,
        /// Replaces a scene that is already there.
        #[arg(long)]
        force: bool,
    },
    Bake(bake::BakeArgs),
    Convert(convert::ConvertArgs),
    Inspect(inspect::InspectArgs),
    Render(render::RenderArgs),
    Train(train::TrainArgs),
    View(vizflyt_server::ViewArgs),
}

/// Runs `vizflyt scene`.
pub(crate) fn run(args: SceneArgs) -> Result<ExitCode> {
    match args.command {
        SceneCommand::Generate { kind, seed, output, force } => {
            generate(kind, seed, &output, force)?;
        }
        SceneCommand::Bake(args) => bake::run(&args)?,
        SceneCommand::Convert(args) => convert::run(&args)?,
        SceneCommand::Inspect(args) => inspect::run(&args)?,
        SceneCommand::Render(args) => render::run(&args)?,
        SceneCommand::Train(args) => train::run(&args)?,
        SceneCommand::View(args) => view(args)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn view(args: vizflyt_server::ViewArgs) -> Result<()> {
    let quiet = args.no_browser;
    vizflyt_server::web::view(args, |url, renderer| {
        print_line(format!("renderer    {} ({})", renderer.name, renderer.reason));
        print_line(format!("page        {url}"));
        if !quiet {
            open_browser(url);
        }
    })
}

fn generate(kind: SceneKind, seed: u64, output: &std::path::Path, force: bool) -> Result<()> {
    if output.join("arena.toml").exists() && !force {
        bail!(
            "{} already holds an arena.toml; give another folder, or --force to replace it",
            output.display()
        );
    }
    let scene = vizflyt_scenes::generate(kind, seed);
    let written = scene.write(output)?;
    print_fmt!("{} splats     {}", scene.splats.len(), written.scene.display());
    print_fmt!("arena             {}", written.arena.display());
    print_fmt!("{} true solids   {}", scene.truth.len(), written.truth.display());
    Ok(())
}
