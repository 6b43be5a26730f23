//! glTF 2.0 with `KHR_gaussian_splatting`, ratified by Khronos: `.glb` in one file, or `.gltf` with its buffers beside it.
//!
//! Data flow: `container` finds the JSON and the bytes of each buffer; `scene` is the JSON as far as it concerns splats;
//! `accessor` turns a reference into a column of numbers whose last one is known to lie in its buffer; `read` walks the
//! nodes and puts the splats of every primitive where its node has them. `write` makes one primitive in a `.glb`.
//!
//! | attribute | holds |
//! |---|---|
//! | `POSITION` | centre |
//! | `KHR_gaussian_splatting:ROTATION` | quaternion xyzw |
//! | `KHR_gaussian_splatting:SCALE` | standard deviations, linear; logarithms in drafts of the extension, which is seen by negative ones |
//! | `KHR_gaussian_splatting:OPACITY` | 0 to 1 |
//! | `KHR_gaussian_splatting:SH_DEGREE_l_COEF_n` | harmonics, RGB |
//!
//! Axes of glTF: y up. PLY's y points down, so that all is turned by half a turn about z, as PlayCanvas's converter does.
//! The extension does not say how a scene was trained: `extras` with `antialiased` is ours.

mod accessor;
mod container;
mod read;
mod scene;
mod write;

pub(super) use container::MAGIC;
pub(super) use read::decode;
pub(super) use write::encode;

use super::{Format, FormatError};

/// The extension.
const EXTENSION: &str = "KHR_gaussian_splatting";

/// Returns the name of the attribute of a degree's harmonic.
fn harmonic_name(degree: usize, coefficient: usize) -> String {
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{coefficient}")
}

/// Returns an error about a part of a file.
fn invalid(part: impl Into<String>, reason: impl Into<String>) -> FormatError {
    FormatError::Invalid { format: Format::Gltf, place: part.into(), reason: reason.into() }
}

/// Returns an error about what is not read.
fn unsupported(what: impl Into<String>, advice: &'static str) -> FormatError {
    FormatError::Unsupported { format: Format::Gltf, what: what.into(), advice }
}
