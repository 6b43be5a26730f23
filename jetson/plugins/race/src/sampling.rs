//! Image -> grid: what each second pixel sees, as a vector in home axes and as a colour class.
//!
//! 160 x 120 samples of a 320 x 240 image are enough: a bar of 0.16 m is three samples wide at
//! 4 m. Vectors are from the camera; where the camera is, [`crate::odometry`] finds out.

use vizflyt_sdk::Intrinsics;
use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};
use vizflyt_sdk::protocol::geometry::Frame;

use crate::color_class::ColorClass;

/// The frame that the plugin finds its way in: x along the nose as it was at the first image,
/// z up, origin on the floor below the place of that image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Home {}

impl Frame for Home {
    const NAME: &'static str = "home";
}

/// One RGB-D image and how the camera was turned.
#[derive(Clone, Copy, Debug)]
pub struct RgbdView<'a> {
    /// Colour, H x W x 3, sRGB.
    pub rgb: &'a [u8],
    /// Camera-z depth, H x W; 0 is no return. [mm, cam]
    pub depth_mm: &'a [u16],
    /// Size, focal lengths, principal point. [px]
    pub intrinsics: Intrinsics,
    /// Takes camera axes to home axes.
    pub home_from_cam: DQuat,
}

/// What one pixel sees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sample {
    /// From the camera to the surface; zero where nothing came back. [m, home axes]
    pub offset_m: DVec3,
    /// Colour of a bar, if it is one.
    pub color: Option<ColorClass>,
    /// Brightness of the pixels about it, 0 to 1.
    pub grey: f32,
}

impl Sample {
    /// Whether something came back.
    pub fn is_seen(&self) -> bool {
        self.offset_m != DVec3::ZERO
    }
}

/// Samples of an image, row-major; reused from image to image.
#[derive(Clone, Debug, Default)]
pub struct PixelGrid {
    /// Samples of a row.
    pub columns: usize,
    /// Rows of samples.
    pub rows: usize,
    /// Row-major.
    pub samples: Vec<Sample>,
    /// The lens, in samples instead of pixels, and how the camera was turned.
    pub camera: Option<SampleCamera>,
    slopes: Vec<DVec2>,
    slopes_of: Option<Intrinsics>,
}

/// The lens of a grid and the camera's attitude.
#[derive(Clone, Copy, Debug)]
pub struct SampleCamera {
    /// Of the image. [px]
    pub intrinsics: Intrinsics,
    /// Pixels from sample to sample.
    pub stride: usize,
    /// Takes camera axes to home axes.
    pub home_from_cam: DQuat,
}

impl SampleCamera {
    /// Returns where in the grid, column and row, the image is of what a vector from the camera falls on [m, home axes].
    pub fn sample_at(&self, offset_m: DVec3) -> Option<DVec2> {
        let pixel = self.intrinsics.project(self.home_from_cam.conjugate() * offset_m)?;
        let at = pixel / self.stride as f64;
        (at.x >= 0.0 && at.y >= 0.0).then_some(at)
    }

    /// Returns by how much a step of the point at `offset_m` [m, home axes] moves its image in the
    /// direction `across`. [samples/m, home axes]
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
    /// Takes a new image; an image whose planes are shorter than its size is not looked at.
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

    /// Turns what is seen about the camera. [home axes]
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

    /// Slopes of the samples' rays; the same until the camera changes.
    fn lay_out(&mut self, k: Intrinsics, stride: usize) {
        if self.slopes_of == Some(k) {
            return;
        }
        self.slopes.clear();
        for row in 0..self.rows {
            for column in 0..self.columns {
                let pixel = DVec2::new((column * stride) as f64, (row * stride) as f64) + 0.5;
                // Beyond the lens's reach: no way there, so nothing is seen there.
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

/// Samples of a row, about: every second pixel of 320.
const COLUMNS: usize = 160;
