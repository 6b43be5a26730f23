//! Finds or makes what is flown in: an arena file, the spawn, and the truth if known.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use glam::DVec3;
use tempfile::TempDir;
use vizflyt_arena::ArenaConfig;
use vizflyt_scenes::SceneKind;
use vizflyt_server::scene::Up;
use vizflyt_tags::print::Pad;

use super::LabArgs;

/// A scene on disk, ready to be served.
pub(crate) struct Stage {
    /// What `vizflyt serve` is given: an `arena.toml`, or a bare scene.
    pub arena: PathBuf,
    /// True geometry, where the scene was generated.
    pub truth: Option<PathBuf>,
    /// The map that plugins may know, where it is known.
    pub map: Option<PathBuf>,
    /// Where the vehicle stands: `x,y,z,yaw_deg`. [m, world; deg]
    pub spawn: String,
    /// Corners of the fence. [m, world]
    pub fence_m: (DVec3, DVec3),
    /// Where it takes off, and where the flight ends.
    pub pads: Vec<Pad>,
    /// Holds generated files until the flight ends.
    folder: Option<TempDir>,
}

impl Stage {
    /// Generates the project's place or the named scene, or takes the one at a path.
    pub(crate) fn prepare(lab: &LabArgs) -> Result<Self> {
        let (scene, seed) = (lab.scene(), lab.seed());
        let generated = match (lab.project(), scene.parse::<SceneKind>()) {
            (Some(project), _) => Some(project.generate(seed, lab.level(), lab.variant())),
            (None, Ok(kind)) => Some(vizflyt_scenes::generate(kind, seed)),
            (None, Err(_)) => None,
        };
        if let Some(generated) = generated {
            let folder = tempfile::Builder::new()
                .prefix("vizflyt-lab-")
                // What is true of it is not for others on this computer.
                .permissions(Permissions::from_mode(0o700))
                .tempdir()
                .context("cannot make a folder for the generated scene")?;
            let written = generated.write(folder.path())?;
            return Self::at(written.arena, Some(folder));
        }
        let path = Path::new(scene);
        if !path.exists() {
            bail!(
                "--scene '{scene}' is no generated scene ({}) and no path that exists; give one of the \
                 names, a folder with an arena.toml, or a scene file",
                SceneKind::names()
            );
        }
        if path.join("arena.toml").is_file() {
            return Self::at(path.join("arena.toml"), None);
        }
        if path.extension().is_some_and(|extension| extension == "toml") {
            return Self::at(path.to_owned(), None);
        }
        // A bare scene: the server turns it upright and assumes an arena around it.
        let arena = vizflyt_server::scene::load(path, Up::default(), None)?.arena;
        Ok(Self {
            arena: path.to_owned(),
            truth: None,
            map: None,
            spawn: spawn(&arena),
            fence_m: fence_m(&arena),
            pads: pads(&arena),
            folder: None,
        })
    }

    /// Returns what the seed changed, to be printed behind its name.
    pub(crate) fn seeded(&self, seed: u64) -> String {
        self.folder.as_ref().map_or(String::new(), |_| format!(", seed {seed}"))
    }

    fn at(arena: PathBuf, folder: Option<TempDir>) -> Result<Self> {
        let text = std::fs::read_to_string(&arena)
            .with_context(|| format!("cannot read {}", arena.display()))?;
        let config =
            ArenaConfig::parse(&text).with_context(|| format!("in {}", arena.display()))?;
        let truth = Some(arena.with_file_name("truth.json")).filter(|path| path.exists());
        let map = Some(arena.with_file_name("map.json")).filter(|path| path.exists());
        let (spawn, fence_m, pads) = (spawn(&config), fence_m(&config), pads(&config));
        Ok(Self { arena, truth, map, spawn, fence_m, pads, folder })
    }
}

fn fence_m(arena: &ArenaConfig) -> (DVec3, DVec3) {
    (arena.geofence.min_m, arena.geofence.max_m)
}

/// Returns where a mat needs pads: at the spawn, and as long as the goal is wide, for a vehicle brakes in it.
fn pads(arena: &ArenaConfig) -> Vec<Pad> {
    let start = Pad { middle_m: arena.spawn.position_m.truncate(), size_m: Pad::SIZE_M };
    let end = arena.goal.as_ref().map(|goal| Pad {
        middle_m: goal.position_m.truncate(),
        size_m: Pad::SIZE_M.with_x(2.0 * goal.radius_m),
    });
    std::iter::once(start).chain(end).collect()
}

/// Returns where the vehicle stands, as `vizflyt sim --spawn` reads it.
fn spawn(arena: &ArenaConfig) -> String {
    let p = arena.spawn.position_m;
    format!("{},{},{},{}", p.x, p.y, p.z, arena.spawn.yaw_deg)
}
