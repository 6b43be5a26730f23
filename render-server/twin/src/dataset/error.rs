//! Why a folder is no dataset, and what to do about it.

use std::path::{Path, PathBuf};

/// What is wrong with a dataset.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A file cannot be read.
    #[error("cannot read {}: {cause}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// The folder holds neither kind of dataset.
    #[error(
        "{} holds neither a transforms.json (nerfstudio) nor cameras, images and points3D as .bin or .txt (COLMAP) \
         in sparse/0, sparse, colmap/sparse/0 or itself; give the folder that does",
        .0.display()
    )]
    NotADataset(PathBuf),
    /// A file is not what its format says.
    #[error("{}: {what}", path.display())]
    Damaged {
        /// Which.
        path: PathBuf,
        /// What and where.
        what: String,
    },
    /// A lens that is not understood.
    #[error(
        "{}: camera model {model} is not understood; undistort the images first (`colmap image_undistorter`, \
         or nerfstudio's `ns-process-data`) and give the folder that this makes",
        path.display()
    )]
    Lens {
        /// Which file has it.
        path: PathBuf,
        /// Its name or number.
        model: String,
    },
    /// An image does not fit its camera.
    #[error(
        "{} has {found:?} pixels, its camera {expected:?}: another shape; are these the images that the cameras \
         were computed from?",
        path.display()
    )]
    Shape {
        /// Which image.
        path: PathBuf,
        /// Its width and height. [px]
        found: (u32, u32),
        /// The camera's. [px]
        expected: (u32, u32),
    },
    /// Too few images to train with.
    #[error("{} has {} images with a pose; at least 2 are needed", .0.display(), .1)]
    TooFew(PathBuf, usize),
    /// Most photos of the poses are not there.
    #[error(
        "{absent} of the {images} photos that have a pose are not there, such as {}; are these the poses of these photos?",
        first.display()
    )]
    Absent {
        /// One of them.
        first: PathBuf,
        /// How many.
        absent: usize,
        /// Of so many.
        images: usize,
    },
    /// All images together would not fit.
    #[error(
        "{images} images take {megabytes} MB of memory, more than {limit} MB; give a smaller --width"
    )]
    TooLarge {
        /// How many.
        images: usize,
        /// What they need. [MB]
        megabytes: u64,
        /// What is allowed. [MB]
        limit: u64,
    },
}

impl DatasetError {
    /// Returns what says that a file is damaged.
    pub(super) fn damaged(path: &Path, what: impl Into<String>) -> Self {
        Self::Damaged { path: path.to_owned(), what: what.into() }
    }
}

/// Reads a file whole, if it is not larger than any dataset's.
pub(super) fn read_file(path: &Path) -> Result<Vec<u8>, DatasetError> {
    let io = |cause| DatasetError::Io { path: path.to_owned(), cause };
    let len = std::fs::metadata(path).map_err(io)?.len();
    if len > MAX_FILE_BYTES {
        let what = format!("{len} bytes, more than {MAX_FILE_BYTES}; is this the right file?");
        return Err(DatasetError::damaged(path, what));
    }
    std::fs::read(path).map_err(io)
}

/// Larger than the models and photos of any room.
const MAX_FILE_BYTES: u64 = 2 << 30;
