//! Sheet of pictures side by side, at most four in a row.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::{Context, Result};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ImageError, Rgb, RgbImage};
use vizflyt_splat::RgbdImage;

const COLUMNS: u32 = 4;
const GAP_PX: u32 = 4;

/// Pictures of one size, in the order of `add`.
pub(super) struct Sheet {
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    tiles: Vec<RgbImage>,
}

impl Sheet {
    pub(super) fn new(width_px: u32, height_px: u32) -> Self {
        Self { width_px, height_px, tiles: Vec::new() }
    }

    pub(super) fn add(&mut self, tile: RgbImage) {
        assert_eq!(tile.dimensions(), (self.width_px, self.height_px));
        self.tiles.push(tile);
    }

    /// Writes all pictures as one.
    pub(super) fn save(&self, file: &Path) -> Result<()> {
        let count = self.tiles.len() as u32;
        let (columns, rows) = (count.min(COLUMNS), count.div_ceil(COLUMNS));
        let (width, height) = (self.width_px + GAP_PX, self.height_px + GAP_PX);
        let mut all = RgbImage::from_pixel(columns * width, rows * height, Rgb([255; 3]));
        for (n, tile) in (0..).zip(&self.tiles) {
            let at = (i64::from(n % COLUMNS * width), i64::from(n / COLUMNS * height));
            image::imageops::replace(&mut all, tile, at.0, at.1);
        }
        // Small size matters more than write time: the picture is for documents.
        File::create(file)
            .map_err(ImageError::from)
            .and_then(|out| {
                let (best, adaptive) = (CompressionType::Best, FilterType::Adaptive);
                let encoder = PngEncoder::new_with_quality(BufWriter::new(out), best, adaptive);
                all.write_with_encoder(encoder)
            })
            .with_context(|| format!("cannot write {}", file.display()))
    }
}

/// Returns the colour of a depth: near is bright and red, far is dark and blue, no depth is black.
pub(super) fn depth_color(depth_m: f32, alpha: f32) -> Rgb<u8> {
    if !(depth_m > 0.0 && alpha >= RgbdImage::MIN_DEPTH_ALPHA) {
        return Rgb([0; 3]);
    }
    let near = 1.0 / (1.0 + 0.25 * depth_m);
    coarse([near * near * 1.3, near * 0.9, 1.0 - 0.8 * near])
}

/// Returns a colour from values of 0 to 1, in coarser steps than eight bits, so that the file stays
/// small.
pub(super) fn coarse(rgb: [f32; 3]) -> Rgb<u8> {
    Rgb(rgb.map(|value| (value.clamp(0.0, 1.0) * 63.0 + 0.5) as u8 * 4))
}
