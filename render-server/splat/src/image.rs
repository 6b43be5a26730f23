//! Output of a renderer, and conversion to integers for encoders.

use core::ops::Range;

/// Colour, depth, alpha and object ids of one camera; row-major. Buffers are reused for the next image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RgbdImage {
    /// Width. [px]
    pub width_px: u32,
    /// Height. [px]
    pub height_px: u32,
    /// H x W x 3 colour, blended onto the background, unclamped.
    pub rgb: Vec<f32>,
    /// H x W accumulated opacity, 0 to 1.
    pub alpha: Vec<f32>,
    /// H x W expected camera-z depth `sum(w z) / sum(w)`; 0 where nothing contributes. [m, cam]
    pub depth_expected_m: Vec<f32>,
    /// H x W median camera-z depth: z of the splat at which transmittance falls to one half; 0
    /// where it never does. [m, cam]
    pub depth_median_m: Vec<f32>,
    /// H x W [`crate::RigidObject::id`] of the splat that gives the median depth; 0 for the static part, and where
    /// the median depth is 0.
    pub ids: Vec<u16>,
}

/// Kind of depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DepthKind {
    /// Depth at which transmittance falls to one half: sharp at edges, never between two surfaces.
    #[default]
    Median,
    /// Mean over all splats of the pixel: smooth, but between the surfaces at edges.
    Expected,
}

impl RgbdImage {
    /// Minimum alpha of a valid expected depth. Below it, more than half of the light comes from the background, and
    /// the median is also "no return".
    pub const MIN_DEPTH_ALPHA: f32 = 0.5;

    /// Resizes every buffer to `width_px` x `height_px`. Contents are unspecified. Allocates only if the image grows.
    pub fn resize(&mut self, width_px: u32, height_px: u32) {
        let pixels = width_px as usize * height_px as usize;
        self.width_px = width_px;
        self.height_px = height_px;
        self.rgb.resize(pixels * 3, 0.0);
        self.alpha.resize(pixels, 0.0);
        self.depth_expected_m.resize(pixels, 0.0);
        self.depth_median_m.resize(pixels, 0.0);
        self.ids.resize(pixels, 0);
    }

    /// Writes H x W x 3 bytes of RGB, clamped and rounded, to `out`, which is resized and overwritten. No gamma is
    /// applied: splats are trained on sRGB values, so these values are already sRGB.
    pub fn write_rgb8(&self, out: &mut Vec<u8>) {
        quantise_rgb(&self.rgb, out);
    }

    /// Same as [`Self::write_rgb8`], for some rows.
    ///
    /// # Panics
    /// If the image does not have these rows.
    pub fn write_rgb8_rows(&self, rows: Range<u32>, out: &mut Vec<u8>) {
        let pixels = self.pixels(rows);
        quantise_rgb(&self.rgb[3 * pixels.start..3 * pixels.end], out);
    }

    /// Writes H x W depths in whole millimetres to `out`, which is resized and overwritten. 0 means no return (as in
    /// REP 118): alpha below [`Self::MIN_DEPTH_ALPHA`], no hit, or more than 65.535 m. [mm, cam]
    pub fn write_depth_mm(&self, kind: DepthKind, out: &mut Vec<u16>) {
        quantise_depth(self.depth_m(kind), &self.alpha, out);
    }

    /// Same as [`Self::write_depth_mm`], for some rows.
    ///
    /// # Panics
    /// If the image does not have these rows.
    pub fn write_depth_mm_rows(&self, kind: DepthKind, rows: Range<u32>, out: &mut Vec<u16>) {
        let pixels = self.pixels(rows);
        quantise_depth(&self.depth_m(kind)[pixels.clone()], &self.alpha[pixels], out);
    }

    fn pixels(&self, rows: Range<u32>) -> Range<usize> {
        let width = self.width_px as usize;
        rows.start as usize * width..rows.end as usize * width
    }

    fn depth_m(&self, kind: DepthKind) -> &[f32] {
        match kind {
            DepthKind::Median => &self.depth_median_m,
            DepthKind::Expected => &self.depth_expected_m,
        }
    }
}

fn quantise_rgb(rgb: &[f32], out: &mut Vec<u8>) {
    out.resize(rgb.len(), 0);
    for (byte, &value) in out.iter_mut().zip(rgb) {
        // Clamped before the cast, in an order that the compiler vectorises; NaN becomes 0.
        *byte = (value.max(0.0) * 255.0 + 0.5).min(255.0) as u8;
    }
}

fn quantise_depth(depth_m: &[f32], alpha: &[f32], out: &mut Vec<u16>) {
    out.resize(depth_m.len(), 0);
    for ((mm, &depth_m), &alpha) in out.iter_mut().zip(depth_m).zip(alpha) {
        let rounded = depth_m * 1000.0 + 0.5;
        let returned = alpha >= RgbdImage::MIN_DEPTH_ALPHA && rounded < 65536.0;
        *mm = if returned { rounded as u16 } else { 0 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rgb_is_clamped_and_rounded() {
        let image = RgbdImage {
            rgb: vec![-1.0, 0.0, 0.001, 0.5, 1.0, 7.0, f32::NAN, f32::INFINITY, 254.6 / 255.0],
            ..RgbdImage::default()
        };
        let mut bytes = vec![9; 50];
        image.write_rgb8(&mut bytes);
        assert_eq!(bytes, [0, 0, 0, 128, 255, 255, 0, 255, 255]);
    }

    #[test]
    fn depth_is_in_millimetres_or_no_return() {
        let image = RgbdImage {
            alpha: vec![1.0, 0.49, 0.5, 1.0, 1.0, 1.0, 1.0],
            depth_median_m: vec![1.2344, 2.0, 2.0006, 65.535, 65.5356, f32::NAN, 0.0],
            depth_expected_m: vec![3.0; 7],
            ..RgbdImage::default()
        };
        let mut mm = Vec::new();
        image.write_depth_mm(DepthKind::Median, &mut mm);
        assert_eq!(mm, [1234, 0, 2001, 65535, 0, 0, 0]);
        image.write_depth_mm(DepthKind::Expected, &mut mm);
        assert_eq!(mm, [3000, 0, 3000, 3000, 3000, 3000, 3000]);
    }

    #[test]
    fn writes_rows_as_in_the_whole_image() {
        let mut image = RgbdImage::default();
        image.resize(5, 4);
        for (n, value) in image.rgb.iter_mut().enumerate() {
            *value = n as f32 / 100.0;
        }
        image.alpha.fill(1.0);
        for (n, depth_m) in image.depth_median_m.iter_mut().enumerate() {
            *depth_m = n as f32;
        }
        let (mut rgb, mut mm, mut rows_rgb, mut rows_mm) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        image.write_rgb8(&mut rgb);
        image.write_depth_mm(DepthKind::Median, &mut mm);
        for rows in [0..4, 1..3, 3..4, 2..2] {
            let pixels = 5 * rows.start as usize..5 * rows.end as usize;
            image.write_rgb8_rows(rows.clone(), &mut rows_rgb);
            image.write_depth_mm_rows(DepthKind::Median, rows, &mut rows_mm);
            assert_eq!(rows_rgb, rgb[3 * pixels.start..3 * pixels.end]);
            assert_eq!(rows_mm, mm[pixels]);
        }
    }
}
