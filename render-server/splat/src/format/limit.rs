//! Limits of declared sizes, checked before memory is allocated.

use super::{Format, FormatError};

/// Maximum number of splats of a scene: 8 GB at degree 3, several times what any scanner exports.
const MAX_SPLATS: u64 = 1 << 25;
/// Inflated size that is accepted for any file, however small. [byte]
const FREE_BYTES: u64 = 16 << 20;
/// Maximum ratio of inflated to stored size beyond [`FREE_BYTES`]. Real scenes reach 4;
/// decompression bombs (flat images, runs of zeros) reach 1000 and more.
const MAX_EXPANSION: u64 = 100;

/// Rejects numbers of splats that are too large for any scene.
pub(super) fn count(format: Format, splats: u64) -> Result<(), FormatError> {
    at_most(format, "the number of splats", splats, MAX_SPLATS)
}

/// Rejects numbers of splats whose packed size, `each` bytes per splat, is implausible for a file
/// of `file_bytes`.
pub(super) fn inflated(
    format: Format,
    splats: u64,
    each: u64,
    file_bytes: usize,
) -> Result<(), FormatError> {
    count(format, splats)?;
    let most = FREE_BYTES.max((file_bytes as u64).saturating_mul(MAX_EXPANSION));
    at_most(format, "the size when inflated, in bytes,", splats * each, most)
}

/// Rejects values above `limit`.
pub(super) fn at_most(
    format: Format,
    what: &'static str,
    value: u64,
    limit: u64,
) -> Result<(), FormatError> {
    if value > limit {
        return Err(FormatError::TooLarge { format, what, value, limit });
    }
    Ok(())
}
