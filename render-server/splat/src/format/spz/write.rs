//! Encoder of `.spz`: splats to bytes.

use std::io::Write as _;

use flate2::Compression;
use flate2::write::GzEncoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::{COLOUR_SCALE, FLAG_ANTIALIASED, HARMONIC_SIGNS, MAGIC};
use crate::Splats;
use crate::format::activate::log_scale;
use crate::format::assert_whole;
use crate::format::quantise::{smallest_three, to_unorm};

/// Default fractional bits of positions, as in Niantic's writer: steps of a quarter of a
/// millimetre.
const FRACTIONAL_BITS: u8 = 12;
/// Stored bits of harmonics of degree 1, and of higher degrees, as in Niantic's writer.
const HARMONIC_BITS: [u32; 2] = [5, 4];

/// Returns the bytes of a `.spz` file. The encoding is lossy: positions in steps of 1/4096 m
/// (coarser if the scene extends beyond 2 km), harmonics clamped to -1 to 1.
///
/// # Panics
/// If `version` is not 2, 3 or 4.
pub(in crate::format) fn encode(splats: &Splats, version: u32) -> Vec<u8> {
    assert!((2..=4).contains(&version), "version {version}");
    assert_whole(splats);
    let (count, coefficients) = (splats.len(), splats.sh_coefficients());
    let reach_m = splats.means_m.iter().fold(0.0f32, |reach, m| reach.max(m.abs().max_element()));
    let fits = |bits: u8| f64::from(reach_m) * f64::from(1u32 << bits) < f64::from((1 << 23) - 1);
    let fractional_bits = (0..=FRACTIONAL_BITS).rev().find(|&bits| fits(bits)).unwrap_or(0);
    let step = (1u32 << fractional_bits) as f32;

    let mut attributes: [Vec<u8>; 6] = Default::default();
    let [positions, alphas, colours, scales, rotations, harmonics] = &mut attributes;
    for i in 0..count {
        let mean_m = splats.means_m[i];
        for coordinate in [mean_m.x, -mean_m.y, -mean_m.z] {
            let fixed = (coordinate * step).round().clamp(-8_388_608.0, 8_388_607.0) as i32;
            positions.extend_from_slice(&fixed.to_le_bytes()[..3]);
        }
        alphas.push(to_unorm(splats.opacities[i], 8) as u8);
        let sh = &splats.sh[i * coefficients * 3..][..coefficients * 3];
        colours.extend(sh[..3].iter().map(|dc| to_unorm(dc * COLOUR_SCALE + 0.5, 8) as u8));
        scales.extend(
            // `as` saturates.
            splats.scales_m[i].to_array().map(|s| ((log_scale(s) + 10.0) * 16.0).round() as u8),
        );
        let [x, y, z, w] = splats.rotations[i].to_array();
        let xyzw = [x, -y, -z, w];
        if version < 3 {
            // w is not stored, so it must not be negative.
            let sign = if w < 0.0 { -127.5 } else { 127.5 };
            rotations.extend(xyzw[..3].iter().map(|q| (q * sign + 127.5).round() as u8));
        } else {
            let (largest, others) = smallest_three(xyzw);
            let word = others.into_iter().fold(largest, |word, v| {
                let size = (v.abs() * 511.0).round().min(511.0) as u32;
                word << 10 | u32::from(v < 0.0) << 9 | size
            });
            rotations.extend_from_slice(&word.to_le_bytes());
        }
        for (k, rgb) in sh.chunks_exact(3).enumerate().skip(1) {
            let bits = HARMONIC_BITS[usize::from(k > 3)];
            harmonics.extend(rgb.iter().map(|h| harmonic(h * HARMONIC_SIGNS[k], bits)));
        }
    }

    let mut header = Vec::with_capacity(32);
    for word in [MAGIC, version, count as u32] {
        header.extend_from_slice(&word.to_le_bytes());
    }
    let flags = if splats.antialiased { FLAG_ANTIALIASED } else { 0 };
    header.extend([splats.sh_degree, fractional_bits, flags, 0]);
    if version < 4 {
        let mut stream = GzEncoder::new(Vec::new(), Compression::default());
        let mut parts = std::iter::once(&header).chain(&attributes);
        let written = parts.try_for_each(|part| stream.write_all(part));
        return written.and_then(|()| stream.finish()).expect("memory takes every write");
    }
    // Without harmonics, the sixth stream is omitted; readers check the number of streams.
    let attributes = &attributes[..if coefficients > 1 { 6 } else { 5 }];
    let streams: Vec<Vec<u8>> = attributes
        .iter()
        .map(|attribute| compress_to_vec(attribute.as_slice(), CompressionLevel::Fastest))
        .collect();
    header[15] = streams.len() as u8;
    header.extend_from_slice(&32u32.to_le_bytes());
    header.resize(32, 0);
    for (stream, attribute) in streams.iter().zip(attributes) {
        header.extend_from_slice(&(stream.len() as u64).to_le_bytes());
        header.extend_from_slice(&(attribute.len() as u64).to_le_bytes());
    }
    header.extend(streams.into_iter().flatten());
    header
}

/// Returns the byte of a harmonic, rounded to its `bits` highest bits.
fn harmonic(value: f32, bits: u32) -> u8 {
    let step = (1 << (8 - bits)) as f32;
    // 128 means zero, and is a multiple of every step; `as` saturates.
    let byte = ((value * 128.0 + 128.0) / step).round() * step;
    byte.min(255.0) as u8
}
