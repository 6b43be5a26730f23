//! Encoder of SOG, version 2: splats to textures.

use std::io::{Cursor, Write as _};

use rayon::prelude::*;
use serde_json::json;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::files::META;
use super::{PALETTE_WIDTH, QUATERNION_TAG, codebook, invalid, palette, texture};
use crate::Splats;
use crate::format::activate::log_scale;
use crate::format::order::morton;
use crate::format::quantise::{smallest_three, to_unorm};
use crate::format::{FormatError, assert_whole};

/// Returns the number of palette entries: as in PlayCanvas's writer, a power of two near the number
/// of splats, between 1024 and the range of a 16-bit index.
fn palette_size(count: usize) -> usize {
    (count / 2 + 1).next_power_of_two().clamp(1 << 10, 1 << 16)
}

/// Returns the bytes of a `.sog` file: the [`parts`] in a ZIP, without further compression.
pub(in crate::format) fn encode(splats: &Splats) -> Result<Vec<u8>, FormatError> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, bytes) in parts(splats)? {
        let written = archive
            .start_file(name, stored)
            .and_then(|()| archive.write_all(&bytes).map_err(Into::into));
        written.map_err(|error| invalid(name, error.to_string()))?;
    }
    let bytes = archive.finish().map_err(|error| invalid("ZIP archive", error.to_string()))?;
    Ok(bytes.into_inner())
}

/// File of a scene: name and content.
type Part = (&'static str, Vec<u8>);
/// Texture to encode.
type Job<'a> = Box<dyn Fn() -> Result<Part, FormatError> + Send + Sync + 'a>;

/// Returns the files of a scene, `meta.json` last. The encoding is lossy: 16 bits for positions, 8
/// bits for everything else, harmonics from a palette. Splats are in Z-order.
pub(in crate::format) fn parts(splats: &Splats) -> Result<Vec<Part>, FormatError> {
    assert_whole(splats);
    let order = morton(splats);
    let (count, coefficients) = (splats.len(), splats.sh_coefficients());
    // About square, in multiples of 4, which suits graphics cards.
    let width = (count as f64).sqrt().div_euclid(4.0) as usize * 4 + 4;
    let height = count.div_ceil(width).next_multiple_of(4).max(4);

    let warp = |coordinate: f32| coordinate.abs().ln_1p().copysign(coordinate);
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for mean_m in &splats.means_m {
        for (axis, coordinate) in mean_m.to_array().into_iter().enumerate() {
            low[axis] = low[axis].min(warp(coordinate));
            high[axis] = high[axis].max(warp(coordinate));
        }
    }
    if splats.is_empty() {
        (low, high) = ([0.0; 3], [0.0; 3]);
    }
    let mean = |i: usize| -> [u16; 3] {
        std::array::from_fn(|axis| {
            let extent = high[axis] - low[axis];
            let share = (warp(splats.means_m[i][axis]) - low[axis]) / extent;
            if extent > 0.0 { to_unorm(share, 16) as u16 } else { 0 }
        })
    };
    let logs = |i: usize| splats.scales_m[i].to_array().map(log_scale);
    let constants = |i: usize| -> [f32; 3] {
        std::array::from_fn(|channel| splats.sh[i * coefficients * 3 + channel])
    };
    let every = |values: &dyn Fn(usize) -> [f32; 3]| (0..count).flat_map(values).collect();
    let scales = codebook::build(every(&logs));
    let colours = codebook::build(every(&constants));

    let pixels = |pixel: &dyn Fn(usize) -> [u8; 3]| -> Vec<[u8; 3]> {
        let mut pixels: Vec<[u8; 3]> = order.iter().map(|&i| pixel(i as usize)).collect();
        pixels.resize(width * height, [0; 3]);
        pixels
    };
    let with_alpha = |pixel: &dyn Fn(usize) -> [u8; 4]| -> Vec<[u8; 4]> {
        let mut pixels: Vec<[u8; 4]> = order.iter().map(|&i| pixel(i as usize)).collect();
        pixels.resize(width * height, [0; 4]);
        pixels
    };
    let quaternion = |i: usize| -> [u8; 4] {
        let [x, y, z, w] = splats.rotations[i].to_array();
        let (largest, others) = smallest_three([w, x, y, z]);
        let [a, b, c] = others.map(|v| to_unorm(v * 0.5 + 0.5, 8) as u8);
        [a, b, c, QUATERNION_TAG + largest as u8]
    };
    let colour = |i: usize| -> [u8; 4] {
        let [r, g, b] = constants(i).map(|value| codebook::nearest(&colours, value));
        [r, g, b, to_unorm(splats.opacities[i], 8) as u8]
    };
    let harmonics = (coefficients > 1).then(|| {
        let dimensions = (coefficients - 1) * 3;
        let vectors: Vec<f32> =
            splats.sh.chunks_exact(coefficients * 3).flat_map(|sh| &sh[3..]).copied().collect();
        let palette = palette::build(&vectors, dimensions, palette_size(count));
        let values = codebook::build(palette.entries.clone());
        let entries = palette.entries.len() / dimensions;
        let rows = entries.div_ceil(PALETTE_WIDTH);
        let mut texels: Vec<[u8; 3]> = palette
            .entries
            .as_chunks::<3>()
            .0
            .iter()
            .map(|rgb| rgb.map(|value| codebook::nearest(&values, value)))
            .collect();
        texels.resize(PALETTE_WIDTH * (coefficients - 1) * rows, [0; 3]);
        (palette.labels, values, entries, texels)
    });

    let mut jobs: Vec<Job> = vec![
        Box::new(|| {
            let pixels = pixels(&|i| mean(i).map(|v| v.to_le_bytes()[0]));
            Ok(("means_l.webp", texture::encode("means_l.webp", &pixels, width)?))
        }),
        Box::new(|| {
            let pixels = pixels(&|i| mean(i).map(|v| v.to_le_bytes()[1]));
            Ok(("means_u.webp", texture::encode("means_u.webp", &pixels, width)?))
        }),
        Box::new(|| {
            let pixels = pixels(&|i| logs(i).map(|value| codebook::nearest(&scales, value)));
            Ok(("scales.webp", texture::encode("scales.webp", &pixels, width)?))
        }),
        Box::new(|| {
            let pixels = with_alpha(&quaternion);
            Ok(("quats.webp", texture::encode("quats.webp", &pixels, width)?))
        }),
        Box::new(|| {
            let pixels = with_alpha(&colour);
            Ok(("sh0.webp", texture::encode("sh0.webp", &pixels, width)?))
        }),
    ];
    if let Some((labels, _, _, texels)) = &harmonics {
        jobs.push(Box::new(move || {
            let width = PALETTE_WIDTH * (coefficients - 1);
            Ok(("shN_centroids.webp", texture::encode("shN_centroids.webp", texels, width)?))
        }));
        jobs.push(Box::new(|| {
            let pixels = pixels(&|i| {
                let [low, high] = labels[i].to_le_bytes();
                [low, high, 0]
            });
            Ok(("shN_labels.webp", texture::encode("shN_labels.webp", &pixels, width)?))
        }));
    }
    let mut parts: Vec<Part> =
        jobs.into_par_iter().map(|job| job()).collect::<Result<_, FormatError>>()?;

    let mut meta = json!({
        "version": 2,
        "asset": { "generator": "vizflyt" },
        "count": count,
        "means": { "mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": scales.to_vec(), "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": colours.to_vec(), "files": ["sh0.webp"] },
    });
    if splats.antialiased {
        meta["antialias"] = true.into();
        meta["model"] = "antialiased".into();
    }
    if let Some((_, values, entries, _)) = &harmonics {
        meta["shN"] = json!({
            "count": entries,
            "bands": splats.sh_degree,
            "codebook": values.to_vec(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    parts.push((META, meta.to_string().into_bytes()));
    Ok(parts)
}
