//! Finds or makes what is flown in: an arena file, the spawn, and the truth if known.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use tempfile::TempDir;
use vizflyt_arena::ArenaConfig;
use vizflyt_scenes::SceneKind;
use vizflyt_server::scene::Up;

/// A scene on disk, ready to be served.
pub(crate) struct Stage {
    /// What `vizflyt serve` is given: an `arena.toml`, or a bare scene.
    pub arena: PathBuf,
    /// True geometry, where the scene was generated.
    pub truth: Option<PathBuf>,
    /// Where the vehicle stands: `x,y,z,yaw_deg`. [m, world; deg]
    pub spawn: String,
    /// Holds generated files until the flight ends.
    folder: Option<TempDir>,
}

impl Stage {
    /// Generates the named scene, or takes the one at a path.
    pub(crate) fn prepare(scene: &str, seed: u64) -> Result<Self> {
        if let Ok(kind) = scene.parse::<SceneKind>() {
            let folder = tempfile::Builder::new()
                .prefix("vizflyt-lab-")
                .tempdir()
                .context("cannot make a folder for the generated scene")?;
            let written = vizflyt_scenes::generate(kind, seed).write(folder.path())?;
            return Self::at(written.arena, Some(folder));
        }
        let path = Path::new(scene);
        if !path.exists() {
            bail!(
                "--scene '{scene}' is neither forest, race nor room, nor a path that exists; \
                 give one of the names, a folder with an arena.toml, or a scene file"
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
        Ok(Self { arena: path.to_owned(), truth: None, spawn: spawn(&arena), folder: None })
    }

    /// Returns how the seed made it what it is, to be said behind its name.
    pub(crate) fn seeded(&self, seed: u64) -> String {
        self.folder.as_ref().map_or(String::new(), |_| format!(", seed {seed}"))
    }

    fn at(arena: PathBuf, folder: Option<TempDir>) -> Result<Self> {
        let text = std::fs::read_to_string(&arena)
            .with_context(|| format!("cannot read {}", arena.display()))?;
        let config =
            ArenaConfig::parse(&text).with_context(|| format!("in {}", arena.display()))?;
        let truth = Some(arena.with_file_name("truth.json")).filter(|path| path.exists());
        Ok(Self { arena, truth, spawn: spawn(&config), folder })
    }
}

/// Returns where the vehicle stands, as `vizflyt sim --spawn` reads it.
fn spawn(arena: &ArenaConfig) -> String {
    let p = arena.spawn.position_m;
    format!("{},{},{},{}", p.x, p.y, p.z, arena.spawn.yaw_deg)
}
