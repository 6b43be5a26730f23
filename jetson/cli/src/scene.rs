//! `vizflyt scene`: makes scenes.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use vizflyt_scenes::SceneKind;

/// Makes scenes.
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
        /// forest, race or room.
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
}

/// Runs `vizflyt scene`.
pub(crate) fn run(args: SceneArgs) -> Result<ExitCode> {
    let SceneCommand::Generate { kind, seed, output, force } = args.command;
    if output.join("arena.toml").exists() && !force {
        bail!(
            "{} already holds an arena.toml; give another folder, or --force to replace it",
            output.display()
        );
    }
    let scene = vizflyt_scenes::generate(kind, seed);
    let written = scene.write(&output)?;
    println!("{} splats     {}", scene.splats.len(), written.scene.display());
    println!("arena             {}", written.arena.display());
    println!("{} true solids   {}", scene.truth.len(), written.truth.display());
    Ok(ExitCode::SUCCESS)
}
