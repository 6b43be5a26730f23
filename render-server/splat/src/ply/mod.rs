//! 3D Gaussian splats in PLY files: the layout of INRIA's trainer, as splatfacto and brush write it.
//!
//! Data flow, once per scene: `file` maps the bytes; `header` turns the text on top into elements
//! and typed properties; `layout` finds the properties that make a splat (in any order, among any
//! others) and where each lies in a row; `rows` walks the elements (fixed or variable length,
//! binary or ascii), checks that the file is as long as the header promises *before* it allocates,
//! and decodes in parallel; `decode` turns log scales, logit opacity and wxyz quaternions into
//! [`Splats`], dropping and counting what cannot be drawn. `write` is the way back.
//!
//! Budget: 1 M splats of degree 3 are 248 MB; decoding is bound by memory and `exp`.

mod decode;
mod error;
mod file;
mod header;
mod layout;
mod rows;
mod write;

use std::path::Path;

pub use error::PlyError;
pub use write::{encode, write};

use crate::Splats;

/// A scene as read from a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Loaded {
    /// What can be drawn, in file order.
    pub splats: Splats,
    /// What was left out, by reason.
    pub dropped: DropCounts,
    /// Names of properties of the vertex element that no splat needs, in file order.
    pub skipped_properties: Vec<String>,
    /// Names of elements other than `vertex`, in file order.
    pub skipped_elements: Vec<String>,
}

/// Splats that a file held and that cannot be drawn, by reason; each is counted once, under the
/// first reason that applies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DropCounts {
    /// A NaN, or an infinity where only a finite number has a meaning. (An infinite opacity logit
    /// is kept: it means fully transparent or fully opaque. So is a log scale of -infinity: zero.)
    pub non_finite: usize,
    /// The quaternion is zero, so it names no rotation.
    pub zero_rotation: usize,
    /// A log scale whose exponential is beyond `f32`.
    pub scale_overflow: usize,
}

impl DropCounts {
    /// Returns how many were dropped for any reason.
    pub fn total(&self) -> usize {
        self.non_finite + self.zero_rotation + self.scale_overflow
    }
}

/// Reads a splat scene from a PLY file.
///
/// # Errors
/// [`PlyError::Io`] with the path; otherwise as [`parse`].
pub fn read(path: impl AsRef<Path>) -> Result<Loaded, PlyError> {
    let path = path.as_ref();
    let mapped = file::map(path).map_err(|source| PlyError::Io {
        path: path.to_owned(),
        verb: "read",
        source,
    })?;
    parse(&mapped)
}

/// Reads a splat scene from the bytes of a PLY file.
///
/// # Errors
/// Whatever keeps the file from being a splat scene, with the byte offset or the property's name;
/// [`PlyError::Empty`] where nothing is left to draw.
pub fn parse(bytes: &[u8]) -> Result<Loaded, PlyError> {
    let header = header::Header::parse(bytes)?;
    let layout = layout::Layout::find(&header)?;
    let (splats, dropped) = match header.format {
        header::Format::BinaryLittleEndian => rows::read_binary(bytes, &header, &layout)?,
        header::Format::Ascii => rows::read_ascii(bytes, &header, &layout)?,
    };
    if splats.is_empty() {
        return Err(PlyError::Empty { declared: header.vertex().count, dropped: dropped.total() });
    }
    let skipped_properties = layout.skipped(&header);
    let skipped_elements = header
        .elements
        .iter()
        .filter(|element| element.name != header::VERTEX)
        .map(|element| element.name.clone())
        .collect();
    Ok(Loaded { splats, dropped, skipped_properties, skipped_elements })
}

#[cfg(test)]
mod tests;
