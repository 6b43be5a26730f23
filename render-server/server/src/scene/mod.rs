//! Loading of a twin from a path on the command line.
//!
//! ```text
//! arena.toml --> ArenaConfig ------------> [scene]: file, placement -> Splats --> renderer
//! scene file --> ArenaConfig (default) -/                                  \---> occupancy -> referee, map
//! scene.ply.seen -----------------------> space seen by the capture, if needed --/
//! ```
//! Splats are placed only here: every loaded scene is in the world frame. A scene file may have any format of
//! [`vizflyt_splat::format`], recognised by its content. Loading happens once, at the start; progress is
//! logged.

mod antialiased;
mod bake;
mod bare;
mod choose;
mod core;
mod edit;
mod fit;
mod floor;
mod models;
mod objects;
mod packed;
mod parts;
mod placement;
mod seen;

pub use antialiased::Antialiased;
pub use bake::{BakeCache, BakeKey, Baked, bake, bake_with, parse_kept};
pub use bare::{BareArgs, default_arena, parse_scale, place};
pub use choose::Scenes;
pub use core::{bounds, core};
pub use edit::{DoneStep, EditList, EditListError, Editor, list_path, read_list, result_path};
pub use fit::check_fit;
pub use models::model;
pub(crate) use objects::bake_object;
pub use objects::{bounds_m, obstacles};
pub use packed::placed;
pub use parts::{BoxedPart, PartsFile, parts_path};
pub use placement::{Placement, WorldFromScene};
pub use seen::{Seen, scene_hash, seen_path, write_seen};
pub use vizflyt_arena::config::Up;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use tracing::{info, warn};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_splat::format::{self, Loaded, Progress};
use vizflyt_splat::{PackedScene, RigidObject, Splats};

/// Loaded twin.
#[derive(Debug)]
pub struct Scene {
    pub arena: ArenaConfig,
    /// Splats of the twin. [m, world]
    pub splats: Splats,
    /// Moving objects, in the arena's order. [m, object]
    pub objects: Vec<RigidObject>,
    /// Transform from the frame of `CAM.json` files: the world in an arena; for a bare scene, its file's frame.
    pub world_from_scene: WorldFromScene,
    /// Space seen by the capture, if the arena treats all other space as solid.
    pub seen: Option<Seen>,
    /// The complete twin as a packed file; `splats` are then only those near the fence.
    pub packed: Option<PathBuf>,
}

/// Kind of a path on the command line.
enum Named {
    Arena(PathBuf),
    Scene(PathBuf),
}

/// Loads an arena with its scene, or a bare scene with a default arena.
///
/// # Errors
/// Files that cannot be read or used; `bare` options for a scene that an arena places.
pub fn load(path: &Path, bare: &BareArgs) -> Result<Scene> {
    match named(path)? {
        Named::Arena(path) => {
            bare.check_unused(&path)?;
            with_arena(&path)
        }
        Named::Scene(path) => without_arena(&path, bare),
    }
}

/// Loads like [`load`], but also accepts an arena with a packed scene, which is rendered from the disk.
///
/// # Errors
/// As [`load`], or too many splats near the fence for the memory.
pub fn load_to_fly(path: &Path, bare: &BareArgs) -> Result<Scene> {
    if let Named::Arena(path) = named(path)? {
        let (arena, scene) = parse_arena(&path)?;
        if PackedScene::is_packed(&scene) {
            bare.check_unused(&path)?;
            return packed::near(arena, &path, scene);
        }
    }
    load(path, bare)
}

/// Loads like [`load`], with these splats instead of those in the scene's file.
///
/// # Errors
/// As [`load`].
pub fn load_with(path: &Path, bare: &BareArgs, splats: Splats) -> Result<Scene> {
    match named(path)? {
        Named::Arena(path) => {
            bare.check_unused(&path)?;
            let (arena, _) = parse_arena(&path)?;
            // The seen space belongs to the scene's own file.
            in_arena(arena, &path, splats, None)
        }
        Named::Scene(path) => in_the_open(&path, bare, splats),
    }
}

/// Returns the scene file of a path: an arena's, or the path itself.
///
/// # Errors
/// The file does not exist.
pub fn scene_file(path: &Path) -> Result<PathBuf> {
    match named(path)? {
        Named::Arena(path) => Ok(parse_arena(&path)?.1),
        Named::Scene(path) => Ok(path),
    }
}

/// Reads the splats for `CAM.json` cameras: an arena's scene in the world frame, or a scene file without
/// rotation and scale. Returns the file's path with its contents.
///
/// # Errors
/// Files that cannot be read or used.
pub fn load_as_it_is(path: &Path) -> Result<(PathBuf, Loaded)> {
    match named(path)? {
        Named::Arena(path) => {
            let (arena, scene) = parse_arena(&path)?;
            let mut loaded = read(&scene)?;
            put(&arena, &mut loaded.splats)?;
            Ok((scene, loaded))
        }
        Named::Scene(path) => {
            let loaded = read(&path)?;
            Ok((path, loaded))
        }
    }
}

/// Reads the moving objects of an arena, with phases from the seed if its file sets none; empty for a bare
/// scene.
pub fn load_objects(path: &Path, seed: u64) -> Result<(Vec<RigidObject>, MovingObjects)> {
    match named(path)? {
        Named::Arena(path) => {
            let (arena, _) = parse_arena(&path)?;
            Ok((read_objects(&arena, &path)?, MovingObjects::new(&arena, seed)))
        }
        Named::Scene(_) => Ok((Vec::new(), MovingObjects::default())),
    }
}

/// Returns the path and the text of an `arena.toml`, given the file or its folder; `None` for a bare scene.
pub(crate) fn arena_text(path: &Path) -> Result<Option<(PathBuf, String)>> {
    match named(path)? {
        Named::Arena(path) => {
            let text = read_text(&path)?;
            Ok(Some((path, text)))
        }
        Named::Scene(_) => Ok(None),
    }
}

fn read_text(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// Returns whether a path is an arena, so that its scene is in metres.
pub fn is_in_an_arena(path: &Path) -> bool {
    matches!(named(path), Ok(Named::Arena(_)))
}

fn named(path: &Path) -> Result<Named> {
    if !path.exists() {
        bail!(
            "there is no {}; make a scene with: vizflyt scene generate forest -o forest",
            path.display()
        );
    }
    if path.is_dir() {
        let inside = path.join("arena.toml");
        if inside.is_file() {
            return Ok(Named::Arena(inside));
        }
        // Unpacked SOG, or a streamed one.
        if ["meta.json", "lod-meta.json"].iter().any(|name| path.join(name).is_file()) {
            return Ok(Named::Scene(path.to_owned()));
        }
        bail!(
            "{} is a folder without an arena.toml; give the folder that contains it, or make one: \
             vizflyt arena new DIR --scene FILE",
            path.display()
        );
    }
    let is_toml = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml"));
    Ok(if is_toml { Named::Arena(path.to_owned()) } else { Named::Scene(path.to_owned()) })
}

fn read_arena(path: &Path) -> Result<ArenaConfig> {
    ArenaConfig::parse(&read_text(path)?).with_context(|| format!("{} is wrong", path.display()))
}

/// Returns an arena and the path of its scene.
fn parse_arena(path: &Path) -> Result<(ArenaConfig, PathBuf)> {
    let arena = read_arena(path)?;
    let scene = arena.scene_path(path);
    if !scene.exists() {
        bail!(
            "{} names the scene '{}', but there is no {}; generate it, or correct `scene`",
            path.display(),
            arena.scene.file,
            scene.display()
        );
    }
    Ok((arena, scene))
}

fn with_arena(path: &Path) -> Result<Scene> {
    let (arena, scene) = parse_arena(path)?;
    let seen = seen::read(&arena, &scene)?;
    let splats = read(&scene)?.splats;
    in_arena(arena, path, splats, seen)
}

fn in_arena(
    arena: ArenaConfig,
    path: &Path,
    mut splats: Splats,
    seen: Option<Seen>,
) -> Result<Scene> {
    let objects = read_objects(&arena, path)?;
    put(&arena, &mut splats)?;
    let world_from_scene = WorldFromScene::IDENTITY;
    Ok(Scene { splats, arena, objects, world_from_scene, seen, packed: None })
}

/// Transforms and crops splats as the arena requires, and sets their anti-aliasing.
fn put(arena: &ArenaConfig, splats: &mut Splats) -> Result<()> {
    splats.antialiased = arena.scene.antialiased.unwrap_or(splats.antialiased);
    let cropped = Placement::of(&arena.scene).apply(splats);
    if cropped > 0 {
        info!("{}: {cropped} splats lie outside scene.crop and are left out", arena.scene.file);
    }
    if splats.is_empty() {
        bail!(
            "all {cropped} splats of {} lie outside scene.crop; it is in metres of the world: correct \
             it, or the scene's up, metres_per_unit and origin",
            arena.scene.file
        );
    }
    Ok(())
}

fn read_objects(arena: &ArenaConfig, arena_toml: &Path) -> Result<Vec<RigidObject>> {
    objects::read_all(arena, arena_toml, |path| Ok(read(path)?.splats))
}

fn without_arena(path: &Path, bare: &BareArgs) -> Result<Scene> {
    in_the_open(path, bare, read(path)?.splats)
}

fn in_the_open(path: &Path, bare: &BareArgs, mut splats: Splats) -> Result<Scene> {
    let file = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy();
    let scene = place(&splats, &file, bare);
    let world_from_scene = Placement::of(&scene).world_from_scene;
    world_from_scene.apply(&mut splats);
    let cannot = || format!("cannot use {} without an arena", path.display());
    let arena = default_arena(&splats, scene).with_context(cannot)?;
    let size_m = arena.geofence.max_m - arena.geofence.min_m;
    info!(
        "{} has no arena: using a default of {size_m:.1} m, start at {}",
        path.display(),
        arena.spawn.position_m
    );
    if let Some(guessed) = bare.guessed(&arena.scene) {
        warn!("{} has no arena, so this is guessed: {guessed}", path.display());
    }
    Ok(Scene { arena, splats, objects: Vec::new(), world_from_scene, seen: None, packed: None })
}

/// Reads the splats of a file of any format.
pub(crate) fn read_splats(path: &Path) -> Result<Splats> {
    Ok(read(path)?.splats)
}

/// Reads a scene file of any format; the progress of a long read is logged.
fn read(path: &Path) -> Result<Loaded> {
    let start = Instant::now();
    let mut logged_at = start;
    let mut log_progress = |at: Progress| {
        if logged_at.elapsed() >= LOG_PERIOD && at.done < at.total {
            logged_at = Instant::now();
            info!("{}: {:.0} % read", path.display(), 100.0 * at.done as f64 / at.total as f64);
        }
    };
    let loaded = format::read_with_progress(path, &mut log_progress)
        .with_context(|| format!("cannot use scene {}", path.display()))?;
    let dropped = loaded.dropped.total();
    if dropped > 0 {
        warn!("{}: {dropped} faulty splats left out: {:?}", path.display(), loaded.dropped);
    }
    info!(
        "{}: {}, {} splats in {:.0} ms",
        path.display(),
        loaded.format,
        loaded.splats.len(),
        start.elapsed().as_secs_f64() * 1e3
    );
    Ok(loaded)
}

/// Interval of the progress.
const LOG_PERIOD: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use vizflyt_splat::ply;

    fn check(path: &Path, expected: &str) {
        let error = format!("{:#}", load(path, &BareArgs::default()).unwrap_err());
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
            antialiased: false,
        }
    }

    #[test]
    fn errors_of_missing_and_wrong_files_give_advice() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        check(&at("nothing.toml"), "make a scene with: vizflyt scene generate");
        check(folder.path(), "is a folder without an arena.toml");
        std::fs::create_dir(at("streamed")).unwrap();
        std::fs::write(at("streamed/lod-meta.json"), "{}").unwrap();
        check(&at("streamed"), "SOG, lod-meta.json");
        std::fs::write(at("notes.txt"), "x").unwrap();
        check(&at("notes.txt"), "supported are");
        std::fs::write(at("bad.toml"), "name = 3").unwrap();
        check(&at("bad.toml"), "bad.toml is wrong");
        std::fs::write(at("bad.ply"), "ply\nformat nonsense\n").unwrap();
        check(&at("bad.ply"), "cannot use scene");
        let empty = Splats { sh_degree: 0, ..Splats::default() };
        ply::write(at("empty.ply"), &empty).unwrap();
        check(&at("empty.ply"), "empty.ply: no splats");
        let arena = default_arena(&dot(), "gone.ply").unwrap();
        std::fs::write(at("arena.toml"), arena.to_toml().unwrap()).unwrap();
        check(&at("arena.toml"), "names the scene 'gone.ply', but there is no");
    }

    #[test]
    fn a_predefined_model_needs_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path().join("arena.toml");
        ply::write(folder.path().join("dot.ply"), &dot()).unwrap();
        let arena = default_arena(&dot(), "dot.ply").unwrap().to_toml().unwrap();
        for (file, expected) in [("models/gate-100x100.ply", 1), ("models/gat-1x1.ply", 0)] {
            let object = "[[objects]]\nname = \"frame\"\nposition_m = [0.0, 0.0, 1.0]\nscene =";
            std::fs::write(&at, format!("{arena}\n{object} \"{file}\"\n")).unwrap();
            if expected == 0 {
                check(&at, "or name a predefined model such as models/gate-120x100.ply");
            } else {
                let scene = load(&at, &BareArgs::default()).unwrap();
                assert_eq!(scene.objects[0].splats, model(file).unwrap());
            }
        }
    }

    #[test]
    fn the_arena_overrides_the_files_anti_aliasing() {
        let folder = tempfile::tempdir().unwrap();
        // Our PLY files do not state it; the comment of brush does.
        let at = |name: &str| folder.path().join(name);
        ply::write(at("classic.ply"), &dot()).unwrap();
        let text = std::fs::read(at("classic.ply")).unwrap();
        let head = text.iter().position(|byte| *byte == b'\n').unwrap() + 1;
        let mut mip = text[..head].to_vec();
        let line = text[head..].iter().position(|byte| *byte == b'\n').unwrap() + head + 1;
        mip.extend(&text[head..line]);
        mip.extend(b"comment SplatRenderMode: mip\n");
        mip.extend(&text[line..]);
        std::fs::write(at("mip.ply"), mip).unwrap();
        for (file, says) in [("classic.ply", false), ("mip.ply", true)] {
            for (key, expected) in [(None, says), (Some(true), true), (Some(false), false)] {
                let mut arena = default_arena(&dot(), file).unwrap();
                arena.scene.antialiased = key;
                std::fs::write(at("arena.toml"), arena.to_toml().unwrap()).unwrap();
                let scene = load(folder.path(), &BareArgs::default()).unwrap();
                assert_eq!(scene.splats.antialiased, expected, "{file}, {key:?}");
                let (_, as_it_is) = load_as_it_is(folder.path()).unwrap();
                assert_eq!(as_it_is.splats.antialiased, expected, "{file}, {key:?}");
            }
        }
    }

    #[test]
    fn an_arena_and_a_bare_scene_load() {
        let folder = tempfile::tempdir().unwrap();
        ply::write(folder.path().join("dot.ply"), &dot()).unwrap();
        let arena = default_arena(&dot(), "dot.ply").unwrap();
        std::fs::write(folder.path().join("arena.toml"), arena.to_toml().unwrap()).unwrap();
        let scene = load(folder.path(), &BareArgs::default()).unwrap();
        assert_eq!(scene.arena, arena);
        // An arena's scene is already in the world frame: it is not moved.
        assert!((scene.splats.means_m[0] - Vec3::new(1.0, 2.0, 3.0)).length() < 1e-6);
        let z = BareArgs { up: Some(Up::Z), scale: Some(1.0) };
        let bare = load(&folder.path().join("dot.ply"), &z).unwrap();
        assert!(bare.splats.means_m[0].length() < 1e-6, "its floor is z = 0");
    }
}
