//! `--sheet FILE`: overview of a few images with all layers.
//!
//! One row per image: colour with boxes and corners, depth (near is bright), normals, instances, classes, flow coloured
//! by direction (as in Baker et al. 2011).

use std::path::Path;

use anyhow::{Context, Result};
use vizflyt_protocol::geometry::Intrinsics;

use super::record::ImageRecord;
use super::render::Layers;
use super::store::write_whole;
use crate::labels::picture;

/// Rows of an overview.
#[derive(Debug, Default)]
pub(super) struct Sheet {
    /// Row-major RGB of each row.
    rows: Vec<Vec<u8>>,
    tile: [usize; 2],
}

impl Sheet {
    /// Adds an image.
    pub(super) fn add(&mut self, k: &Intrinsics, layers: &Layers, record: &ImageRecord) {
        let size = [k.width_px as usize, k.height_px as usize];
        let width = size[0].min(TILE_PX);
        self.tile = [width, (size[1] * width / size[0]).max(1)];
        let mut colour = layers.rgb.clone();
        for thing in &record.things {
            let [x, y, w, h] = thing.box_px.map(|side| side as usize);
            frame(&mut colour, size, [x, y, x + w - 1, y + h - 1], palette(thing.id.into()));
        }
        for corner in record.gates.iter().flat_map(|gate| &gate.corners) {
            let [x, y] = corner.at_px.map(|side| side as usize);
            let shown = match corner.visibility {
                0 => continue,
                1 => [255, 60, 60],
                _ => [60, 255, 60],
            };
            let [r, b] = [[x.saturating_sub(2), y.saturating_sub(2)], [x + 2, y + 2]];
            frame(&mut colour, size, [r[0], r[1], b[0], b[1]], shown);
        }
        let depth = grey(
            layers.depth_m.iter().map(|&z| if z > 0.0 { 255.0 / (1.0 + 0.35 * z) } else { 0.0 }),
        );
        let instances = layers.instances.iter().flat_map(|&id| palette(id.into()));
        let classes = layers.classes.iter().flat_map(|&class| palette(class.into()));
        let flow = layers.flow.chunks_exact(3).flat_map(flow_colour);
        let tiles = [
            colour,
            depth,
            layers.normals.clone(),
            instances.collect(),
            classes.collect(),
            flow.collect(),
        ];
        let mut row = Vec::with_capacity(3 * tiles.len() * self.tile[0] * self.tile[1]);
        for y in 0..self.tile[1] {
            for tile in &tiles {
                for x in 0..self.tile[0] {
                    row.extend(averaged(tile, size, self.tile, [x, y]));
                }
            }
        }
        self.rows.push(row);
    }

    /// Writes the overview as JPEG if the name ends with .jpg or .jpeg, otherwise as PNG.
    pub(super) fn write(&self, path: &Path) -> Result<()> {
        let rgb: Vec<u8> = self.rows.concat();
        let width = (6 * self.tile[0]) as u32;
        let size = [width, (rgb.len() as u32 / 3).checked_div(width).unwrap_or(0)];
        let is_jpeg = path.extension().is_some_and(|ending| ending == "jpg" || ending == "jpeg");
        let bytes =
            if is_jpeg { picture::jpeg(&rgb, size, 85)? } else { picture::rgb8(&rgb, size)? };
        write_whole(path, &bytes).context("--sheet")
    }
}

/// Returns the mean of the image pixels for a pixel of the tile; black if the layer is empty.
fn averaged(
    rgb: &[u8],
    [width, height]: [usize; 2],
    tile: [usize; 2],
    [x, y]: [usize; 2],
) -> [u8; 3] {
    if rgb.is_empty() {
        return [0; 3];
    }
    let span = |at: usize, of: usize, side: usize| {
        at * side / of..((at + 1) * side / of).max(at * side / of + 1)
    };
    let (mut sum, mut count) = ([0u32; 3], 0);
    for row in span(y, tile[1], height) {
        for column in span(x, tile[0], width) {
            let at = 3 * (row * width + column);
            for k in 0..3 {
                sum[k] += u32::from(rgb[at + k]);
            }
            count += 1;
        }
    }
    sum.map(|sum| (sum / count) as u8)
}

fn frame(
    rgb: &mut [u8],
    [width, height]: [usize; 2],
    [left, top, right, bottom]: [usize; 4],
    colour: [u8; 3],
) {
    let mut dot = |x: usize, y: usize| {
        if x < width && y < height {
            rgb[3 * (y * width + x)..][..3].copy_from_slice(&colour);
        }
    };
    for x in left..=right {
        dot(x, top);
        dot(x, bottom);
    }
    for y in top..=bottom {
        dot(left, y);
        dot(right, y);
    }
}

fn grey(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(|value| [value as u8; 3]).collect()
}

/// Returns a colour for a number; black for 0. Hues of consecutive numbers differ by the golden ratio.
fn palette(number: u32) -> [u8; 3] {
    if number == 0 { [0; 3] } else { hue(number as f32 * 0.618_034, 0.65, 1.0) }
}

fn hue(turns: f32, saturation: f32, value: f32) -> [u8; 3] {
    [5.0, 3.0, 1.0].map(|n| {
        let k = (n + turns.fract() * 6.0) % 6.0;
        ((value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0)) * 255.0) as u8
    })
}

fn flow_colour(flow: &[u16]) -> [u8; 3] {
    if flow[2] == 0 {
        return [0; 3];
    }
    let [u, v] = [flow[0], flow[1]].map(|value| (f32::from(value) - 32768.0) / 64.0);
    let turns = v.atan2(u) / std::f32::consts::TAU + 0.5;
    hue(turns, (u.hypot(v) / FULL_FLOW_PX).min(1.0), 1.0)
}

/// Maximum width of a tile. [px]
const TILE_PX: usize = 200;
/// Flow of this length has full saturation. [px]
const FULL_FLOW_PX: f32 = 16.0;
