//! Sources of images: a camera, a folder, a video file, or another program.
//!
//! | source | meaning | stamps |
//! |---|---|---|
//! | `/dev/video0` | a V4L2 camera, or `/dev/video0:1280x720@60` | from the driver, moved to mid-exposure |
//! | `DIR` | PNG, JPEG, PGM files in the order of their names | `stamps.csv`, numbers as names, or a fixed rate |
//! | `FILE` | a video, decoded by the program `ffmpeg` | from the video's rate |
//! | `-` | YUV4MPEG2 on standard input | `XSTAMP_NS=` of each image, or its arrival |
//! | `\| COMMAND` | YUV4MPEG2 that a shell command prints, for example GStreamer | as for `-` |
//!
//! A stamp is the middle of the exposure. Stamps of cameras and programs use this computer's monotonic clock; stamps of
//! recordings have an arbitrary origin.

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

/// An image with its time of exposure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exposure {
    /// Middle of the exposure. [ns, the source's clock]
    pub stamp_ns: u64,
    pub image: Gray,
}

/// A source of images.
pub trait ImageSource: Send {
    /// Waits for the next image and returns it; `None` at the end.
    ///
    /// # Errors
    /// [`CaptureError`] if there will be no more images. A single damaged image is not an error.
    fn next(&mut self) -> Result<Option<Exposure>, CaptureError>;

    /// Returns whether images arrive as they are exposed, with stamps of this computer's monotonic clock.
    fn is_live(&self) -> bool;
}

/// Why images are not available.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// The source cannot be opened, or ended.
    #[error("{source_name}: {error}")]
    Io { source_name: String, error: std::io::Error },
    /// The source exists but is unsuitable.
    #[error("{source_name}: {why}")]
    Unfit {
        source_name: String,
        /// Problem and correction.
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

/// Opens a source by its name in a camera file or on the command line; see the table above.
///
/// # Errors
/// [`CaptureError`] if it does not exist or cannot be used.
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
    // The call fails only for unknown clocks.
    nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC)
        .map_or(0, |now| now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64)
}

#[cfg(test)]
mod tests;
