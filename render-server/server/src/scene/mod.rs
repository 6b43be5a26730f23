//! From a path on the command line to everything the flight needs of the twin.
//!
//! ```text
//! arena.toml -> ArenaConfig -> its scene file -> Splats --------> renderer
//! scene.ply  -> upright, to size -> ArenaConfig (made up)   \---> occupancy -> referee, map
//! ```
//! Once, at the start; progress goes to the log.

mod bake;
mod bare;
mod orient;

pub use bake::bake;
pub use bare::{align, default_arena};
pub use orient::{Up, WorldFromScene};

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use tracing::{info, warn};
use vizflyt_arena::ArenaConfig;
use vizflyt_splat::{Splats, ply};

/// A loaded twin.
#[derive(Debug)]
pub struct Scene {
    /// The room and its rules.
    pub arena: ArenaConfig,
    /// The twin. [m, world]
    pub splats: Splats,
}

/// Reads an arena with its scene, or a bare scene, which is then put upright and to size.
pub fn load(path: &Path, up: Up, scale: Option<f64>) -> Result<Scene> {
    if !path.exists() {
        bail!(
            "there is no {}; make a scene with: vizflyt scene generate forest -o forest",
            path.display()
        );
    }
    if path.is_dir() {
        let inside = path.join("arena.toml");
        if inside.is_file() {
            return load(&inside, up, scale);
        }
        bail!("{} is a folder without an arena.toml", path.display());
    }
    let extension = path.extension().map(OsStr::to_ascii_lowercase);
    match extension.as_deref().and_then(OsStr::to_str) {
        Some("toml") => with_arena(path),
        Some("ply") => Ok(without_arena(path, up, scale)?),
        _ => bail!("{} is neither an arena (.toml) nor a scene (.ply)", path.display()),
    }
}

fn with_arena(path: &Path) -> Result<Scene> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let arena =
        ArenaConfig::parse(&text).with_context(|| format!("{} is wrong", path.display()))?;
    let scene = arena.scene_path(path);
    if !scene.is_file() {
        bail!(
            "{} names the scene '{}', but there is no {}; generate it, or correct `scene`",
            path.display(),
            arena.scene,
            scene.display()
        );
    }
    Ok(Scene { splats: read(&scene)?, arena })
}

fn without_arena(path: &Path, up: Up, scale: Option<f64>) -> Result<Scene> {
    let mut splats = read(path)?;
    let world_from_scene = align(&splats, up, scale);
    world_from_scene.apply(&mut splats);
    let file = path.file_name().map_or_else(|| path.to_owned(), PathBuf::from);
    let arena = default_arena(&splats, &file);
    info!(
        "{} has no arena: made one up, {:.3} m per unit{}, start at {}",
        path.display(),
        world_from_scene.scale,
        if scale.is_none() { " (a guess; set --scale and --up)" } else { "" },
        arena.spawn.position_m
    );
    Ok(Scene { arena, splats })
}

fn read(path: &Path) -> Result<Splats> {
    let start = Instant::now();
    let loaded = ply::read(path).with_context(|| format!("cannot use scene {}", path.display()))?;
    let dropped = loaded.dropped.total();
    if dropped > 0 {
        warn!("{}: {dropped} faulty splats left out: {:?}", path.display(), loaded.dropped);
    }
    info!(
        "{}: {} splats in {:.0} ms",
        path.display(),
        loaded.splats.len(),
        start.elapsed().as_secs_f64() * 1e3
    );
    Ok(loaded.splats)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};

    fn check(path: &Path, expected: &str) {
        let error = format!("{:#}", load(path, Up::default(), None).unwrap_err());
        assert!(error.contains(expected), "'{error}' lacks '{expected}'");
    }

    fn dot() -> Splats {
        Splats {
            means_m: vec![Vec3::new(1.0, 2.0, 3.0)],
            scales_m: vec![Vec3::splat(0.1)],
            rotations: vec![Quat::IDENTITY],
            opacities: vec![0.9],
            sh_degree: 0,
            sh: vec![0.5; 3],
        }
    }

    #[test]
    fn what_is_missing_or_wrong_is_named_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        check(&at("nothing.toml"), "make a scene with: vizflyt scene generate");
        check(folder.path(), "is a folder without an arena.toml");
        std::fs::write(at("notes.txt"), "x").unwrap();
        check(&at("notes.txt"), "is neither an arena (.toml) nor a scene (.ply)");
        std::fs::write(at("bad.toml"), "name = 3").unwrap();
        check(&at("bad.toml"), "bad.toml is wrong");
        std::fs::write(at("bad.ply"), "ply\nformat nonsense\n").unwrap();
        check(&at("bad.ply"), "cannot use scene");
        let empty = Splats { sh_degree: 0, ..Splats::default() };
        ply::write(at("empty.ply"), &empty).unwrap();
        check(&at("empty.ply"), "empty.ply: no splats");
        let arena = default_arena(&dot(), Path::new("gone.ply"));
        std::fs::write(at("arena.toml"), arena.to_toml().unwrap()).unwrap();
        check(&at("arena.toml"), "names the scene 'gone.ply', but there is no");
    }

    #[test]
    fn an_arena_and_a_bare_scene_load() {
        let folder = tempfile::tempdir().unwrap();
        ply::write(folder.path().join("dot.ply"), &dot()).unwrap();
        let arena = default_arena(&dot(), Path::new("dot.ply"));
        std::fs::write(folder.path().join("arena.toml"), arena.to_toml().unwrap()).unwrap();
        let scene = load(folder.path(), Up::default(), None).unwrap();
        assert_eq!(scene.arena, arena);
        // An arena's scene lies in the world already: it is not moved.
        assert!((scene.splats.means_m[0] - Vec3::new(1.0, 2.0, 3.0)).length() < 1e-6);
        let bare = load(&folder.path().join("dot.ply"), Up::Z, Some(1.0)).unwrap();
        assert!(bare.splats.means_m[0].length() < 1e-6, "its floor is z = 0");
    }
}
