//! COLMAP as a Python package: `pip install pycolmap`, version 4.0 and later; 3.x has other names in its API.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};

use super::tool::ask;
use super::{Finder, Job, Phase, Tool, UNKNOWN_LENS};

/// Python interpreter with pycolmap.
pub(super) struct Pycolmap {
    python: PathBuf,
    name: String,
}

impl Pycolmap {
    /// Checks that an interpreter has pycolmap, and reads its version.
    ///
    /// # Errors
    /// The interpreter has no pycolmap of version 4.
    pub(super) fn open(python: &Path) -> Result<Self> {
        let version = ask(Command::new(python).args(["-c", VERSION]));
        let version = version.with_context(|| {
            format!(
                "{} has no pycolmap of version 4: {} -m pip install pycolmap",
                python.display(),
                python.display()
            )
        })?;
        Ok(Self { python: python.to_owned(), name: format!("pycolmap {}", version.trim()) })
    }
}

impl Finder for Pycolmap {
    fn name(&self) -> &str {
        &self.name
    }

    fn find(&self, job: &Job<'_>, progress: &mut dyn FnMut(Phase)) -> Result<()> {
        let script = job.folder.join("find_poses.py");
        std::fs::write(&script, SCRIPT)?;
        let (model, parameters) = job.lens.clone().unwrap_or((UNKNOWN_LENS, String::new()));
        let mut command = Command::new(&self.python);
        command.arg(&script).arg(job.images).arg(job.pairs).arg(job.folder).arg(job.models);
        command.args([model, &parameters]);
        Tool { name: &self.name, log: &job.folder.join("log.txt") }.run(&mut command, progress)
    }
}

/// Also checks the names that the script needs.
const VERSION: &str = "import pycolmap; pycolmap.FeatureExtractionOptions, pycolmap.match_image_pairs; \
                       print(pycolmap.__version__)";
const SCRIPT: &str = include_str!("find_poses.py");
