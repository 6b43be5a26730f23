//! Editing of a scene: the original is never changed; a list of steps is stored next to it.
//!
//! ```text
//! room.ply ------------ read, hashed --> Splats --> steps in order --> room.edited.ply, or any other file
//! room.ply.edits.toml - EditList ----------------/
//! ```
//! The list identifies its original by hash, so that the result can be reproduced from the two, and a step can
//! be undone.

mod list;

use std::fs::File;
use std::io::{ErrorKind, Read, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
pub use list::{DoneStep, EditList, EditListError};
use ring::digest::{Context as Hash, SHA256};
use tracing::warn;
use vizflyt_splat::Splats;
use vizflyt_splat::edit::EditStep;
use vizflyt_splat::format::{self, Format};

/// Scene with its steps applied.
#[derive(Debug)]
pub struct Editor {
    original: PathBuf,
    list: EditList,
    splats: Splats,
}

impl Editor {
    /// Reads a scene file and the list next to it, if there is one, and applies its steps.
    ///
    /// # Errors
    /// Files that cannot be read; a list of another file; a step that no longer works.
    pub fn open(original: &Path) -> Result<Self> {
        Self::open_without_last(original, 0)
    }

    /// Opens like [`Self::open`], with the last `steps` undone.
    ///
    /// # Errors
    /// As [`Self::open`]; or there are fewer steps.
    pub fn open_without_last(original: &Path, steps: usize) -> Result<Self> {
        let (mut splats, sha256) = read_with_hash(original)?;
        let mut list = match read_list(original)? {
            Some(list) => {
                let path = list_path(original);
                ensure!(
                    list.scene.sha256 == sha256,
                    "{} is not the file that {} lists edits of: its SHA-256 is {sha256}, expected is {}; put the \
                     original back, or remove the list to start again",
                    original.display(),
                    path.display(),
                    list.scene.sha256
                );
                list
            }
            None => EditList::new(file_name(original), sha256, splats.len()),
        };
        let stays = list.steps.len().checked_sub(steps);
        let stays = stays.with_context(|| match list.steps.len() {
            0 => "there is nothing to undo".to_owned(),
            some => format!("there are {some} steps to undo, not {steps}"),
        })?;
        list.steps.truncate(stays);
        for (index, done) in list.steps.iter_mut().enumerate() {
            let number = index + 1;
            let taken = done.edit.apply(&mut splats).with_context(|| format!("step {number}"))?;
            if taken != done.taken {
                warn!(
                    "step {number} ({}) takes {taken} splats away here, and took {} when it was made",
                    done.edit, done.taken
                );
                done.taken = taken;
            }
        }
        Ok(Self { original: original.to_owned(), list, splats })
    }

    /// Returns the scene after all steps, in the axes and units of the file.
    pub fn splats(&self) -> &Splats {
        &self.splats
    }

    /// Returns all steps.
    pub fn steps(&self) -> &[DoneStep] {
        &self.list.steps
    }

    /// Returns the path of the original.
    pub fn original(&self) -> &Path {
        &self.original
    }

    /// Applies a step; returns the number of removed splats.
    ///
    /// # Errors
    /// Why it is not possible; then nothing has changed.
    pub fn apply(&mut self, step: EditStep) -> Result<usize> {
        ensure!(
            self.list.steps.len() < EditList::MAX_STEPS,
            "{} steps are the most; save the scene under another name and go on with that",
            EditList::MAX_STEPS
        );
        let taken = step.apply(&mut self.splats)?;
        self.list.steps.push(DoneStep { taken, edit: step });
        Ok(taken)
    }

    /// Undoes the last step, by reading the original again.
    ///
    /// # Errors
    /// No step exists, or the original cannot be read any more.
    pub fn undo(&mut self) -> Result<EditStep> {
        let last = self.list.steps.len().checked_sub(1).context("there is nothing to undo")?;
        let (mut splats, sha256) = read_with_hash(&self.original)?;
        ensure!(
            sha256 == self.list.scene.sha256,
            "{} has been changed since it was opened; open it again",
            self.original.display()
        );
        for done in &self.list.steps[..last] {
            done.edit.apply(&mut splats)?;
        }
        self.splats = splats;
        Ok(self.list.steps.remove(last).edit)
    }

    /// Writes the scene in the format of the file's name, and the list next to the original.
    ///
    /// # Errors
    /// A file that cannot be written, or the original itself.
    pub fn save(&self, to: &Path) -> Result<()> {
        let is_original = match (to.canonicalize(), self.original.canonicalize()) {
            (Ok(to), Ok(original)) => to == original,
            _ => false,
        };
        ensure!(
            !is_original,
            "{} is the original, which stays as it is; give another file (-o)",
            to.display()
        );
        // The list first, because it cannot be reproduced.
        let path = list_path(&self.original);
        replace(&path, &self.list.to_toml())
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(format::write(to, &self.splats)?)
    }
}

/// Returns the path of a scene's list: next to it, with its full name.
pub fn list_path(original: &Path) -> PathBuf {
    original.with_file_name(format!("{}.edits.toml", file_name(original)))
}

/// Returns the default path of the edited scene: next to the original, in its format if that can be written.
pub fn result_path(original: &Path) -> PathBuf {
    let name = file_name(original);
    let format = Format::of_name(original);
    let extension = format.unwrap_or(Format::Ply).extension();
    let stem = name.strip_suffix(&format!(".{extension}")).unwrap_or(&name);
    original.with_file_name(format!("{stem}.edited.{extension}"))
}

/// Reads the list next to a scene, if there is one.
///
/// # Errors
/// A list that cannot be read, is invalid, or belongs to another file.
pub fn read_list(original: &Path) -> Result<Option<EditList>> {
    let path = list_path(original);
    let cannot = || format!("cannot read {}", path.display());
    let file = match File::open(&path) {
        Ok(file) => file,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).with_context(cannot),
    };
    let mut text = String::new();
    file.take(EditList::MAX_BYTES + 1).read_to_string(&mut text).with_context(cannot)?;
    let list = EditList::parse(&text).with_context(|| format!("{} is wrong", path.display()))?;
    if list.scene.file != file_name(original) {
        bail!("{} lists edits of {}; rename it", path.display(), list.scene.file);
    }
    Ok(Some(list))
}

pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Reads and hashes a scene file.
fn read_with_hash(path: &Path) -> Result<(Splats, String)> {
    ensure!(
        !path.is_dir()
            && !path.file_name().is_some_and(|name| name.to_string_lossy().ends_with("meta.json")),
        "{} is a scene of several files; make one of it first: vizflyt scene convert {} scene.ply",
        path.display(),
        path.display()
    );
    let (loaded, sha256) = std::thread::scope(|scope| {
        let hashing = scope.spawn(|| hash(path));
        (format::read(path), hashing.join().expect("hashing does not panic"))
    });
    let loaded = loaded.with_context(|| format!("cannot use scene {}", path.display()))?;
    let dropped = loaded.dropped.total();
    if dropped > 0 {
        warn!("{}: {dropped} faulty splats left out: {:?}", path.display(), loaded.dropped);
    }
    Ok((loaded.splats, sha256.with_context(|| format!("cannot read {}", path.display()))?))
}

fn hash(path: &Path) -> std::io::Result<String> {
    // A pipe would block, and be empty at the second read.
    if !std::fs::metadata(path)?.is_file() {
        return Err(std::io::Error::new(ErrorKind::InvalidInput, "not a regular file"));
    }
    let (mut file, mut hash) = (File::open(path)?, Hash::new(&SHA256));
    let mut block = vec![0; 1 << 20];
    loop {
        let length = file.read(&mut block)?;
        if length == 0 {
            return Ok(vizflyt_trust::hex(hash.finish().as_ref()));
        }
        hash.update(&block[..length]);
    }
}

/// Writes to a temporary file and renames it, so that the list is always complete.
pub(super) fn replace(path: &Path, text: &str) -> std::io::Result<()> {
    let partial = path.with_extension("toml.part");
    let mut file = File::create(&partial)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()?;
    std::fs::rename(&partial, path)
}

#[cfg(test)]
mod tests;
