//! A training under way, kept beside the scene that it will write: `my-hall.ply.training`, until it is done.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use vizflyt_twin::Trainer;
use vizflyt_twin::train::Checkpoint;

/// What is lost of an interrupted training at most.
const EVERY: Duration = Duration::from_mins(1);

/// Writes a training from time to time.
#[derive(Debug)]
pub(super) struct Kept {
    path: PathBuf,
    next: Instant,
}

impl Kept {
    /// Begins for a scene that will be written.
    pub(super) fn beside(output: &Path) -> Self {
        let mut path = output.as_os_str().to_owned();
        path.push(".training");
        Self { path: path.into(), next: Instant::now() + EVERY }
    }

    /// Returns what was kept, if it is to be gone on with.
    ///
    /// # Errors
    /// What there is, and is not asked for; or what is asked for, and not there or damaged.
    pub(super) fn find(&self, resume: bool, force: bool) -> Result<Option<Checkpoint>> {
        let path = self.path.display();
        if !resume {
            if self.path.exists() && !force {
                bail!(
                    "{path} is an interrupted training; --resume goes on with it, --force begins anew"
                );
            }
            return Ok(None);
        }
        if !self.path.exists() {
            bail!("{path} is not there: nothing was interrupted; leave out --resume to begin");
        }
        let bytes = std::fs::read(&self.path).with_context(|| format!("cannot read {path}"))?;
        Ok(Some(Checkpoint::from_bytes(&bytes).with_context(|| path.to_string())?))
    }

    /// Writes the training if it is time; one that cannot be written goes on and says so.
    pub(super) fn keep(&mut self, trainer: &Trainer<'_>) {
        if Instant::now() < self.next {
            return;
        }
        if let Err(error) = self.write(trainer) {
            tracing::warn!("{error:#}; training goes on, and cannot be resumed from here");
        }
        self.next = Instant::now() + EVERY;
    }

    /// Removes what was kept: the training is done.
    pub(super) fn remove(&self) {
        // It may never have been written.
        let _ = std::fs::remove_file(&self.path);
    }

    fn write(&self, trainer: &Trainer<'_>) -> Result<()> {
        // Whole or not at all: the last one stays until this one is written.
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
    fn what_is_there_and_what_is_asked_for_must_agree() {
        let folder = tempfile::tempdir().expect("a folder");
        let kept = Kept::beside(&folder.path().join("hall.ply"));
        let says = |resume: bool, force: bool| match kept.find(resume, force) {
            Ok(found) => format!("{}", found.is_some()),
            Err(error) => format!("{error:#}"),
        };
        assert_eq!(says(false, false), "false");
        assert!(says(true, false).contains("nothing was interrupted"));
        std::fs::write(&kept.path, b"no training").expect("written");
        assert!(says(false, false).contains("--resume"), "{}", says(false, false));
        assert_eq!(says(false, true), "false");
        assert!(says(true, false).contains("hall.ply.training: these bytes are no training"));
        kept.remove();
        assert_eq!(says(false, false), "false");
    }
}
