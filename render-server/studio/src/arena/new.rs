//! `vizflyt arena new`: writes an `arena.toml` for a captured scene, with a fence and a start to be edited.

use std::path::{Component, Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use vizflyt_arena::ArenaConfig;
use vizflyt_process::print_fmt;
use vizflyt_scenes::Variant;
use vizflyt_server::scene::{self, BareArgs, is_in_an_arena};

/// Write an arena.toml for a scene file
///
/// Sets the placement of the scene, a fence around its core, and a start with a view.
#[derive(Args, Debug)]
#[command(
    after_help = "The scene file stays in its place. Edit the arena.toml, then view and check it:
  vizflyt scene view my-arena
  vizflyt arena check my-arena
  vizflyt demo --scene my-arena

Example:
  vizflyt arena new my-arena --scene room.ply --up -y --scale 0.176"
)]
pub(super) struct NewArgs {
    /// Folder for arena.toml; created if missing
    folder: PathBuf,
    /// Scene file: .ply, .compressed.ply, .splat, .spz, .sog, .ksplat
    #[arg(long, help_heading = "Scene", value_name = "FILE")]
    scene: PathBuf,
    #[command(flatten)]
    bare: BareArgs,
    /// Light and weather
    #[arg(long, help_heading = "Scene", value_name = "NAME", default_value_t, long_help = format!(
        "Light and weather: {}", Variant::names()
    ))]
    environment: Variant,
    /// Replace an existing arena.toml
    #[arg(long, help_heading = "Output")]
    force: bool,
}

/// Runs `vizflyt arena new`.
pub(super) fn run(args: &NewArgs) -> Result<()> {
    let path = args.folder.join("arena.toml");
    ensure!(
        args.force || !path.exists(),
        "{} already exists; give another folder, or --force to replace it",
        path.display()
    );
    if is_in_an_arena(&args.scene) {
        bail!("{} is an arena already; --scene takes a scene file", args.scene.display());
    }
    let loaded = scene::load(&args.scene, &args.bare)?;
    let mut arena = loaded.arena;
    arena.environment = args.environment.environment();
    std::fs::create_dir_all(&args.folder)
        .with_context(|| format!("cannot make the folder {}", args.folder.display()))?;
    arena.scene.file = from_folder(&args.folder, &args.scene)?;
    let text = format!("{HEAD}{}", arena.to_toml()?);
    ArenaConfig::parse(&text).context("the arena would not be read again")?;
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    let (scene, fence, p_m) = (&arena.scene, &arena.geofence, arena.spawn.position_m);
    let size_m = fence.max_m - fence.min_m;
    print_fmt!("arena       {}", path.display());
    print_fmt!("scene       {}: {} splats", scene.file, loaded.splats.len());
    let up = scene.up.map_or("z", |up| up.name());
    print_fmt!("placed      {up} is up, {} m per unit", scene.metres_per_unit);
    print_fmt!("fence       {:.2} x {:.2} x {:.2} m", size_m.x, size_m.y, size_m.z);
    print_fmt!(
        "start       {:.2}, {:.2}, {:.2}, {} degrees",
        p_m.x,
        p_m.y,
        p_m.z,
        arena.spawn.yaw_deg
    );
    print_fmt!("next        vizflyt arena check {}", args.folder.display());
    Ok(())
}

/// Returns the relative path from an existing folder to an existing file.
fn from_folder(folder: &Path, file: &Path) -> Result<String> {
    let real = |path: &Path| {
        path.canonicalize().with_context(|| format!("cannot resolve {}", path.display()))
    };
    let way = way(&real(folder)?, &real(file)?);
    let text = way.to_str().with_context(|| {
        format!(
            "the path {} is not valid UTF-8, which arena.toml requires; rename the file",
            way.display()
        )
    })?;
    Ok(text.to_owned())
}

/// Returns the relative path from one absolute path to another.
fn way(folder: &Path, file: &Path) -> PathBuf {
    let shared = folder.components().zip(file.components()).take_while(|(a, b)| a == b).count();
    let up = folder.components().skip(shared).map(|_| Component::ParentDir);
    up.chain(file.components().skip(shared)).collect()
}

const HEAD: &str = "\
# Written by `vizflyt arena new`. [scene] places the file in the world; the fence surrounds its core.
# Correct the guessed values (a door is 2 m high), then edit the course: `vizflyt arena edit`, or by hand: docs/guides/arena-reference.md.
";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn computes_relative_paths() {
        let check = |folder: &str, file: &str, expected: &str| {
            assert_eq!(way(Path::new(folder), Path::new(file)), Path::new(expected));
        };
        check("/a/b", "/a/b/room.ply", "room.ply");
        check("/a/b", "/a/room.ply", "../room.ply");
        check("/a/b/c", "/a/x/room.ply", "../../x/room.ply");
        check("/a", "/b/room.ply", "../b/room.ply");
    }
}
