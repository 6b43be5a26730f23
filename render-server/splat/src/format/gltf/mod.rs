//! glTF 2.0 with `KHR_gaussian_splatting`, ratified by Khronos: `.glb` in one file, or `.gltf` with
//! buffers in files next to it.
//!
//! Data flow: `container` returns the JSON and the bytes of each buffer; `scene` is the part of the
//! JSON that concerns splats; `accessor` resolves a reference to a column of numbers that was
//! checked to lie in its buffer; `read` walks the nodes and transforms the splats of each
//! primitive. `write` writes one primitive as `.glb`.
//!
//! | attribute | holds |
//! |---|---|
//! | `POSITION` | centre |
//! | `KHR_gaussian_splatting:ROTATION` | quaternion xyzw |
//! | `KHR_gaussian_splatting:SCALE` | standard deviations, linear; logarithms in drafts of the extension, detected by negative values |
//! | `KHR_gaussian_splatting:OPACITY` | 0 to 1 |
//! | `KHR_gaussian_splatting:SH_DEGREE_l_COEF_n` | harmonics, RGB |
//!
//! Axes of glTF: y up. In a PLY, y points down, so the scene is rotated by half a turn about z, as
//! in PlayCanvas's converter. The extension does not store how a scene was trained; VizFlyt stores
//! `antialiased` in `extras`.

mod accessor;
mod container;
mod read;
mod scene;
mod write;

pub(super) use container::MAGIC;
pub(super) use read::decode;
pub(super) use write::encode;

use super::{Format, FormatError};

/// Name of the extension.
const EXTENSION: &str = "KHR_gaussian_splatting";

/// Returns the name of the attribute of one harmonic.
fn harmonic_name(degree: usize, coefficient: usize) -> String {
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{coefficient}")
}

/// Returns an error about a part of a file.
fn invalid(part: impl Into<String>, reason: impl Into<String>) -> FormatError {
    FormatError::Invalid { format: Format::Gltf, place: part.into(), reason: reason.into() }
}

/// Returns an error about an unsupported feature.
fn unsupported(what: impl Into<String>, advice: &'static str) -> FormatError {
    FormatError::Unsupported { format: Format::Gltf, what: what.into(), advice }
}
