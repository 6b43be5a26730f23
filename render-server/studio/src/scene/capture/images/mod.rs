//! First stage: selects sharp pictures of a video, evenly over its time, or reads a folder of photos.

mod blur;
mod choose;
mod photos;
mod video;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};
pub(super) use video::probe;

/// Input of a capture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Source {
    Video(PathBuf),
    /// Folder with photos.
    Folder(PathBuf),
}

impl Source {
    /// Returns the type of input at a path.
    ///
    /// # Errors
    /// The path does not exist, or the folder has no photos.
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

/// Pictures of a capture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Pictures {
    /// Folder of the pictures.
    pub(super) folder: PathBuf,
    /// Size of each picture. [px]
    pub(super) size_px: [u32; 2],
    /// Whether they are from a video, so that their times are known.
    pub(super) of_video: bool,
    /// Pictures in order of time.
    pub(super) pictures: Vec<Picture>,
}

/// Entry of a picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Picture {
    /// Path relative to the folder.
    pub(super) name: String,
    /// Time since the start of the video [s]; for photos, the index.
    pub(super) at_s: f64,
    /// Blur, from 0 (sharp) to 1.
    pub(super) blur: f64,
    /// Mean grey level, 0 to 255.
    pub(super) grey: f64,
}

impl Pictures {
    /// Returns the time of the picture with this name; infinity if there is none.
    pub(super) fn at_s(&self, name: &str) -> f64 {
        let found = self.pictures.iter().find(|picture| picture.name == name);
        found.map_or(f64::INFINITY, |picture| picture.at_s)
    }

    /// Returns remarks about the pictures for the user.
    pub(super) fn remarks(&self) -> Vec<String> {
        choose::remarks(self)
    }
}

/// Settings for the selection of pictures from a video.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Choice {
    /// Number of pictures; `None`: three per second, within [`FRAMES`].
    pub(super) frames: Option<usize>,
    /// Maximum width; wider pictures are downscaled. [px]
    pub(super) width_px: u32,
}

/// Reads the pictures of a source. Pictures of a video are written into `folder`.
///
/// # Errors
/// The source cannot be read.
pub(super) fn take(source: &Source, choice: Choice, folder: &Path) -> Result<Pictures> {
    match source {
        Source::Video(file) => video::take(file, choice, folder),
        Source::Folder(photos) => photos::take(photos),
    }
}

/// Returns the time in a video as text: "0:07".
pub(super) fn clock(at_s: f64) -> String {
    let whole_s = at_s.max(0.0) as u64;
    format!("{}:{:02}", whole_s / 60, whole_s % 60)
}

/// Default range of the number of pictures. Fewer do not overlap enough, and more take long: 150 pictures of 640x480
/// take two minutes on two cores.
const FRAMES: std::ops::RangeInclusive<usize> = 80..=300;
