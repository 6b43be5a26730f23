//! Encoder of SuperSplat's compressed PLY.

use std::path::Path;

use super::PlyError;
use super::compressed::{BOUNDS, CHUNK, COLOUR_BOUNDS, PACKED};
use super::header::ANTIALIASED;
use crate::Splats;
use crate::format::activate::{colour_of_harmonic, log_scale};
use crate::format::order::morton;
use crate::format::quantise::{smallest_three, to_unorm};
use crate::format::{assert_whole, file};

/// Range of log scales that viewers of this format accept; e^-20 m is far below any visible size.
const LOG_SCALES: (f32, f32) = (-20.0, 20.0);

/// Writes a scene as SuperSplat's compressed PLY. The encoding is lossy: splats are in Z-order, so
/// that splats with shared bounds are neighbours, and harmonics are clamped to -4 to 4.
///
/// # Errors
/// [`PlyError::Io`] with the path.
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn write_compressed(path: impl AsRef<Path>, splats: &Splats) -> Result<(), PlyError> {
    let path = path.as_ref();
    file::replace(path, &encode_compressed(splats)).map_err(|cause| PlyError::Io {
        path: path.to_owned(),
        verb: "write",
        cause,
    })
}

/// Returns the bytes that [`write_compressed`] writes.
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn encode_compressed(splats: &Splats) -> Vec<u8> {
    assert_whole(splats);
    let (count, coefficients) = (splats.len(), splats.sh_coefficients());
    let rest = (coefficients - 1) * 3;
    let property = |kind: &str, name: &str| ["property ", kind, " ", name, "\n"].concat();
    let bounds = BOUNDS.iter().chain(&COLOUR_BOUNDS).map(|name| property("float", name));
    let packed = PACKED.iter().map(|name| property("uint", name));
    let harmonics = (0..rest).map(|i| property("uchar", &format!("f_rest_{i}")));
    let comment = if splats.antialiased { ANTIALIASED } else { "" };
    let chunks = count.div_ceil(CHUNK);
    let mut header =
        format!("ply\nformat binary_little_endian 1.0\n{comment}element chunk {chunks}\n");
    header.extend(bounds);
    header.extend(["element vertex ", &count.to_string(), "\n"]);
    header.extend(packed);
    if rest > 0 {
        header.extend(["element sh ", &count.to_string(), "\n"]);
    }
    header.extend(harmonics);
    header += "end_header\n";

    let order = morton(splats);
    let mut bytes = header.into_bytes();
    bytes.reserve(count * (16 + rest) + count.div_ceil(CHUNK) * 72);
    let mut packed: Vec<u8> = Vec::with_capacity(count * 16);
    for chunk in order.chunks(CHUNK) {
        // Position, log scale and colour of each splat, and their bounds.
        let values = |index: u32| -> [f32; 9] {
            let i = index as usize;
            let mean_m = splats.means_m[i];
            let logs = splats.scales_m[i]
                .to_array()
                .map(|scale_m| log_scale(scale_m).clamp(LOG_SCALES.0, LOG_SCALES.1));
            let sh = &splats.sh[i * coefficients * 3..][..3];
            let colour = [sh[0], sh[1], sh[2]].map(colour_of_harmonic);
            let [x, y, z] = mean_m.to_array();
            [x, y, z, logs[0], logs[1], logs[2], colour[0], colour[1], colour[2]]
        };
        let (mut low, mut high) = ([f32::INFINITY; 9], [f32::NEG_INFINITY; 9]);
        for &i in chunk {
            for (k, value) in values(i).into_iter().enumerate() {
                low[k] = low[k].min(value);
                high[k] = high[k].max(value);
            }
        }
        for group in [0..3, 3..6, 6..9] {
            for value in low[group.clone()].iter().chain(&high[group]) {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
        }
        for &i in chunk {
            let value = values(i);
            // Halved before subtraction: bounds can be as far apart as the range of f32.
            let share = |k: usize| {
                let extent = high[k] * 0.5 - low[k] * 0.5;
                if extent > 0.0 { (value[k] * 0.5 - low[k] * 0.5) / extent } else { 0.0 }
            };
            let thirds = |k: usize| {
                to_unorm(share(k), 11) << 21
                    | to_unorm(share(k + 1), 10) << 11
                    | to_unorm(share(k + 2), 11)
            };
            let [x, y, z, w] = splats.rotations[i as usize].to_array();
            let (largest, others) = smallest_three([w, x, y, z]);
            let rotation = others
                .into_iter()
                .fold(largest, |word, v| word << 10 | to_unorm(v * 0.5 + 0.5, 10));
            let colour = [share(6), share(7), share(8), splats.opacities[i as usize]]
                .into_iter()
                .fold(0, |word, v| word << 8 | to_unorm(v, 8));
            for word in [thirds(0), rotation, thirds(3), colour] {
                packed.extend_from_slice(&word.to_le_bytes());
            }
        }
    }
    bytes.append(&mut packed);
    if rest > 0 {
        for i in order {
            let sh = &splats.sh[i as usize * coefficients * 3..][..coefficients * 3];
            for channel in 0..3 {
                // Steps of 1/32; the decoder uses the middle of each.
                bytes.extend((1..coefficients).map(|k| (sh[k * 3 + channel] * 32.0 + 128.0) as u8));
            }
        }
    }
    bytes
}
