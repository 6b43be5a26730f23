//! Stores a generated scene in a folder.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use vizflyt_arena::ConfigError;
use vizflyt_splat::ply;

use crate::generated::Generated;

/// Where a scene was stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// The splats, in the standard 3DGS PLY layout.
    pub scene: PathBuf,
    /// The arena, which names the scene.
    pub arena: PathBuf,
    /// The true solids: a JSON array of `Volume`.
    pub truth: PathBuf,
    /// The same, for plugins, where the map is known.
    pub map: Option<PathBuf>,
}

/// Why a scene could not be stored.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The folder or a text file could not be written.
    #[error("cannot write {}: {cause}; give a folder on a disk with room", path.display())]
    Io {
        /// What was to be written.
        path: PathBuf,
        /// The system's error.
        cause: io::Error,
    },
    /// The splats could not be written.
    #[error(transparent)]
    Splats(#[from] ply::PlyError),
    /// The arena has no text form.
    #[error("cannot write the arena: {0}")]
    Arena(ConfigError),
    /// The truth has no text form.
    #[error("cannot write the truth: {0}")]
    Truth(serde_json::Error),
}

impl Generated {
    /// Writes `scene.ply`, the splats of each object, `arena.toml`, `truth.json` and
    /// `truth-objects.json` into a folder, which is made if absent, and `map.json` where the map is
    /// known; replaces what has these names.
    ///
    /// # Errors
    /// [`WriteError::Io`] and [`WriteError::Splats`] name the file that could not be written.
    pub fn write(&self, dir: &Path) -> Result<Written, WriteError> {
        let io_error = |path: &Path| {
            let path = path.to_owned();
            move |cause| WriteError::Io { path, cause }
        };
        fs::create_dir_all(dir).map_err(io_error(dir))?;
        let written = Written {
            scene: dir.join(&self.arena.scene.file),
            arena: dir.join("arena.toml"),
            truth: dir.join("truth.json"),
            map: self.map_is_known.then(|| dir.join("map.json")),
        };
        ply::write(&written.scene, &self.splats)?;
        for (config, object) in self.arena.objects.iter().zip(&self.objects) {
            ply::write(dir.join(&config.scene), &object.splats)?;
        }
        let objects = dir.join("truth-objects.json");
        let true_objects = serde_json::to_string(&self.true_objects).map_err(WriteError::Truth)?;
        fs::write(&objects, true_objects).map_err(io_error(&objects))?;
        let truth = serde_json::to_string(&self.truth).map_err(WriteError::Truth)?;
        if let Some(map) = &written.map {
            fs::write(map, &truth).map_err(io_error(map))?;
        }
        fs::write(&written.truth, truth).map_err(io_error(&written.truth))?;
        // The arena last: where it stands, the rest is complete.
        let arena = self.arena.to_toml().map_err(WriteError::Arena)?;
        fs::write(&written.arena, arena).map_err(io_error(&written.arena))?;
        Ok(written)
    }
}
