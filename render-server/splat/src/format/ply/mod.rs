//! 3D Gaussian splats in PLY files: the layout of INRIA's trainer, as splatfacto, brush and PostShot
//! write it, and the compressed one of SuperSplat ([`write_compressed`]).
//!
//! Data flow, once per scene: `header` turns the text on top into elements and typed properties. A
//! plain file: `layout` finds the properties that make a splat (in any order, among any others) and
//! where each lies in a row; `rows` walks the elements (fixed or variable length, binary or ascii),
//! checks that the file is as long as the header promises *before* anything is allocated, and
//! decodes in parallel, from log scales, logit opacities and wxyz quaternions. A compressed one:
//! `compressed`. `write` is the way back of both.
//!
//! | property | holds |
//! |---|---|
//! | `x y z` | centre |
//! | `f_dc_0..2` | constant harmonic of red, green, blue; or bytes `red green blue` of 0 to 255 |
//! | `f_rest_*` | the others, 3, 8 or 15 per channel: all of red, all of green, all of blue |
//! | `opacity` | logit |
//! | `scale_0..2` | natural logarithm of the standard deviation |
//! | `rot_0..3` | quaternion wxyz, of any length |
//!
//! Of the comments on top, those count that say that the scene was trained with anti-aliasing: brush's
//! `SplatRenderMode: mip`, which is written too, and PostShot's `antialiased 1`.
//!
//! Axes are those of the training, by custom x right, y down, z ahead of the first camera (RDF).
//!
//! Budget: 1 M splats of degree 3 are 248 MB; decoding is bound by memory and `exp`.

mod compressed;
mod compressed_write;
mod error;
mod header;
mod layout;
mod rows;
mod write;

use std::path::Path;

pub use compressed_write::{encode_compressed, write_compressed};
pub use error::PlyError;
pub use write::{encode, write};

use super::progress::Meter;
pub use super::{DropCounts, Loaded};
use super::{Format, file};

/// Reads a splat scene from a PLY file, plain or compressed.
///
/// # Errors
/// [`PlyError::Io`] with the path; otherwise as [`parse`].
pub fn read(path: impl AsRef<Path>) -> Result<Loaded, PlyError> {
    let path = path.as_ref();
    let mapped = file::map(path).map_err(|cause| PlyError::Io {
        path: path.to_owned(),
        verb: "read",
        cause,
    })?;
    parse(&mapped)
}

/// Reads a splat scene from the bytes of a PLY file, plain or compressed.
///
/// # Errors
/// Whatever keeps the file from being a splat scene, with the byte offset or the property's name;
/// [`PlyError::Empty`] where nothing is left to render.
pub fn parse(bytes: &[u8]) -> Result<Loaded, PlyError> {
    decode(bytes, &Meter::SILENT)
}

/// [`parse`], reporting its progress.
pub(super) fn decode(bytes: &[u8], meter: &Meter) -> Result<Loaded, PlyError> {
    let header = header::Header::parse(bytes)?;
    meter.expect(header.vertex().count);
    let (format, (mut splats, dropped), used, skipped_properties);
    if compressed::is_compressed(&header) {
        format = Format::CompressedPly;
        used = &compressed::ELEMENTS[..];
        skipped_properties = Vec::new();
        (splats, dropped) = compressed::read(bytes, &header, meter)?;
    } else {
        format = Format::Ply;
        let layout = layout::Layout::find(&header)?;
        used = &[header::VERTEX][..];
        skipped_properties = layout.skipped(&header);
        (splats, dropped) = match header.format {
            header::Format::BinaryLittleEndian => {
                rows::read_binary(bytes, &header, &layout, meter)?
            }
            header::Format::Ascii => rows::read_ascii(bytes, &header, &layout, meter)?,
        };
    }
    if splats.is_empty() {
        return Err(PlyError::Empty { declared: header.vertex().count, dropped: dropped.total() });
    }
    let elements = header.elements.iter().map(|element| element.name.clone());
    let skipped_elements = elements.filter(|name| !used.contains(&name.as_str())).collect();
    splats.antialiased = header.antialiased;
    Ok(Loaded { format, splats, dropped, skipped_properties, skipped_elements })
}

#[cfg(test)]
mod tests;
