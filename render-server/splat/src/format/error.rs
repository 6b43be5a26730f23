//! Why a scene file is refused.

use std::path::PathBuf;

use super::Format;
use super::ply::PlyError;

/// Why a file is no splat scene, or could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
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
    /// Neither the content nor the name has a known format.
    #[error("{what}; supported are {}", Format::list())]
    Unknown {
        /// What the file seems to be.
        what: String,
    },
    /// A PLY file is refused.
    #[error(transparent)]
    Ply(#[from] PlyError),
    /// The file is well-formed, but of a kind that is not read.
    #[error("{format}: {what} is not supported; {advice}")]
    Unsupported {
        /// The format.
        format: Format,
        /// The kind, by name.
        what: String,
        /// What to do instead.
        advice: &'static str,
    },
    /// The file is damaged or no file of its format.
    #[error("{format}, {place}: {reason}")]
    Invalid {
        /// The format.
        format: Format,
        /// A byte, or the name of a part of the file.
        place: String,
        /// What is wrong there.
        reason: String,
    },
    /// The file ends before its own promise is kept.
    #[error("{format}: truncated: {what} takes {needed} bytes, the file has {available}")]
    Truncated {
        /// The format.
        format: Format,
        /// The part that does not fit.
        what: &'static str,
        /// Bytes it takes. [byte]
        needed: u64,
        /// Bytes there are. [byte]
        available: u64,
    },
    /// The file asks for more memory than a scene of its size has a reason to.
    #[error("{format}: {what} is {value}; at most {limit} is accepted for a file of this size")]
    TooLarge {
        /// The format.
        format: Format,
        /// The quantity.
        what: &'static str,
        /// Its value.
        value: u64,
        /// What is accepted.
        limit: u64,
    },
    /// Nothing is left to render.
    #[error(
        "{format}: no splats: the file declares {declared}, {dropped} of them were dropped as invalid"
    )]
    Empty {
        /// The format.
        format: Format,
        /// Splats the file declares.
        declared: usize,
        /// Splats dropped as invalid.
        dropped: usize,
    },
}
