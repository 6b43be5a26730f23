//! SOG ("spatially ordered Gaussians"): PlayCanvas's textures of splats, one pixel per splat,
//! either in a ZIP (`.sog`) or as files next to their `meta.json`. Versions 1 (without a version
//! field) and 2.
//!
//! Data flow of reading: `files` opens `meta.json` and the files that it lists; `meta` converts
//! either version to one set of tables, byte to value; `texture` decodes lossless WebP; `read`
//! combines them. Writing: `codebook` and `palette` compute the tables and the palette of
//! harmonics, for `write`.
//!
//! | texture | holds | version 1 | version 2 |
//! |---|---|---|---|
//! | `means_l`, `means_u` | low and high byte of x, y, z | between bounds of sign(x) ln(1 + abs x) | same |
//! | `scales` | log of the standard deviation | between bounds per axis | codebook |
//! | `quats` | the three smaller of wxyz, -1/sqrt(2) to 1/sqrt(2); alpha 252 + index of the largest | | same |
//! | `sh0` | constant harmonic; opacity in alpha | between bounds; logit between bounds | codebook; linear |
//! | `shN_labels` | index into the palette, low byte first | | same |
//! | `shN_centroids` | palette, 64 entries to a row, one pixel (RGB) per coefficient | between bounds | codebook |
//!
//! Axes: unchanged from the PLY, as in PlayCanvas's converter.

mod codebook;
mod files;
mod meta;
mod palette;
mod read;
mod streamed;
mod texture;
mod write;

pub(super) use files::{Files, META};
pub(super) use read::decode;
pub use streamed::assemble_streamed;
pub(super) use streamed::{LOD_META, each_chunk};
pub(super) use write::{encode, parts};

use super::{Format, FormatError};

/// Palette entries per row of the texture.
const PALETTE_WIDTH: usize = 64;
/// Alpha of a quaternion with w as its largest component. 253 to 255 stand for x, y and z.
const QUATERNION_TAG: u8 = 252;

/// Returns an error about a part of a scene.
fn invalid(part: &str, reason: impl Into<String>) -> FormatError {
    FormatError::Invalid { format: Format::Sog, place: part.into(), reason: reason.into() }
}
