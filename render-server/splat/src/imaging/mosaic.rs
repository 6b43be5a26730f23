//! Colour filter and image processing of a camera: Bayer mosaic, bilinear interpolation, and denoising.

use super::noise::Readout;

/// Colour filter in front of the pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ColorFilter {
    /// Three colours per pixel, as in an image that combines many sensor pixels.
    #[default]
    Rgb,
    /// One colour per pixel, `RG` over `GB` (Bayer, US patent 3971065), interpolated afterwards.
    Bayer,
    /// Luminance only.
    Mono,
}

impl ColorFilter {
    /// Returns the distance between pixels of the same colour. [px]
    pub(super) fn pitch(self) -> usize {
        if self == Self::Bayer { 2 } else { 1 }
    }

    /// Returns the number of values per pixel before interpolation of the mosaic.
    pub(super) fn channels(self) -> usize {
        if self == Self::Rgb { 3 } else { 1 }
    }
}

/// Returns the colour of a Bayer pixel: 0 red, 1 green, 2 blue.
#[inline]
pub(super) fn bayer_color(x: usize, y: usize) -> usize {
    (x & 1) + (y & 1)
}

/// Writes row `y` of a mosaic as colours: each missing colour is the mean of its nearest neighbours (bilinear). The
/// image is reflected at its border, which keeps the colour pattern.
///
/// # Panics
/// If the mosaic does not have this width, or is smaller than 2 x 2.
pub(super) fn demosaic_row(mosaic: &[f32], width: usize, y: usize, out: &mut [f32]) {
    let height = mosaic.len() / width;
    assert!(width >= 2 && height >= 2 && out.len() == 3 * width);
    let row = |y: usize| &mosaic[y * width..][..width];
    let above = row(if y == 0 { 1 } else { y - 1 });
    let below = row(if y + 1 == height { y - 1 } else { y + 1 });
    let here = row(y);
    for (x, out) in out.chunks_exact_mut(3).enumerate() {
        let left = if x == 0 { 1 } else { x - 1 };
        let right = if x + 1 == width { x - 1 } else { x + 1 };
        let beside = 0.5 * (here[left] + here[right]);
        let upright = 0.5 * (above[x] + below[x]);
        let crossed = 0.25 * (above[left] + above[right] + below[left] + below[right]);
        let around = 0.5 * (beside + upright);
        let (own, odd_row) = (here[x], y & 1 == 1);
        let rgb = match bayer_color(x, y) {
            0 => [own, around, crossed],
            2 => [crossed, around, own],
            // Green: red is left and right of it in red rows, above and below it in blue rows.
            _ if odd_row => [upright, own, beside],
            _ => [beside, own, upright],
        };
        out.copy_from_slice(&rgb);
    }
}

/// Writes row `y` denoised: each pixel is the mean of those of the nine nearest pixels of its colour that are within
/// two standard deviations of it, so that edges remain (sigma filter: J.-S. Lee, CVGIP 1983).
pub(super) fn denoise_row(
    raw: &[f32],
    (width, height): (usize, usize),
    filter: ColorFilter,
    readout: &Readout,
    y: usize,
    out: &mut [f32],
) {
    let (channels, pitch) = (filter.channels(), filter.pitch());
    let rows = [y.checked_sub(pitch), Some(y), Some(y + pitch).filter(|&y| y < height)];
    for x in 0..width {
        let columns = [x.checked_sub(pitch), Some(x), Some(x + pitch).filter(|&x| x < width)];
        for c in 0..channels {
            let own = raw[channels * (y * width + x) + c];
            let reach = 2.0 * readout.sigma(own);
            let (mut sum, mut count) = (0.0, 0.0);
            for y in rows.into_iter().flatten() {
                for x in columns.into_iter().flatten() {
                    let value = raw[channels * (y * width + x) + c];
                    if (value - own).abs() <= reach {
                        sum += value;
                        count += 1.0;
                    }
                }
            }
            out[channels * x + c] = sum / count;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::noise::{NoiseKey, Normals};
    use super::*;

    #[test]
    fn interpolation_keeps_constant_colours_and_gradients() {
        let (width, height) = (8, 6);
        let color =
            |x: usize, y: usize, c: usize| [0.2, 0.5, 0.7][c] + 0.01 * x as f32 - 0.02 * y as f32;
        let mosaic: Vec<f32> = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| color(x, y, bayer_color(x, y)))
            .collect();
        let mut out = vec![0.0; 3 * width];
        for y in 1..height - 1 {
            demosaic_row(&mosaic, width, y, &mut out);
            for x in 1..width - 1 {
                for c in 0..3 {
                    assert!((out[3 * x + c] - color(x, y, c)).abs() < 1e-6, "{x} {y} {c}");
                }
            }
        }
        // Colours do not mix at the border.
        let flat: Vec<f32> = (0..4).map(|n| [0.2, 0.5, 0.7][bayer_color(n % 2, n / 2)]).collect();
        let mut out = vec![0.0; 6];
        for y in 0..2 {
            demosaic_row(&flat, 2, y, &mut out);
            assert_eq!(out, [0.2, 0.5, 0.7, 0.2, 0.5, 0.7]);
        }
    }

    #[test]
    fn denoising_keeps_edges_and_removes_two_fifths_of_the_noise() {
        let readout = Readout {
            electrons: 4000.0,
            full_well_e: 4000.0,
            read_noise_e: 3.0,
            numbers_per_e: 4095.0 / 4000.0,
            full_scale: 4095.0,
            amount: 1.0,
        };
        let (key, table) = (NoiseKey::new(3, 0, 0), Normals::table());
        let (width, height) = (64, 64);
        for filter in [ColorFilter::Mono, ColorFilter::Bayer, ColorFilter::Rgb] {
            let channels = filter.channels();
            let light = |x: usize| if x < 32 { 0.2f32 } else { 0.6 };
            let raw: Vec<f32> = (0..channels * width * height)
                .map(|n| readout.read(light(n / channels % width), table.of(key.bits(n), 0)))
                .collect();
            let mut clean = vec![0.0; raw.len()];
            for (y, out) in clean.chunks_exact_mut(channels * width).enumerate() {
                denoise_row(&raw, (width, height), filter, &readout, y, out);
            }
            let off = |values: &[f32]| {
                let squares = values
                    .iter()
                    .enumerate()
                    .map(|(n, value)| f64::from(value - light(n / channels % width)).powi(2));
                (squares.sum::<f64>() / values.len() as f64).sqrt()
            };
            assert!(off(&clean) < 0.6 * off(&raw), "{filter:?}: {} {}", off(&clean), off(&raw));
            let edge = clean[channels * (30 * width + 32)] - clean[channels * (30 * width + 31)];
            assert!((edge - 0.4).abs() < 0.05, "{filter:?}: {edge}");
        }
    }
}
