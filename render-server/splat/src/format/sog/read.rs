//! Decoder of SOG: textures to splats.

use glam::Vec3;
use rayon::prelude::*;

use super::files::{Files, META};
use super::meta::{Meta, Palette, Table};
use super::texture::Texture;
use super::{PALETTE_WIDTH, QUATERNION_TAG, invalid};
use crate::format::block::{Gaussian, decode_all};
use crate::format::progress::Meter;
use crate::format::quantise::wxyz_of_smallest_three;
use crate::format::{Format, FormatError, Loaded, limit};

/// Maximum size of `meta.json`; typical files have 20 kB. [byte]
const MAX_META_BYTES: u64 = 4 << 20;
/// Decoded size of all textures per splat. [byte]
const BYTES_PER_SPLAT: u64 = 24;
/// Maximum pixels of a texture: `FREE_PIXELS`, plus `SPARE_PIXELS` times the pixels that its splats
/// need.
const FREE_PIXELS: u64 = 1 << 16;
const SPARE_PIXELS: u64 = 2;
/// Maximum entries of the palette: its indices have 16 bits.
const MAX_PALETTE: usize = 1 << 16;

/// Reads a SOG scene.
pub(in crate::format) fn decode(mut files: Files, meter: &Meter) -> Result<Loaded, FormatError> {
    let meta = Meta::parse(&files.read(META, MAX_META_BYTES)?)?;
    let count = meta.count;
    let stored_bytes = files.stored_bytes(meta.files());
    limit::inflated(Format::Sog, count as u64, BYTES_PER_SPLAT, stored_bytes)?;
    let names: Vec<&str> = meta.files().collect();
    // Decoding a texture takes as long as one pass over the splats.
    meter.expect(count * (names.len() + 1));

    // In the order of `Meta::files`, the palette is the sixth file; it has its own maximum size.
    let is_palette = |i: usize| i == 5;
    let most_pixels = |i: usize| {
        if is_palette(i) {
            (MAX_PALETTE * 15) as u64
        } else {
            FREE_PIXELS + count as u64 * SPARE_PIXELS
        }
    };
    let packed: Vec<(&str, Vec<u8>)> = names
        .into_iter()
        .enumerate()
        // A WebP of noise is slightly larger than its pixels.
        .map(|(i, name)| Ok((name, files.read(name, FREE_PIXELS + most_pixels(i) * 5)?)))
        .collect::<Result<_, FormatError>>()?;
    let textures: Vec<Texture> = packed
        .par_iter()
        .enumerate()
        .map(|(i, (name, webp))| {
            let texture = Texture::decode(name, webp, most_pixels(i))?;
            if !is_palette(i) && texture.pixels() < count {
                let pixels = texture.pixels();
                return Err(invalid(name, format!("{pixels} pixels for {count} splats")));
            }
            meter.add(count);
            Ok(texture)
        })
        .collect::<Result<_, FormatError>>()?;
    drop(packed);
    let [low, high, scales, quaternions, colours, palette @ ..] = &textures[..] else {
        return Err(invalid(META, "files are missing"));
    };
    let harmonics = match (&meta.palette, palette) {
        (Some(described), [entries, labels]) => Some(Harmonics::new(described, entries, labels)?),
        _ => None,
    };

    let extent: [f32; 3] = std::array::from_fn(|axis| meta.mean_max[axis] - meta.mean_min[axis]);
    let sh_degree = harmonics.as_ref().map_or(0, |harmonics| harmonics.degree);
    let (splats, dropped) = decode_all(sh_degree, count, meter, |first, block| {
        for i in 0..block.len() {
            let pixel = first + i;
            let (low, high) = (low.rgb(pixel), high.rgb(pixel));
            let mean_m: [f32; 3] = std::array::from_fn(|axis| {
                let share = f32::from(u16::from_le_bytes([low[axis], high[axis]])) / 65535.0;
                unwarp(meta.mean_min[axis] + extent[axis] * share)
            });
            let scale = scales.rgb(pixel);
            let tag = quaternions.alpha(pixel);
            let [w, x, y, z] = match tag.checked_sub(QUATERNION_TAG) {
                Some(largest) => wxyz_of_smallest_three(
                    u32::from(largest),
                    quaternions.rgb(pixel).map(|byte| f32::from(byte) / 127.5 - 1.0),
                ),
                // As in the reference implementation: identity.
                None => [1.0, 0.0, 0.0, 0.0],
            };
            let gaussian = Gaussian {
                mean_m: Vec3::from_array(mean_m),
                scale_m: Vec3::from_array(std::array::from_fn(|axis| {
                    meta.scales[axis][usize::from(scale[axis])]
                })),
                rotation_xyzw: [x, y, z, w],
                opacity: meta.opacity[usize::from(colours.alpha(pixel))],
            };
            let colour = colours.rgb(pixel);
            let constant = |channel: usize| meta.colours[channel][usize::from(colour[channel])];
            if let Some(harmonics) = &harmonics {
                let (entry, stride) = (harmonics.entry(pixel), harmonics.entries.channels);
                block.put(i, &gaussian, |k, channel| match k {
                    0 => constant(channel),
                    _ => entry
                        .get((k - 1) * stride + channel)
                        .map_or(0.0, |&byte| harmonics.values[usize::from(byte)]),
                });
            } else {
                block.put(i, &gaussian, |_, channel| constant(channel));
            }
        }
    });
    let mut loaded = Loaded::whole(Format::Sog, count, splats, dropped)?;
    loaded.splats.antialiased = meta.antialiased;
    Ok(loaded)
}

/// Returns a coordinate from its stored logarithm.
fn unwarp(warped: f32) -> f32 {
    (warped.abs().exp() - 1.0).copysign(warped)
}

/// Palette of harmonics, and the index of each splat.
struct Harmonics<'a> {
    degree: u8,
    /// Coefficients, and therefore pixels, per entry. Rows are exactly as wide as their entries, so
    /// entries are contiguous.
    coefficients: usize,
    count: usize,
    values: &'a Table,
    entries: &'a Texture,
    labels: &'a Texture,
}

impl<'a> Harmonics<'a> {
    fn new(
        described: &'a Palette,
        entries: &'a Texture,
        labels: &'a Texture,
    ) -> Result<Self, FormatError> {
        let degree = [1u8, 2, 3]
            .into_iter()
            .find(|&degree| entries.width == PALETTE_WIDTH * coefficients(degree))
            .filter(|degree| described.bands.is_none_or(|bands| bands == *degree))
            .ok_or_else(|| {
                let (width, name) = (entries.width, &described.files[0]);
                invalid(name, format!("{width} pixels wide, which fits no degree of harmonics"))
            })?;
        let room = PALETTE_WIDTH * entries.height;
        Ok(Self {
            degree,
            coefficients: coefficients(degree),
            count: described.count.unwrap_or(room).min(room),
            values: &described.values,
            entries,
            labels,
        })
    }

    /// Returns the pixels of a splat's entry. If its label exceeds the palette, the result is empty
    /// and the splat has no harmonics, as in the reference implementation.
    #[inline]
    fn entry(&self, pixel: usize) -> &[u8] {
        let [low, high, _] = self.labels.rgb(pixel);
        let entry = usize::from(u16::from_le_bytes([low, high]));
        if entry < self.count {
            self.entries.run(entry * self.coefficients, self.coefficients)
        } else {
            &[]
        }
    }
}

fn coefficients(degree: u8) -> usize {
    (usize::from(degree) + 1).pow(2) - 1
}
