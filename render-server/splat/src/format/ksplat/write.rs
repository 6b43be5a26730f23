//! Encoder of `.ksplat`: splats to bytes, in one section.

use std::collections::BTreeMap;

use glam::{IVec3, Vec3};
use half::f16;

use super::{BUCKET_BYTES, DEFAULT_RANGE, HEADER_BYTES, Row, SECTION_BYTES, harmonic_index};
use crate::Splats;
use crate::format::activate::colour_of_harmonic;
use crate::format::assert_whole;
use crate::format::quantise::to_unorm;

/// Edge of a bucket's cube, as in the viewer's own writer. Positions have steps of 76 um. [m]
const BLOCK_M: f32 = 5.0;
/// Splats per full bucket.
const BUCKET: usize = 256;
/// Highest degree that the format supports.
pub(in crate::format) const MAX_SH_DEGREE: u8 = 2;

/// Returns the bytes of a `.ksplat` file. Harmonics beyond degree 2 are dropped.
///
/// # Panics
/// If `level` exceeds 2.
pub(in crate::format) fn encode(splats: &Splats, level: u32) -> Vec<u8> {
    assert_whole(splats);
    let row = Row::LEVELS[level as usize];
    let (count, coefficients) = (splats.len(), splats.sh_coefficients());
    let sh_degree = splats.sh_degree.min(MAX_SH_DEGREE);
    let kept = (usize::from(sh_degree) + 1).pow(2);
    let harmonics =
        || splats.sh.chunks_exact(coefficients * 3).flat_map(move |sh| sh[3..kept * 3].iter());
    let low = harmonics().fold(0.0f32, |low, &h| low.min(h));
    let high = harmonics().fold(0.0f32, |high, &h| high.max(h));

    let (full, partial) = if level == 0 { (Vec::new(), Vec::new()) } else { buckets(splats) };
    let mut bytes = vec![0; HEADER_BYTES + SECTION_BYTES];
    let mut put = |at: usize, number: &[u8]| bytes[at..at + number.len()].copy_from_slice(number);
    put(0, &[0, 1]);
    for (at, word) in [(4, 1), (8, 1), (12, count as u32), (16, count as u32)] {
        put(at, &word.to_le_bytes());
    }
    put(20, &(level as u16).to_le_bytes());
    put(36, &low.to_le_bytes());
    put(40, &high.to_le_bytes());
    let section = HEADER_BYTES;
    put(section, &(count as u32).to_le_bytes());
    put(section + 4, &(count as u32).to_le_bytes());
    put(section + 40, &u16::from(sh_degree).to_le_bytes());
    if level > 0 {
        let words = [
            (8, BUCKET),
            (12, full.len() + partial.len()),
            (24, DEFAULT_RANGE as usize),
            (32, full.len()),
            (36, partial.len()),
        ];
        for (at, word) in words {
            put(section + at, &(word as u32).to_le_bytes());
        }
        put(section + 16, &BLOCK_M.to_le_bytes());
        put(section + 20, &(BUCKET_BYTES as u16).to_le_bytes());
    }
    for bucket in &partial {
        bytes.extend_from_slice(&(bucket.splats.len() as u32).to_le_bytes());
    }
    for bucket in full.iter().chain(&partial) {
        bytes.extend(bucket.centre_m.to_array().into_iter().flat_map(f32::to_le_bytes));
    }

    let number = |value: f32, out: &mut Vec<u8>| match level {
        0 => out.extend_from_slice(&value.to_le_bytes()),
        _ => out.extend_from_slice(&f16::from_f32(value).to_bits().to_le_bytes()),
    };
    let order: Vec<(usize, Vec3)> = if level == 0 {
        (0..count).map(|i| (i, Vec3::ZERO)).collect()
    } else {
        let of_bucket = |b: &Bucket| b.splats.iter().map(|&i| (i, b.centre_m)).collect::<Vec<_>>();
        full.iter().chain(&partial).flat_map(of_bucket).collect()
    };
    for (i, centre_m) in order {
        for (coordinate, centre) in
            splats.means_m[i].to_array().into_iter().zip(centre_m.to_array())
        {
            if level == 0 {
                number(coordinate, &mut bytes);
            } else {
                let range = DEFAULT_RANGE as f32;
                let steps = ((coordinate - centre) / (BLOCK_M / 2.0) * range).round() + range;
                // `as` saturates.
                bytes.extend_from_slice(&(steps as u16).to_le_bytes());
            }
        }
        for scale in splats.scales_m[i].to_array() {
            number(scale, &mut bytes);
        }
        let [x, y, z, w] = splats.rotations[i].to_array();
        for q in [w, x, y, z] {
            number(q, &mut bytes);
        }
        let sh = &splats.sh[i * coefficients * 3..][..coefficients * 3];
        let [r, g, b] = [sh[0], sh[1], sh[2]].map(colour_of_harmonic);
        bytes.extend([r, g, b, splats.opacities[i]].map(|v| to_unorm(v, 8) as u8));
        let mut stored = [0.0; 45];
        for k in 1..kept {
            for channel in 0..3 {
                stored[harmonic_index(k, channel)] = sh[k * 3 + channel];
            }
        }
        for &harmonic in &stored[..(kept - 1) * 3] {
            match level {
                2 => bytes.push(to_unorm((harmonic - low) / (high - low), 8) as u8),
                _ => number(harmonic, &mut bytes),
            }
        }
    }
    debug_assert_eq!(
        bytes.len(),
        HEADER_BYTES
            + SECTION_BYTES
            + full.len() * BUCKET_BYTES
            + partial.len() * (BUCKET_BYTES + 4)
            + count * row.bytes(sh_degree)
    );
    bytes
}

/// Splats in one cube of space.
struct Bucket {
    centre_m: Vec3,
    splats: Vec<usize>,
}

/// Returns the full buckets and the partial buckets.
fn buckets(splats: &Splats) -> (Vec<Bucket>, Vec<Bucket>) {
    let mut open: BTreeMap<[i32; 3], Bucket> = BTreeMap::new();
    let mut full = Vec::new();
    for (i, &mean_m) in splats.means_m.iter().enumerate() {
        // `as` saturates: splats beyond 10 million km are put into the last cube.
        let cube: IVec3 = (mean_m / BLOCK_M).floor().as_ivec3();
        let bucket = open.entry(cube.to_array()).or_insert_with(|| Bucket {
            centre_m: (cube.as_vec3() + 0.5) * BLOCK_M,
            splats: Vec::with_capacity(BUCKET),
        });
        bucket.splats.push(i);
        if bucket.splats.len() == BUCKET {
            full.extend(open.remove(&cube.to_array()));
        }
    }
    (full, open.into_values().collect())
}
