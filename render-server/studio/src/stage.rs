//! Finds or generates the place of a flight: arena file, spawn, and true geometry if known.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use glam::DVec3;
use tempfile::TempDir;
use tracing::warn;
use vizflyt_arena::ArenaConfig;
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_scenes::{Generated, SceneKind, Variant};
use vizflyt_server::scene::BareArgs;
use vizflyt_tags::print::Pad;

use crate::kept::{KeptScenes, SceneKey};

/// Selection of the place of a flight.
#[derive(Clone, Debug)]
pub struct Place<'a> {
    /// Name of a generated scene, or the path of a scene folder, an arena.toml or a scene file. With a project, its
    /// name.
    pub scene: &'a str,
    /// Project of the course, with its place, sensors and rules.
    pub project: Option<CourseProject>,
    /// Level of the project.
    pub level: Level,
    /// Light and weather of the project.
    pub variant: Variant,
    /// Light and weather of a generated scene or a scene file; `None`: unchanged.
    pub environment: Option<Variant>,
    /// Placement of a scene file in its room.
    pub bare: BareArgs,
    /// Seed of the generated place.
    pub seed: u64,
}

impl Place<'_> {
    /// Default seed.
    pub const SEED: u64 = 7;
}

/// A scene on disk, ready to be served.
pub struct Stage {
    /// The `arena.toml` for `vizflyt serve`.
    pub arena: PathBuf,
    /// File with the true geometry, if the scene was generated.
    pub truth: Option<PathBuf>,
    /// File with the map for plugins, if the course provides one.
    pub map: Option<PathBuf>,
    /// Start pose of the vehicle: `x,y,z,yaw_deg`. [m, world; deg]
    pub spawn: String,
    /// Corners of the fence. [m, world]
    pub fence_m: (DVec3, DVec3),
    /// Pads at the takeoff and at the goal.
    pub pads: Vec<Pad>,
    /// Whether the place depends on the seed.
    is_generated: bool,
    /// Temporary files of this flight.
    #[expect(dead_code, reason = "dropped with the stage, which removes them")]
    folder: Option<TempDir>,
}

impl Stage {
    /// Generates the place of the project or the named scene, or uses the one at a path.
    pub fn prepare(place: &Place<'_>) -> Result<Self> {
        let scene = place.scene;
        if let Some(generate) = generator(place) {
            ensure!(
                place.bare == BareArgs::default(),
                "--up and --scale are for a scene file: '{scene}' is generated upright and in metres"
            );
            let (generated, made_for_this) = generated_folder(place, generate)?;
            let stage = Self::at(generated.join("arena.toml"), made_for_this)?;
            return Ok(Self { is_generated: true, ..stage });
        }
        let path = Path::new(scene);
        if !path.exists() {
            bail!(
                "--scene '{scene}' is neither a generated scene ({}) nor an existing path; give one of the \
                 names, a folder with an arena.toml, or a scene file",
                SceneKind::names()
            );
        }
        let inside = path.join("arena.toml");
        let is_toml = path.extension().is_some_and(|extension| extension == "toml");
        if let Some(arena) = [inside, path.to_owned()].into_iter().find(|path| path.is_file())
            && (is_toml || path.is_dir())
        {
            place.bare.check_unused(&arena)?;
            ensure!(
                place.environment.is_none(),
                "--environment is for a generated scene or a scene file: set [environment] in {}",
                arena.display()
            );
            return Self::at(arena, None);
        }
        Self::around(path, place)
    }

    /// Creates a default arena for a scene file and writes it to a file, so that all processes use the same guesses.
    fn around(scene: &Path, place: &Place<'_>) -> Result<Self> {
        let mut arena = vizflyt_server::scene::load(scene, &place.bare)?.arena;
        let file =
            scene.canonicalize().with_context(|| format!("cannot resolve {}", scene.display()))?;
        arena.scene.file = file.to_string_lossy().into_owned();
        if let Some(variant) = place.environment {
            arena.environment = variant.environment();
        }
        let folder = folder()?;
        let path = folder.path().join("arena.toml");
        std::fs::write(&path, arena.to_toml()?)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Self::at(path, Some(folder))
    }

    /// Returns the suffix with the seed for printing; empty if the place does not depend on it.
    pub fn seeded(&self, seed: u64) -> String {
        if self.is_generated { format!(", seed {seed}") } else { String::new() }
    }

    fn at(arena: PathBuf, folder: Option<TempDir>) -> Result<Self> {
        let text = std::fs::read_to_string(&arena)
            .with_context(|| format!("cannot read {}", arena.display()))?;
        let config =
            ArenaConfig::parse(&text).with_context(|| format!("in {}", arena.display()))?;
        let truth = Some(arena.with_file_name("truth.json")).filter(|path| path.exists());
        let map = Some(arena.with_file_name("map.json")).filter(|path| path.exists());
        let (spawn, fence_m, pads) = (spawn(&config), fence_m(&config), pads(&config));
        Ok(Self { arena, truth, map, spawn, fence_m, pads, is_generated: false, folder })
    }
}

/// Returns the generator of the place, or `None` if it is a path.
fn generator<'a>(place: &'a Place<'_>) -> Option<Box<dyn Fn() -> Generated + 'a>> {
    if let Some(project) = &place.project {
        return Some(Box::new(move || project.generate(place.seed, place.level, place.variant)));
    }
    let kind: SceneKind = place.scene.parse().ok()?;
    Some(Box::new(move || {
        let mut generated = vizflyt_scenes::generate(kind, place.seed);
        if let Some(variant) = place.environment {
            generated.arena.environment = variant.environment();
        }
        generated
    }))
}

/// Returns the folder of a generated place, from the cache or generated now. If it could not be cached, also returns
/// the guard that removes the folder after the flight.
fn generated_folder(
    place: &Place<'_>,
    generate: impl Fn() -> Generated,
) -> Result<(PathBuf, Option<TempDir>)> {
    let make = |folder: &Path| -> Result<()> {
        generate().write(folder)?;
        Ok(())
    };
    let what = (place.scene, place.seed, place.level, place.variant, place.environment);
    let rules = place.project.as_ref().map(|project| project.text().to_owned());
    let key = SceneKey::of(&[&format!("{what:?}"), &rules.unwrap_or_default()]);
    if let Some((scenes, key)) = KeptScenes::of_user().zip(key) {
        match scenes.get(&key, make) {
            Ok(kept) => return Ok((kept, None)),
            Err(error) => warn!("the generated scene is not kept: {error:#}"),
        }
    }
    let folder = folder()?;
    make(folder.path())?;
    Ok((folder.path().to_owned(), Some(folder)))
}

fn folder() -> Result<TempDir> {
    tempfile::Builder::new()
        .prefix("vizflyt-lab-")
        // Other users of this computer must not read the true geometry.
        .permissions(Permissions::from_mode(0o700))
        .tempdir()
        .context("cannot make a folder for the scene")
}

fn fence_m(arena: &ArenaConfig) -> (DVec3, DVec3) {
    (arena.geofence.min_m, arena.geofence.max_m)
}

/// Returns the pads that a mat needs: one at the spawn, and one as long as the goal is wide, because the vehicle brakes
/// in the goal.
fn pads(arena: &ArenaConfig) -> Vec<Pad> {
    let start = Pad { middle_m: arena.spawn.position_m.truncate(), size_m: Pad::SIZE_M };
    let end = arena.goal.as_ref().map(|goal| Pad {
        middle_m: goal.position_m.truncate(),
        size_m: Pad::SIZE_M.with_x(2.0 * goal.radius_m),
    });
    std::iter::once(start).chain(end).collect()
}

/// Returns the start pose in the format of `vizflyt sim --spawn`.
fn spawn(arena: &ArenaConfig) -> String {
    let p = arena.spawn.position_m;
    format!("{},{},{},{}", p.x, p.y, p.z, arena.spawn.yaw_deg)
}
