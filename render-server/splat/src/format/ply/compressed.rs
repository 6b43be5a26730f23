//! Decoder of SuperSplat's compressed PLY.
//!
//! | element | per | holds |
//! |---|---|---|
//! | `chunk` | 256 splats | f32 bounds: `min_x ..  max_z`, `min_scale_x .. max_scale_z` (log scale), and in newer files `min_r .. max_b` (colour) |
//! | `vertex` | splat | four u32, from the top bit: `packed_position` 11-10-11 and `packed_scale` 11-10-11 between the bounds; `packed_rotation` 2-10-10-10, the index of the largest of wxyz and the others from -1/sqrt(2) to 1/sqrt(2); `packed_color` 8-8-8-8, colour (between the bounds, or 0 to 1) and opacity |
//! | `sh` | splat | optional bytes `f_rest_*`, channel-major as in the plain file, -4 to 4 |
//!
//! Colour is the constant harmonic as 0.5 + c0 h; opacity is linear.

use glam::Vec3;

use super::PlyError;
use super::header::{Element, Format, Header, PropertyKind, Scalar, VERTEX};
use super::rows::fixed_length;
use crate::Splats;
use crate::format::DropCounts;
use crate::format::activate::{exp, harmonic_of_colour};
use crate::format::block::{Gaussian, decode_all};
use crate::format::progress::Meter;
use crate::format::quantise::{unorm, wxyz_of_smallest_three};

/// Elements of this layout.
pub(super) const ELEMENTS: [&str; 3] = ["chunk", VERTEX, "sh"];
/// Number of splats that share bounds.
pub(super) const CHUNK: usize = 256;
/// Bounds of every chunk, in the order of [`Bounds`].
pub(super) const BOUNDS: [&str; 12] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
];
/// Additional bounds in newer files.
pub(super) const COLOUR_BOUNDS: [&str; 6] = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
/// Properties with packed words.
pub(super) const PACKED: [&str; 4] =
    ["packed_position", "packed_rotation", "packed_scale", "packed_color"];

/// Returns whether the vertices of a file are packed.
pub(super) fn is_compressed(header: &Header) -> bool {
    header.vertex().properties.iter().any(|property| property.name == PACKED[0])
}

/// Decodes a compressed file.
pub(super) fn read(
    bytes: &[u8],
    header: &Header,
    meter: &Meter,
) -> Result<(Splats, DropCounts), PlyError> {
    if header.format != Format::BinaryLittleEndian {
        return Err(fail("a compressed PLY is binary_little_endian, this one is ascii".into()));
    }
    let (mut chunk, mut vertex, mut sh) = (None, None, None);
    let mut offset = header.body;
    for element in &header.elements {
        let Some(stride) = element.fixed_row_bytes() else {
            return Err(fail(format!("element `{}` of a compressed PLY has a list", element.name)));
        };
        let length = fixed_length(bytes, offset, element, stride)?;
        let table = Table { element, stride, bytes: &bytes[offset..offset + length] };
        match element.name.as_str() {
            "chunk" => chunk = Some(table),
            VERTEX => vertex = Some(table),
            "sh" => sh = Some(table),
            _ => {}
        }
        offset += length;
    }
    let (Some(chunk), Some(vertex)) = (chunk, vertex) else {
        return Err(fail("the vertices are packed, but there is no element `chunk`".into()));
    };
    let count = vertex.element.count;
    if chunk.element.count < count.div_ceil(CHUNK) {
        return Err(fail(format!(
            "{} chunks for {count} splats; one per {CHUNK} is needed",
            chunk.element.count
        )));
    }
    let bounds = BOUNDS.map(|name| chunk.column(name, Scalar::F32));
    let coloured = chunk.has(COLOUR_BOUNDS[0]);
    let colour_bounds = if coloured {
        Some(COLOUR_BOUNDS.map(|name| chunk.column(name, Scalar::F32)))
    } else {
        None
    };
    let bounds = all(bounds)?;
    let colour_bounds = colour_bounds.map(all).transpose()?;
    let packed = all(PACKED.map(|name| vertex.column(name, Scalar::U32)))?;
    let (sh_degree, rest) = match &sh {
        None => (0, Vec::new()),
        Some(table) => harmonics(table, count)?,
    };
    let per_channel = rest.len() / 3;

    let levels: Vec<f32> = (0..=255).map(harmonic).collect();
    Ok(decode_all(sh_degree, count, meter, |first, block| {
        for i in 0..block.len() {
            let row = first + i;
            let bound = |at: usize| chunk.f32(row / CHUNK, at);
            let between = |t: Vec3, low: &[usize], high: &[usize]| {
                let (low, high) = (
                    Vec3::new(bound(low[0]), bound(low[1]), bound(low[2])),
                    Vec3::new(bound(high[0]), bound(high[1]), bound(high[2])),
                );
                low * (Vec3::ONE - t) + high * t
            };
            let [position, rotation, scale, colour] = packed.map(|at| vertex.u32(row, at));
            let [red, green, blue, alpha] = [24, 16, 8, 0].map(|shift| unorm(colour >> shift, 8));
            let mut rgb = Vec3::new(red, green, blue);
            if let Some(bounds) = &colour_bounds {
                rgb = between(rgb, &bounds[..3], &bounds[3..]);
            }
            let [w, x, y, z] = wxyz_of_smallest_three(
                rotation >> 30,
                [20, 10, 0].map(|shift| unorm(rotation >> shift, 10) * 2.0 - 1.0),
            );
            let gaussian = Gaussian {
                mean_m: between(thirds(position), &bounds[..3], &bounds[3..6]),
                scale_m: exp(between(thirds(scale), &bounds[6..9], &bounds[9..])),
                rotation_xyzw: [x, y, z, w],
                opacity: alpha,
            };
            block.put(i, &gaussian, |k, channel| match (k, &sh) {
                (0, _) => harmonic_of_colour(rgb[channel]),
                (_, Some(table)) => {
                    let at = rest[channel * per_channel + k - 1];
                    levels[usize::from(table.bytes[row * table.stride + at])]
                }
                (_, None) => 0.0,
            });
        }
    }))
}

/// Returns a harmonic from its byte: the middle of the quantisation step, except at both ends.
fn harmonic(byte: u16) -> f32 {
    let unit = match byte {
        0 => 0.0,
        255 => 1.0,
        _ => (f32::from(byte) + 0.5) / 256.0,
    };
    (unit - 0.5) * 8.0
}

/// Returns the degree of the stored harmonics, and the column of each harmonic, channel-major.
fn harmonics(table: &Table, count: usize) -> Result<(u8, Vec<usize>), PlyError> {
    let found = table.element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let degree = match found {
        9 => 1,
        24 => 2,
        45 => 3,
        _ => return Err(PlyError::HarmonicsCount { found }),
    };
    if table.element.count != count {
        return Err(fail(format!("{} rows of `sh` for {count} splats", table.element.count)));
    }
    let columns = (0..found).map(|i| table.column(&format!("f_rest_{i}"), Scalar::U8));
    Ok((degree, columns.collect::<Result<_, _>>()?))
}

/// Returns three numbers of 11, 10 and 11 bits, scaled to 0 to 1.
fn thirds(word: u32) -> Vec3 {
    Vec3::new(unorm(word >> 21, 11), unorm(word >> 11, 10), unorm(word, 11))
}

/// Element and its rows.
struct Table<'a> {
    element: &'a Element,
    stride: usize,
    bytes: &'a [u8],
}

impl Table<'_> {
    fn has(&self, name: &str) -> bool {
        self.element.properties.iter().any(|property| property.name == name)
    }

    /// Returns the offset of a column in a row.
    fn column(&self, name: &str, expected: Scalar) -> Result<usize, PlyError> {
        let mut at = 0;
        for property in &self.element.properties {
            let PropertyKind::Scalar(scalar) = property.kind else { continue };
            if property.name == name {
                if scalar != expected {
                    return Err(fail(format!("`{name}` of a compressed PLY is {scalar:?}")));
                }
                return Ok(at);
            }
            at += scalar.bytes();
        }
        Err(fail(format!("element `{}` of a compressed PLY lacks `{name}`", self.element.name)))
    }

    #[inline]
    fn four(&self, row: usize, at: usize) -> [u8; 4] {
        let at = row * self.stride + at;
        [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2], self.bytes[at + 3]]
    }

    #[inline]
    fn f32(&self, row: usize, at: usize) -> f32 {
        f32::from_le_bytes(self.four(row, at))
    }

    #[inline]
    fn u32(&self, row: usize, at: usize) -> u32 {
        u32::from_le_bytes(self.four(row, at))
    }
}

/// Converts an array of results to a result of an array.
fn all<const N: usize>(columns: [Result<usize, PlyError>; N]) -> Result<[usize; N], PlyError> {
    let mut out = [0; N];
    for (out, column) in out.iter_mut().zip(columns) {
        *out = column?;
    }
    Ok(out)
}

fn fail(reason: String) -> PlyError {
    PlyError::NotSplats { reason }
}
