//! The first stage: sharp pictures of a video, evenly over its time, or a folder of photos as it is.

mod blur;
mod choose;
mod photos;
mod video;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};
pub(super) use video::probe;

/// What was filmed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Source {
    /// A video file.
    Video(PathBuf),
    /// A folder with photos.
    Folder(PathBuf),
}

impl Source {
    /// Returns what a path of the command line is.
    ///
    /// # Errors
    /// Nothing there, or a folder without photos.
    pub(super) fn of(path: &Path) -> Result<Self> {
        if path.is_dir() {
            return photos::folder(path).map(Self::Folder);
        }
        if !path.is_file() {
            bail!(
                "{} is neither a video nor a folder of photos; is the name right?",
                path.display()
            );
        }
        Ok(Self::Video(path.to_owned()))
    }
}

/// Pictures to find poses of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Pictures {
    /// Where they lie.
    pub(super) folder: PathBuf,
    /// Of each. [px]
    pub(super) size_px: [u32; 2],
    /// Whether they are of one video: then times are its own.
    pub(super) of_video: bool,
    /// In the order of time.
    pub(super) pictures: Vec<Picture>,
}

/// One picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Picture {
    /// Below the folder.
    pub(super) name: String,
    /// From the start of the video; of photos their number. [s]
    pub(super) at_s: f64,
    /// From 0, sharp, to 1.
    pub(super) blur: f64,
    /// Mean of its grey levels, of 255.
    pub(super) grey: f64,
}

impl Pictures {
    /// Returns when a picture was taken, by its name.
    pub(super) fn at_s(&self, name: &str) -> f64 {
        let found = self.pictures.iter().find(|picture| picture.name == name);
        found.map_or(f64::INFINITY, |picture| picture.at_s)
    }

    /// Returns what a person should know of them, in words.
    pub(super) fn remarks(&self) -> Vec<String> {
        choose::remarks(self)
    }
}

/// What to take of a video.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Choice {
    /// So many pictures; `None`: three a second, within [`FRAMES`].
    pub(super) frames: Option<usize>,
    /// Wider ones are made smaller. [px]
    pub(super) width_px: u32,
}

/// Takes the pictures of a source; those of a video are written into `folder`.
///
/// # Errors
/// What cannot be read, in words.
pub(super) fn take(source: &Source, choice: Choice, folder: &Path) -> Result<Pictures> {
    match source {
        Source::Video(file) => video::take(file, choice, folder),
        Source::Folder(photos) => photos::take(photos),
    }
}

/// Returns the time of a video as people write it, "0:07".
pub(super) fn clock(at_s: f64) -> String {
    let whole_s = at_s.max(0.0) as u64;
    format!("{}:{:02}", whole_s / 60, whole_s % 60)
}

/// Fewer do not overlap on a walk, more take long: 150 pictures of 640x480 take two minutes on two cores.
const FRAMES: std::ops::RangeInclusive<usize> = 80..=300;
