//! Why a PLY file is refused.

use std::path::PathBuf;

/// Why a file is no splat scene, or could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlyError {
    /// The operating system refused.
    #[error("cannot {verb} {}: {cause}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// `read` or `write`.
        verb: &'static str,
        /// The system's error.
        cause: std::io::Error,
    },
    /// The file does not start with `ply`.
    #[error("not a PLY file: it starts with {found:?}, not \"ply\"")]
    NotPly {
        /// The first bytes, lossily as text.
        found: String,
    },
    /// The header is malformed.
    #[error("PLY header, byte {offset}: {reason}")]
    Header {
        /// Where the offending line starts. [byte]
        offset: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// The file is a well-formed PLY of something else.
    #[error("not a splat scene: {reason}")]
    NotSplats {
        /// What it seems to be, and what is missing.
        reason: String,
    },
    /// The number of `f_rest_*` properties belongs to no degree of harmonics.
    #[error("{found} f_rest properties; expected 0, 9, 24, 45 or 72 (harmonics of degree 0 to 4)")]
    HarmonicsCount {
        /// How many there are.
        found: usize,
    },
    /// The file ends before the header's promise is kept.
    #[error(
        "truncated: element `{element}` of {declared} rows needs {needed} more bytes from byte \
         {offset}, the file has {available}"
    )]
    Truncated {
        /// The element that does not fit.
        element: String,
        /// Rows the header declares.
        declared: usize,
        /// Where its data, or the row that does not fit, starts. [byte]
        offset: usize,
        /// Bytes needed from there, at the least.
        needed: u128,
        /// Bytes there are from there.
        available: usize,
    },
    /// A value cannot be read.
    #[error("byte {offset}, row {row} of `{element}`: {reason}")]
    Value {
        /// Where the value starts. [byte]
        offset: usize,
        /// The element it belongs to.
        element: String,
        /// The row it belongs to, from 0.
        row: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// Nothing is left to render.
    #[error("no splats: the file declares {declared}, {dropped} of them were dropped as invalid")]
    Empty {
        /// Rows the header declares.
        declared: usize,
        /// Rows dropped as invalid.
        dropped: usize,
    },
}
