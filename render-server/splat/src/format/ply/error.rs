//! Errors of reading and writing PLY files.

use std::path::PathBuf;

/// Error of reading, decoding or writing a PLY file of splats.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlyError {
    /// The operating system reported an error.
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
        /// First bytes as lossy text.
        found: String,
    },
    /// The header is malformed.
    #[error("PLY header, byte {offset}: {reason}")]
    Header {
        /// Start of the invalid line. [byte]
        offset: usize,
        /// Description of the defect.
        reason: String,
    },
    /// The file is a well-formed PLY without splats.
    #[error("not a splat scene: {reason}")]
    NotSplats {
        /// Assumed content, and missing properties.
        reason: String,
    },
    /// The number of `f_rest_*` properties does not match any degree of harmonics.
    #[error("{found} f_rest properties; expected 0, 9, 24, 45 or 72 (harmonics of degree 0 to 4)")]
    HarmonicsCount {
        /// Number of `f_rest_*` properties.
        found: usize,
    },
    /// The file is shorter than the header declares.
    #[error(
        "truncated: element `{element}` of {declared} rows needs {needed} more bytes from byte \
         {offset}, the file has {available}"
    )]
    Truncated {
        /// Incomplete element.
        element: String,
        /// Number of rows that the header declares.
        declared: usize,
        /// Start of the element's data, or of the incomplete row. [byte]
        offset: usize,
        /// Minimum bytes needed from there.
        needed: u128,
        /// Available bytes from there.
        available: usize,
    },
    /// A value is invalid.
    #[error("byte {offset}, row {row} of `{element}`: {reason}")]
    Value {
        /// Start of the value. [byte]
        offset: usize,
        /// Element of the value.
        element: String,
        /// Row of the value, from 0.
        row: usize,
        /// Description of the defect.
        reason: String,
    },
    /// The file contains no valid splat.
    #[error("no splats: the file declares {declared}, {dropped} of them were dropped as invalid")]
    Empty {
        /// Number of rows that the header declares.
        declared: usize,
        /// Number of rows that were dropped as invalid.
        dropped: usize,
    },
}
