//! Converts an image to a grid of samples: a vector in home axes and a colour class for each second pixel.
//!
//! 160 x 120 samples of a 320 x 240 image are enough: a bar of 0.16 m is three samples wide at 4 m. Vectors begin at
//! the camera; [`crate::odometry`] estimates the camera's position.

use vizflyt_sdk::Intrinsics;
use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};
use vizflyt_sdk::protocol::geometry::Frame;

use crate::color_class::ColorClass;

/// Frame of the plugin's map: x along the nose at the first image, z up, origin on the floor below that image's
/// position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Home {}

impl Frame for Home {
    const NAME: &'static str = "home";
}

/// One RGB-D image and the rotation of its camera.
#[derive(Clone, Copy, Debug)]
pub struct RgbdView<'a> {
    /// Colour, H x W x 3, sRGB.
    pub rgb: &'a [u8],
    /// Camera-z depth, H x W; 0 means no return. [mm, cam]
    pub depth_mm: &'a [u16],
    /// Size, focal lengths, principal point. [px]
    pub intrinsics: Intrinsics,
    /// Rotates camera axes to home axes.
    pub home_from_cam: DQuat,
}

/// Sample of one pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sample {
    /// Vector from the camera to the surface; zero without a return. [m, home axes]
    pub offset_m: DVec3,
    /// Colour class, if the pixel belongs to a bar or the hand.
    pub color: Option<ColorClass>,
    /// Mean brightness of the surrounding pixels, 0 to 1.
    pub grey: f32,
}

impl Sample {
    /// Returns whether the sample has a return.
    pub fn is_seen(&self) -> bool {
        self.offset_m != DVec3::ZERO
    }
}

/// Samples of an image, row-major; reused for each image.
#[derive(Clone, Debug, Default)]
pub struct PixelGrid {
    /// Samples per row.
    pub columns: usize,
    /// Number of rows.
    pub rows: usize,
    /// Samples, row-major.
    pub samples: Vec<Sample>,
    /// Projection of the grid and rotation of the camera.
    pub camera: Option<SampleCamera>,
    slopes: Vec<DVec2>,
    slopes_of: Option<Intrinsics>,
}

/// Projection of a grid and rotation of the camera.
#[derive(Clone, Copy, Debug)]
pub struct SampleCamera {
    /// Intrinsics of the image. [px]
    pub intrinsics: Intrinsics,
    /// Pixels from sample to sample.
    pub stride: usize,
    /// Rotates camera axes to home axes.
    pub home_from_cam: DQuat,
}

impl SampleCamera {
    /// Returns column and row in the grid for a vector from the camera. [m, home axes]
    pub fn sample_at(&self, offset_m: DVec3) -> Option<DVec2> {
        let pixel = self.intrinsics.project(self.home_from_cam.conjugate() * offset_m)?;
        let at = pixel / self.stride as f64;
        (at.x >= 0.0 && at.y >= 0.0).then_some(at)
    }

    /// Returns the gradient of the projected position in the direction `across`, for a point at `offset_m` [m, home
    /// axes]. [samples/m, home axes]
    pub fn slope_along(&self, offset_m: DVec3, across: DVec2) -> DVec3 {
        let p = self.home_from_cam.conjugate() * offset_m;
        let (x, y) = (
            across.x * self.intrinsics.fx_px / self.stride as f64,
            across.y * self.intrinsics.fy_px / self.stride as f64,
        );
        self.home_from_cam * (DVec3::new(x, y, -(x * p.x + y * p.y) / p.z) / p.z)
    }
}

impl PixelGrid {
    /// Processes a new image. An image with planes shorter than its size is ignored.
    pub fn update(&mut self, view: &RgbdView<'_>) {
        let k = view.intrinsics;
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        let stride = (width / COLUMNS).max(1);
        (self.columns, self.rows) = (width / stride, height / stride);
        self.samples.clear();
        if view.rgb.len() < 3 * width * height || view.depth_mm.len() < width * height {
            (self.columns, self.rows) = (0, 0);
        }
        self.camera =
            Some(SampleCamera { intrinsics: k, stride, home_from_cam: view.home_from_cam });
        self.lay_out(k, stride);
        for row in 0..self.rows {
            for column in 0..self.columns {
                let at = row * stride * width + column * stride;
                let depth_m = f64::from(view.depth_mm[at]) * 1e-3;
                let slope = self.slopes[row * self.columns + column];
                let in_cam_m = (slope * depth_m).extend(depth_m);
                let grey = grey_of(view.rgb, width, column * stride, row * stride, stride);
                self.samples.push(Sample {
                    grey,
                    offset_m: view.home_from_cam * in_cam_m,
                    color: ColorClass::of([
                        view.rgb[3 * at],
                        view.rgb[3 * at + 1],
                        view.rgb[3 * at + 2],
                    ]),
                });
            }
        }
    }

    /// Rotates all samples about the camera. [home axes]
    pub fn turn(&mut self, turn: DQuat) {
        for sample in &mut self.samples {
            sample.offset_m = turn * sample.offset_m;
        }
        if let Some(camera) = &mut self.camera {
            camera.home_from_cam = turn * camera.home_from_cam;
        }
    }

    /// Returns a sample; `None` outside the grid.
    pub fn at(&self, column: usize, row: usize) -> Option<&Sample> {
        if column >= self.columns { None } else { self.samples.get(row * self.columns + column) }
    }

    /// Computes the slopes of the samples' rays, once per camera.
    fn lay_out(&mut self, k: Intrinsics, stride: usize) {
        if self.slopes_of == Some(k) {
            return;
        }
        self.slopes.clear();
        for row in 0..self.rows {
            for column in 0..self.columns {
                let pixel = DVec2::new((column * stride) as f64, (row * stride) as f64) + 0.5;
                // Outside the range of the lens model, a sample has no return.
                self.slopes.push(k.slope(pixel).unwrap_or(DVec2::ZERO));
            }
        }
        self.slopes_of = Some(k);
    }
}

/// Returns the mean brightness of a block of pixels, 0 to 1.
fn grey_of(rgb: &[u8], width: usize, left: usize, top: usize, side: usize) -> f32 {
    let mut sum = 0_u32;
    for row in top..top + side {
        let from = 3 * (row * width + left);
        sum += rgb[from..from + 3 * side].iter().map(|&value| u32::from(value)).sum::<u32>();
    }
    sum as f32 / (3 * side * side * 255) as f32
}

/// Approximate number of samples per row: every second pixel of 320.
const COLUMNS: usize = 160;
