//! PLY files of 3D Gaussian splats: the layout of INRIA's trainer, as splatfacto, brush and
//! PostShot write it, and SuperSplat's compressed layout ([`write_compressed`]).
//!
//! Data flow, once per scene: `header` parses the header text to elements and typed properties.
//! Plain files: `layout` finds the properties of a splat (in any order, among others) and their
//! offsets in a row; `rows` walks the elements (fixed or variable length, binary or ascii), checks
//! that the file is as long as the header declares *before* it allocates, and decodes in parallel,
//! from log scales, logit opacities and wxyz quaternions. Compressed files: `compressed`. `write`
//! and `compressed_write` encode.
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
//! Two comments of the header indicate training with anti-aliasing: brush's `SplatRenderMode: mip`,
//! which is also written, and PostShot's `antialiased 1`.
//!
//! Axes are those of the training, by convention x right, y down, z forward of the first camera
//! (RDF).
//!
//! Budget: 1 M splats of degree 3 are 248 MB; decoding is limited by memory bandwidth and `exp`.

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
/// The defect that makes the file invalid, with the byte offset or the name of the property;
/// [`PlyError::Empty`] if no valid splat is left.
pub fn parse(bytes: &[u8]) -> Result<Loaded, PlyError> {
    decode(bytes, &Meter::SILENT)
}

/// Parses a file as [`parse`] does, and reports progress.
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
