//! What a file may ask for, checked before anything is allocated.

use super::{Format, FormatError};

/// Most splats of a scene: 8 GB of degree 3, several times what any scanner exports.
const MAX_SPLATS: u64 = 1 << 25;
/// Packed bytes that any file may inflate to, however small it is. [byte]
const FREE_BYTES: u64 = 16 << 20;
/// Beyond those, how many times its own size a file may inflate to. Real scenes reach 4; a flat
/// image or a run of zeros, of which bombs are made, 1000 and more.
const MAX_EXPANSION: u64 = 100;

/// Refuses counts beyond any scene.
pub(super) fn count(format: Format, splats: u64) -> Result<(), FormatError> {
    at_most(format, "the number of splats", splats, MAX_SPLATS)
}

/// Refuses counts whose packed bytes, `each`, a file of `file_bytes` cannot honestly hold.
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

/// Refuses a value above a limit.
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
