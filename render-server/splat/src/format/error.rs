//! Errors of reading and writing scene files.

use std::path::PathBuf;

use super::Format;
use super::ply::PlyError;

/// Error of reading, decoding or writing a scene file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
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
    /// Neither content nor name indicates a known format.
    #[error("{what}; supported are {}", Format::list())]
    Unknown {
        /// Description of the file.
        what: String,
    },
    /// A PLY file is invalid.
    #[error(transparent)]
    Ply(#[from] PlyError),
    /// The file is well-formed, but a feature of it is not supported.
    #[error("{format}: {what} is not supported; {advice}")]
    Unsupported {
        /// The format.
        format: Format,
        /// Unsupported feature.
        what: String,
        /// Suggested alternative.
        advice: &'static str,
    },
    /// The file is damaged, or not a file of this format.
    #[error("{format}, {place}: {reason}")]
    Invalid {
        /// The format.
        format: Format,
        /// Byte offset, or name of the part of the file.
        place: String,
        /// Description of the defect.
        reason: String,
    },
    /// The file is shorter than its header declares.
    #[error("{format}: truncated: {what} takes {needed} bytes, the file has {available}")]
    Truncated {
        /// The format.
        format: Format,
        /// Part that is incomplete.
        what: &'static str,
        /// Size of the part. [byte]
        needed: u64,
        /// Available bytes. [byte]
        available: u64,
    },
    /// The file declares more memory than is plausible for its size.
    #[error("{format}: {what} is {value}; at most {limit} is accepted for a file of this size")]
    TooLarge {
        /// The format.
        format: Format,
        /// Quantity that exceeds its limit.
        what: &'static str,
        /// Value in the file.
        value: u64,
        /// Maximum accepted value.
        limit: u64,
    },
    /// The file contains no valid splat.
    #[error(
        "{format}: no splats: the file declares {declared}, {dropped} of them were dropped as invalid"
    )]
    Empty {
        /// The format.
        format: Format,
        /// Number of splats that the file declares.
        declared: usize,
        /// Number of splats that were dropped as invalid.
        dropped: usize,
    },
}
