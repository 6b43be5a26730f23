//! Where images come from: a camera, a folder, a video file, another program.
//!
//! | source | what it is | stamps |
//! |---|---|---|
//! | `/dev/video0` | a V4L2 camera, or `/dev/video0:1280x720@60` | the driver's, moved to mid-exposure |
//! | `DIR` | PNG, JPEG, PGM files in the order of their names | `stamps.csv`, names of digits, or a rate |
//! | `FILE` | a video, through the program `ffmpeg` | the video's rate |
//! | `-` | YUV4MPEG2 on standard input | `XSTAMP_NS=` of each image, else arrival |
//! | `\| COMMAND` | YUV4MPEG2 that a shell command prints, as of GStreamer | likewise |
//!
//! Stamps are the middle of the exposure. Those of a camera and of programs are on the monotonic
//! clock of this computer; recorded ones count from anywhere.

mod decode;
mod folder;
mod pipe;
#[cfg(target_os = "linux")]
mod v4l2;
mod watch;
mod y4m;

use std::path::Path;

pub use decode::decode;
pub use folder::{Folder, parse_stamps};
pub use pipe::Pipe;
#[cfg(target_os = "linux")]
pub use v4l2::Camera;
pub use watch::CameraWatch;
pub use y4m::{Colours, Y4m};

use crate::image::Gray;

/// An image and when it was exposed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exposure {
    /// When the exposure was half over. [ns, the source's clock]
    pub stamp_ns: u64,
    /// What the camera saw.
    pub image: Gray,
}

/// Yields images.
pub trait ImageSource: Send {
    /// Returns the next image; waits for it. `None` at the end.
    ///
    /// # Errors
    /// [`CaptureError`] if there will be no more; a single damaged image is no error.
    fn next(&mut self) -> Result<Option<Exposure>, CaptureError>;

    /// Whether images come as they are exposed, on this computer's monotonic clock.
    fn is_live(&self) -> bool;
}

/// Why there are no images.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// It cannot be opened, or ended.
    #[error("{source_name}: {error}")]
    Io {
        /// Which source.
        source_name: String,
        /// The system's error.
        error: std::io::Error,
    },
    /// It is there and is not what is needed.
    #[error("{source_name}: {why}")]
    Unfit {
        /// Which source.
        source_name: String,
        /// What is wrong and what to do.
        why: String,
    },
}

impl CaptureError {
    fn io(source_name: impl Into<String>, error: std::io::Error) -> Self {
        Self::Io { source_name: source_name.into(), error }
    }

    fn unfit(source_name: impl Into<String>, why: impl Into<String>) -> Self {
        Self::Unfit { source_name: source_name.into(), why: why.into() }
    }
}

/// Opens a source by what a camera file or the command line calls it; see the table above.
///
/// # Errors
/// [`CaptureError`] if it is not there or cannot be used.
pub fn open(source: &str) -> Result<Box<dyn ImageSource>, CaptureError> {
    if source == "-" {
        return Ok(Box::new(Pipe::stdin()));
    }
    if let Some(command) = source.strip_prefix('|') {
        return Ok(Box::new(Pipe::command(command.trim())?));
    }
    if source.starts_with("/dev/") {
        #[cfg(target_os = "linux")]
        return Ok(Box::new(Camera::open(source)?));
        #[cfg(not(target_os = "linux"))]
        return Err(CaptureError::unfit(source, "cameras are opened on Linux only"));
    }
    let path = Path::new(source);
    let kind = std::fs::metadata(path).map_err(|error| CaptureError::io(source, error))?;
    if kind.is_dir() {
        return Ok(Box::new(Folder::open(path)?));
    }
    Ok(Box::new(Pipe::video(path)?))
}

/// Returns the time of this computer's monotonic clock. [ns]
pub fn now_ns() -> u64 {
    // Only a clock that does not exist fails, and this one does.
    nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC)
        .map_or(0, |now| now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64)
}

#[cfg(test)]
mod tests;
