//! Reads image files as photos of a pinhole camera, at the training resolution.

use std::path::Path;

use glam::DVec2;
use image::{DynamicImage, ImageDecoder, ImageReader, Limits};
use vizflyt_protocol::geometry::{Distortion, Intrinsics};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::error::{DatasetError, read_file};

/// Pixels with red, green, blue and validity (0: ignored).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Rgba {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) pixels: Vec<[u8; 4]>,
}

/// Reads a PNG or a JPEG; transparent pixels are ignored.
pub(super) fn read(path: &Path) -> Result<Rgba, DatasetError> {
    let bytes = read_file(path)?;
    decode(&bytes).map_err(|what| DatasetError::damaged(path, what))
}

/// Reads a 16-bit PNG of depths, 0 where unknown. Returns its width, height and values.
pub(super) fn read_depth(path: &Path) -> Result<(u32, u32, Vec<u16>), DatasetError> {
    let bytes = read_file(path)?;
    match png(&bytes).map_err(|what| DatasetError::damaged(path, what))? {
        DynamicImage::ImageLuma16(image) => Ok((image.width(), image.height(), image.into_raw())),
        _ => Err(DatasetError::damaged(path, "not a depth image; it must be a 16-bit grey PNG")),
    }
}

fn decode(bytes: &[u8]) -> Result<Rgba, String> {
    if bytes.starts_with(&[0xff, 0xd8]) {
        return jpeg(bytes);
    }
    if !bytes.starts_with(b"\x89PNG") {
        return Err("neither PNG nor JPEG; convert it to one of them".to_owned());
    }
    let image = png(bytes)?.into_rgba8();
    let (width, height) = image.dimensions();
    let pixels = image.pixels().map(|p| p.0).map(|[r, g, b, a]| [r, g, b, u8::from(a >= 128)]);
    Ok(Rgba { width, height, pixels: pixels.collect() })
}

fn png(bytes: &[u8]) -> Result<DynamicImage, String> {
    let mut reader = ImageReader::new(std::io::Cursor::new(bytes));
    reader.set_format(image::ImageFormat::Png);
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    limits.max_alloc = Some(1 << 30);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|error| error.to_string())?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err("the image is empty".to_owned());
    }
    DynamicImage::from_decoder(decoder).map_err(|error| error.to_string())
}

fn jpeg(bytes: &[u8]) -> Result<Rgba, String> {
    let options = DecoderOptions::default()
        .jpeg_set_out_colorspace(ColorSpace::RGB)
        .set_max_width(MAX_SIDE_PX as usize)
        .set_max_height(MAX_SIDE_PX as usize);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    let rgb = decoder.decode().map_err(|error| error.to_string())?;
    let info = decoder.info().ok_or("no image")?;
    let (width, height) = (u32::from(info.width), u32::from(info.height));
    if rgb.len() != 3 * width as usize * height as usize || rgb.is_empty() {
        return Err("the JPEG does not decode to colours".to_owned());
    }
    let pixels = rgb.chunks_exact(3).map(|p| [p[0], p[1], p[2], 1]).collect();
    Ok(Rgba { width, height, pixels })
}

/// Returns the pinhole camera of an undistorted photo, at most `width_px` wide.
pub(super) fn pinhole(camera: &Intrinsics, width_px: Option<u32>) -> Intrinsics {
    let width = width_px.unwrap_or(u32::MAX).clamp(MIN_WIDTH_PX, camera.width_px.max(MIN_WIDTH_PX));
    let width = width.min(camera.width_px);
    let share = f64::from(width) / f64::from(camera.width_px);
    let height = ((f64::from(camera.height_px) * share).round() as u32).max(1);
    let down = f64::from(height) / f64::from(camera.height_px);
    Intrinsics {
        width_px: width,
        height_px: height,
        fx_px: camera.fx_px * share,
        fy_px: camera.fy_px * down,
        cx_px: camera.cx_px * share,
        cy_px: camera.cy_px * down,
        distortion: Distortion::None,
    }
}

/// Returns the camera of a scaled image; `None` if the aspect ratio differs.
pub(super) fn fitted(camera: &Intrinsics, (width, height): (u32, u32)) -> Option<Intrinsics> {
    let across = f64::from(width) / f64::from(camera.width_px);
    let down = f64::from(height) / f64::from(camera.height_px);
    // Tolerance: rounding may have removed one pixel.
    let slack = 1.5 / f64::from(width.min(height));
    ((across / down - 1.0).abs() <= slack).then_some(Intrinsics {
        width_px: width,
        height_px: height,
        fx_px: camera.fx_px * across,
        fy_px: camera.fy_px * down,
        cx_px: camera.cx_px * across,
        cy_px: camera.cy_px * down,
        distortion: camera.distortion,
    })
}

/// Resamples an image to a pinhole camera. Pixels outside the lens's image are ignored.
pub(super) fn undistort(image: &Rgba, camera: &Intrinsics, pinhole: &Intrinsics) -> Rgba {
    if camera == pinhole {
        return image.clone();
    }
    // Average whole pixels first, then interpolate between pixels.
    let by = (camera.width_px / pinhole.width_px).max(1);
    let small = shrunk(image, by);
    let camera = fitted(camera, (small.width, small.height)).unwrap_or(*camera);
    let place = Resampler::new(&camera, pinhole);
    // Between integer factors, use up to four samples per pixel.
    let samples: &[f64] = if camera.width_px > pinhole.width_px { &[0.25, 0.75] } else { &[0.5] };
    let mut pixels = Vec::with_capacity(pinhole.pixels());
    for y in 0..pinhole.height_px {
        for x in 0..pinhole.width_px {
            let mut sum = [0.0; 3];
            let mut all = true;
            for &v in samples {
                for &u in samples {
                    let at = place.at(DVec2::new(f64::from(x) + u, f64::from(y) + v));
                    match at.and_then(|at| between(&small, at)) {
                        Some(colour) => (0..3).for_each(|c| sum[c] += colour[c]),
                        None => all = false,
                    }
                }
            }
            let count = (samples.len() * samples.len()) as f32;
            let [r, g, b] = sum.map(|v| (v / count + 0.5) as u8);
            pixels.push(if all { [r, g, b, 1] } else { [0; 4] });
        }
    }
    Rgba { width: pinhole.width_px, height: pinhole.height_px, pixels }
}

/// Maps pixels of a pinhole camera to pixels of a lens.
pub(super) struct Resampler<'a> {
    camera: &'a Intrinsics,
    pinhole: &'a Intrinsics,
    reach: f64,
}

impl<'a> Resampler<'a> {
    pub(super) fn new(camera: &'a Intrinsics, pinhole: &'a Intrinsics) -> Self {
        Self { camera, pinhole, reach: camera.distortion.reach() }
    }

    /// Returns the lens's pixel of a pinhole's pixel; `None` beyond the lens's range.
    pub(super) fn at(&self, pixel: DVec2) -> Option<DVec2> {
        let slope = self.pinhole.slope(pixel)?;
        let k = self.camera;
        (slope.length() <= self.reach).then(|| {
            DVec2::new(k.fx_px, k.fy_px) * k.distortion.distort(slope).0
                + DVec2::new(k.cx_px, k.cy_px)
        })
    }
}

/// Returns the image reduced by averaging squares of `by` pixels.
fn shrunk(image: &Rgba, by: u32) -> Rgba {
    if by == 1 {
        return image.clone();
    }
    let (width, height) = ((image.width / by).max(1), (image.height / by).max(1));
    let mut pixels = Vec::with_capacity(width as usize * height as usize);
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut count, mut all) = ([0u32; 3], 0, true);
            for v in y * by..((y + 1) * by).min(image.height) {
                for u in x * by..((x + 1) * by).min(image.width) {
                    let pixel = image.pixels[(v * image.width + u) as usize];
                    (0..3).for_each(|c| sum[c] += u32::from(pixel[c]));
                    count += 1;
                    all &= pixel[3] > 0;
                }
            }
            let [r, g, b] = sum.map(|v| ((v + count / 2) / count) as u8);
            pixels.push([r, g, b, u8::from(all)]);
        }
    }
    Rgba { width, height, pixels }
}

/// Returns the bilinearly interpolated colour; `None` outside the image or next to an ignored pixel.
fn between(image: &Rgba, at: DVec2) -> Option<[f32; 3]> {
    let (width, height) = (f64::from(image.width), f64::from(image.height));
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x <= width && at.y <= height) {
        return None;
    }
    // The outer half of border pixels has the colour of the pixel.
    let x = (at.x - 0.5).clamp(0.0, width - 1.0);
    let y = (at.y - 0.5).clamp(0.0, height - 1.0);
    let (left, top) = (x as u32, y as u32);
    let (right, bottom) = ((left + 1).min(image.width - 1), (top + 1).min(image.height - 1));
    let (fx, fy) = ((x - f64::from(left)) as f32, (y - f64::from(top)) as f32);
    let mut sum = [0.0; 3];
    for (u, v, weight) in [
        (left, top, (1.0 - fx) * (1.0 - fy)),
        (right, top, fx * (1.0 - fy)),
        (left, bottom, (1.0 - fx) * fy),
        (right, bottom, fx * fy),
    ] {
        let pixel = image.pixels[(v * image.width + u) as usize];
        if pixel[3] == 0 && weight > 0.0 {
            return None;
        }
        (0..3).for_each(|c| sum[c] += weight * f32::from(pixel[c]));
    }
    Some(sum)
}

/// Maximum side of an image. [px]
const MAX_SIDE_PX: u32 = Intrinsics::MAX_SIDE_PX;
/// Minimum width for training. [px]
const MIN_WIDTH_PX: u32 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns an image whose colour encodes the viewing direction: red across, green down.
    fn ramp(k: &Intrinsics) -> Rgba {
        let mut pixels = Vec::new();
        for y in 0..k.height_px {
            for x in 0..k.width_px {
                let slope = k.slope(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                let colour = |v: f64| ((0.5 + 0.5 * v) * 255.0).round() as u8;
                pixels.push(slope.map_or([0; 4], |s| [colour(s.x), colour(s.y), 0, 1]));
            }
        }
        Rgba { width: k.width_px, height: k.height_px, pixels }
    }

    #[test]
    fn undistorts_and_reduces_images() {
        let pinhole_640 = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        for distortion in [
            Distortion::None,
            Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 0.002, p2: -0.001, k3: 0.0 },
            Distortion::KannalaBrandt { k1: 0.01, k2: -0.003, k3: 0.0, k4: 0.0 },
        ] {
            let camera = Intrinsics { distortion, cx_px: 331.0, ..pinhole_640 };
            let image = ramp(&camera);
            for width in [640, 320, 250, 64] {
                let target = pinhole(&camera, Some(width));
                let out = undistort(&image, &camera, &target);
                assert_eq!((out.width, target.distortion), (width, Distortion::None));
                let (mut seen, mut worst) = (0, 0);
                for (i, pixel) in out.pixels.iter().enumerate().filter(|(_, p)| p[3] > 0) {
                    let (x, y) = (i as u32 % out.width, i as u32 / out.width);
                    let slope =
                        target.slope(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).unwrap();
                    for (got, want) in [(pixel[0], slope.x), (pixel[1], slope.y)] {
                        let want = ((0.5 + 0.5 * want) * 255.0).round().clamp(0.0, 255.0) as i32;
                        worst = worst.max((i32::from(got) - want).abs());
                    }
                    seen += 1;
                }
                assert!(worst <= 2, "{distortion:?}, {width}: off by {worst}");
                assert!(seen * 10 > out.pixels.len() * 8, "{seen} of {}", out.pixels.len());
            }
        }
    }

    #[test]
    fn rejects_invalid_images_without_panic() {
        for bytes in [&b""[..], b"\xff\xd8", b"\x89PNG\r\n\x1a\n1234", b"GIF89a"] {
            assert!(!decode(bytes).unwrap_err().is_empty());
        }
    }
}
