//! COLMAP's models, text and binary (colmap.github.io/format.html).

pub mod binary;
mod lens;
pub mod text;
mod write;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use vizflyt_protocol::geometry::Intrinsics;

pub use self::lens::parameters;
pub use self::write::write;
use super::error::{DatasetError, read_file};
use super::sparse::SparseModel;

/// Why bytes are not a valid model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ColmapError {
    /// The file is truncated or has an invalid value.
    #[error("{0}")]
    Damaged(String),
    /// Unsupported lens.
    #[error("camera model {0} is not understood")]
    Lens(String),
}

/// Cameras by id.
pub type Cameras = HashMap<u32, Intrinsics>;

/// Returns the folder with a model inside a dataset, if any.
pub fn find(folder: &Path) -> Option<PathBuf> {
    let places = ["sparse/0", "sparse", "colmap/sparse/0", ""];
    let has = |path: &Path| {
        ["bin", "txt"].iter().any(|kind| path.join(format!("cameras.{kind}")).is_file())
    };
    places.iter().map(|place| folder.join(place)).find(|path| has(path))
}

/// Reads the model in a folder; binary files have priority over text files.
///
/// # Errors
/// [`DatasetError`], which names the file and the remedy.
pub fn read(folder: &Path) -> Result<SparseModel, DatasetError> {
    let is_binary = folder.join("cameras.bin").is_file();
    let kind = if is_binary { "bin" } else { "txt" };
    let load = |name: &str| {
        let path = folder.join(format!("{name}.{kind}"));
        read_file(&path).map(|bytes| (path, bytes))
    };
    let parse = |path: &Path, error: ColmapError| match error {
        ColmapError::Damaged(what) => DatasetError::damaged(path, what),
        ColmapError::Lens(model) => DatasetError::Lens { path: path.to_owned(), model },
    };
    let string = |path: &Path, bytes: Vec<u8>| {
        String::from_utf8(bytes).map_err(|_| DatasetError::damaged(path, "not text in UTF-8"))
    };
    let (path, bytes) = load("cameras")?;
    let cameras =
        if is_binary { binary::cameras(&bytes) } else { text::cameras(&string(&path, bytes)?) }
            .map_err(|error| parse(&path, error))?;
    let (path, bytes) = load("images")?;
    let images = if is_binary {
        binary::images(&bytes, &cameras)
    } else {
        text::images(&string(&path, bytes)?, &cameras)
    }
    .map_err(|error| parse(&path, error))?;
    let (path, bytes) = load("points3D")?;
    let points =
        if is_binary { binary::points(&bytes) } else { text::points(&string(&path, bytes)?) }
            .map_err(|error| parse(&path, error))?;
    Ok(SparseModel { images, points })
}

#[cfg(test)]
mod tests;
