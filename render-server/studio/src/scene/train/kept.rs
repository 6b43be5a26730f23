//! Checkpoints of a training, next to its output file: `my-hall.ply.training`. They are removed at the end.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use vizflyt_twin::Trainer;
use vizflyt_twin::train::Checkpoint;

/// Interval between checkpoints: the maximum loss of an interrupted training.
const EVERY: Duration = Duration::from_mins(1);

/// Writer of the checkpoints.
#[derive(Debug)]
pub(super) struct Kept {
    path: PathBuf,
    next: Instant,
}

impl Kept {
    /// Returns the writer for an output file.
    pub(super) fn beside(output: &Path) -> Self {
        let mut path = output.as_os_str().to_owned();
        path.push(".training");
        Self { path: path.into(), next: Instant::now() + EVERY }
    }

    /// Returns the checkpoint to resume from, if `resume`.
    ///
    /// # Errors
    /// A checkpoint exists, but neither `resume` nor `force` is set. Or `resume` is set, but the checkpoint is missing
    /// or damaged.
    pub(super) fn find(&self, resume: bool, force: bool) -> Result<Option<Checkpoint>> {
        let path = self.path.display();
        if !resume {
            if self.path.exists() && !force {
                bail!(
                    "{path} is an interrupted training; give --resume to continue it, or --force to restart"
                );
            }
            return Ok(None);
        }
        if !self.path.exists() {
            bail!(
                "{path} does not exist: there is no interrupted training; omit --resume to start one"
            );
        }
        let bytes = std::fs::read(&self.path).with_context(|| format!("cannot read {path}"))?;
        Ok(Some(Checkpoint::from_bytes(&bytes).with_context(|| path.to_string())?))
    }

    /// Writes a checkpoint if the interval has passed. If that fails, it logs a warning and the training continues.
    pub(super) fn keep(&mut self, trainer: &Trainer<'_>) {
        if Instant::now() < self.next {
            return;
        }
        if let Err(error) = self.write(trainer) {
            tracing::warn!("{error:#}; the training continues, but cannot be resumed from here");
        }
        self.next = Instant::now() + EVERY;
    }

    /// Removes the checkpoint at the end of the training.
    pub(super) fn remove(&self) {
        // The file may not exist.
        let _ = std::fs::remove_file(&self.path);
    }

    fn write(&self, trainer: &Trainer<'_>) -> Result<()> {
        // Atomic: the previous checkpoint stays until the new one is complete.
        let mut new = self.path.clone().into_os_string();
        new.push(".new");
        std::fs::write(&new, trainer.checkpoint().to_bytes())
            .and_then(|()| std::fs::rename(&new, &self.path))
            .with_context(|| format!("cannot write {}", self.path.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resume_and_force_must_match_the_existing_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let kept = Kept::beside(&folder.path().join("hall.ply"));
        let says = |resume: bool, force: bool| match kept.find(resume, force) {
            Ok(found) => format!("{}", found.is_some()),
            Err(error) => format!("{error:#}"),
        };
        assert_eq!(says(false, false), "false");
        assert!(says(true, false).contains("there is no interrupted training"));
        std::fs::write(&kept.path, b"no training").expect("written");
        assert!(says(false, false).contains("--resume"), "{}", says(false, false));
        assert_eq!(says(false, true), "false");
        assert!(says(true, false).contains("hall.ply.training: not a checkpoint"));
        kept.remove();
        assert_eq!(says(false, false), "false");
    }
}
