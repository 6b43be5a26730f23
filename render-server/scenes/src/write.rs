//! Writes a generated scene to a folder.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use vizflyt_arena::ConfigError;
use vizflyt_splat::ply;

use crate::generated::Generated;

/// Paths of the written files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Splats in the standard 3DGS PLY layout.
    pub scene: PathBuf,
    /// Arena, which refers to the scene.
    pub arena: PathBuf,
    /// True solids: a JSON array of `Volume`.
    pub truth: PathBuf,
    /// Map for plugins with the same content, if plugins may read it.
    pub map: Option<PathBuf>,
}

/// Error of [`Generated::write`].
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The folder or a text file could not be written.
    #[error("cannot write {}: {cause}; give a folder on a disk with enough space", path.display())]
    Io { path: PathBuf, cause: io::Error },
    /// The splats could not be written.
    #[error(transparent)]
    Splats(#[from] ply::PlyError),
    /// The arena cannot be serialized.
    #[error("cannot write the arena: {0}")]
    Arena(ConfigError),
    /// The truth cannot be serialized.
    #[error("cannot write the truth: {0}")]
    Truth(serde_json::Error),
}

impl Generated {
    /// Writes `scene.ply`, the splats of each object, `arena.toml`, `truth.json`, `truth-objects.json` and, if plugins
    /// may read the map, `map.json` into a folder. Creates the folder if it is missing, and replaces existing files.
    ///
    /// # Errors
    /// [`WriteError::Io`] and [`WriteError::Splats`] contain the path of the file.
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
        // The arena is written last, so that a folder with an arena is complete.
        let arena = self.arena.to_toml().map_err(WriteError::Arena)?;
        fs::write(&written.arena, arena).map_err(io_error(&written.arena))?;
        Ok(written)
    }
}
