//! `.splat`: 32 bytes per splat without a header, as antimatter15's viewer reads it.
//!
//! | bytes | hold |
//! |---|---|
//! | 0..12 | centre, three f32 |
//! | 12..24 | standard deviations, three f32, linear |
//! | 24..28 | red, green, blue (0.5 + c0 times the constant harmonic), opacity; 0 to 255, linear |
//! | 28..32 | quaternion wxyz, each q * 128 + 128 |
//!
//! The format stores only the constant harmonic. Axes are those of the source PLY. There is no
//! magic number, so only the name indicates the format.

use glam::Vec3;

use super::activate::{colour_of_harmonic, harmonic_of_colour};
use super::block::{Gaussian, decode_all};
use super::bytes::f32_at;
use super::progress::Meter;
use super::quantise::to_unorm;
use super::{Format, FormatError, Loaded, assert_whole, limit};
use crate::Splats;

/// Size of one splat. [byte]
const ROW_BYTES: usize = 32;

/// Reads the bytes of a `.splat` file.
pub(super) fn decode(bytes: &[u8], meter: &Meter) -> Result<Loaded, FormatError> {
    let (rows, rest) = bytes.as_chunks::<ROW_BYTES>();
    if !rest.is_empty() {
        return Err(FormatError::Truncated {
            format: Format::Splat,
            what: "a splat of 32 bytes at the end",
            needed: ((rows.len() + 1) * ROW_BYTES) as u64,
            available: bytes.len() as u64,
        });
    }
    limit::count(Format::Splat, rows.len() as u64)?;
    meter.expect(rows.len());
    let (splats, dropped) = decode_all(0, rows.len(), meter, |first, block| {
        for i in 0..block.len() {
            let row = &rows[first + i];
            let three =
                |at: usize| Vec3::new(f32_at(row, at), f32_at(row, at + 4), f32_at(row, at + 8));
            let [w, x, y, z] = [28, 29, 30, 31].map(|at| f32::from(row[at]) - 128.0);
            let gaussian = Gaussian {
                mean_m: three(0),
                scale_m: three(12),
                rotation_xyzw: [x, y, z, w],
                opacity: f32::from(row[27]) / 255.0,
            };
            block.put(i, &gaussian, |_, channel| {
                harmonic_of_colour(f32::from(row[24 + channel]) / 255.0)
            });
        }
    });
    Loaded::whole(Format::Splat, rows.len(), splats, dropped)
}

/// Returns the bytes of a `.splat` file. Harmonics beyond the constant are dropped.
pub(super) fn encode(splats: &Splats) -> Vec<u8> {
    assert_whole(splats);
    let mut bytes = Vec::with_capacity(splats.len() * ROW_BYTES);
    for (i, sh) in splats.sh.chunks_exact(splats.sh_coefficients() * 3).enumerate() {
        let numbers = splats.means_m[i].to_array().into_iter().chain(splats.scales_m[i].to_array());
        bytes.extend(numbers.flat_map(f32::to_le_bytes));
        let colour = [sh[0], sh[1], sh[2]].map(colour_of_harmonic);
        let [r, g, b] = colour;
        bytes.extend([r, g, b, splats.opacities[i]].map(|v| to_unorm(v, 8) as u8));
        let [x, y, z, w] = splats.rotations[i].to_array();
        // `as` saturates at 255.
        bytes.extend([w, x, y, z].map(|v| (v * 128.0 + 128.0).round() as u8));
    }
    bytes
}
