//! Errors of reading a dataset, with their remedies.

use std::path::{Path, PathBuf};

/// Why a dataset cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file cannot be read.
    #[error("cannot read {}: {cause}", path.display())]
    Io { path: PathBuf, cause: std::io::Error },
    /// The folder holds no known kind of dataset.
    #[error(
        "{} holds neither a transforms.json (nerfstudio) nor cameras, images and points3D as .bin or .txt (COLMAP) \
         in sparse/0, sparse, colmap/sparse/0 or itself; give the folder that does",
        .0.display()
    )]
    NotADataset(PathBuf),
    /// A file violates its format.
    #[error("{}: {what}", path.display())]
    Damaged {
        path: PathBuf,
        /// Fault and its position.
        what: String,
    },
    /// Unsupported lens.
    #[error(
        "{}: camera model {model} is not understood; undistort the images first (`colmap image_undistorter`, \
         or nerfstudio's `ns-process-data`) and give the folder that this makes",
        path.display()
    )]
    Lens {
        /// File with the lens.
        path: PathBuf,
        /// Name or number of the camera model.
        model: String,
    },
    /// The aspect ratio of an image differs from that of its camera.
    #[error(
        "{} has {found:?} pixels, its camera {expected:?}: another shape; are these the images that the cameras \
         were computed from?",
        path.display()
    )]
    Shape {
        path: PathBuf,
        /// Width and height of the image. [px]
        found: (u32, u32),
        /// Width and height of the camera. [px]
        expected: (u32, u32),
    },
    /// Too few images to train with.
    #[error("{} has {} images with a pose; at least 2 are needed", .0.display(), .1)]
    TooFew(PathBuf, usize),
    /// More than half of the photos with a pose are missing.
    #[error(
        "{absent} of the {images} photos that have a pose are missing, such as {}; do the poses belong to \
         these photos?",
        first.display()
    )]
    Absent {
        /// Path of one of them.
        first: PathBuf,
        /// Number of missing photos.
        absent: usize,
        /// Number of photos with a pose.
        images: usize,
    },
    /// All images together exceed the memory limit.
    #[error(
        "{images} images take {megabytes} MB of memory, more than {limit} MB; give a smaller --width"
    )]
    TooLarge {
        /// Number of images.
        images: usize,
        /// Required memory. [MB]
        megabytes: u64,
        /// Memory limit. [MB]
        limit: u64,
    },
}

impl DatasetError {
    /// Returns the error for a damaged file.
    pub(super) fn damaged(path: &Path, what: impl Into<String>) -> Self {
        Self::Damaged { path: path.to_owned(), what: what.into() }
    }
}

/// Reads a file, up to the maximum size of a dataset's file.
pub(super) fn read_file(path: &Path) -> Result<Vec<u8>, DatasetError> {
    let io = |cause| DatasetError::Io { path: path.to_owned(), cause };
    let len = std::fs::metadata(path).map_err(io)?.len();
    if len > MAX_FILE_BYTES {
        let what = format!("{len} bytes, more than {MAX_FILE_BYTES}; is this the right file?");
        return Err(DatasetError::damaged(path, what));
    }
    std::fs::read(path).map_err(io)
}

/// Maximum size of a file: more than the models and photos of any room.
const MAX_FILE_BYTES: u64 = 2 << 30;
