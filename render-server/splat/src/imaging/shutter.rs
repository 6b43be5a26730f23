//! Shutter: light that each pixel collects during its exposure, computed from one rendered image with the camera's
//! path and the depth.
//!
//! A row is exposed from one instant to another, and the camera's pose is known at both. The depth gives the point of
//! a pixel, so the pixel's path through the rendered image is known to first order, and the light along this path is
//! the light that the pixel collects. Rows that are exposed one after the other use the camera's pose at their own
//! instants, which covers both rolling shutter and motion blur.
//!
//! Limits: areas that were hidden in the rendered image are filled from their neighbours; moving objects are treated
//! as static; the path is straight within one exposure. `film/tests.rs` of the scenes and `tests.rs` here compare the
//! result with renderings of every row at its instants.

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose};

/// Values of a pixel that depend only on the lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pixel {
    /// Slope of its ray in `cam`; NaN if the lens does not image this pixel.
    slope: Vec2,
    /// Derivative of the pixel by the slope: columns of d(pixel) / d(slope). [px]
    by_slope: [Vec2; 2],
}

impl Pixel {
    /// Returns the slope `(x / z, y / z)` of its ray; NaN if the lens does not image this pixel. [cam]
    #[inline]
    pub fn slope(&self) -> Vec2 {
        self.slope
    }
}

/// Returns all pixels of a lens, row by row.
pub fn pixels(k: &Intrinsics) -> Vec<Pixel> {
    let focal = DVec2::new(k.fx_px, k.fy_px);
    let at = |(x, y): (u32, u32)| {
        let slope = k.slope(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        let slope = slope.unwrap_or(DVec2::NAN);
        let bend = k.distortion.distort(slope).1;
        let column = |column: DVec2| (focal * column).as_vec2();
        Pixel { slope: slope.as_vec2(), by_slope: [column(bend.x_axis), column(bend.y_axis)] }
    };
    let all: Vec<_> = (0..k.height_px).flat_map(|y| (0..k.width_px).map(move |x| (x, y))).collect();
    all.into_par_iter().map(at).collect()
}

/// Movement of a row's camera relative to the rendered one.
#[derive(Clone, Copy, Debug)]
pub struct Moved {
    /// Rows of the rotation into the rendered camera.
    rows: [Vec3; 3],
    shift_m: Vec3,
}

impl Moved {
    /// Creates the movement from the pose of the row's camera in the rendered one.
    pub fn new(rendered_from_row: Pose<Cam, Cam>) -> Self {
        // The columns of the transpose are the rows of the rotation.
        let back = rendered_from_row.rotation.conjugate();
        let row = |axis: DVec3| (back * axis).as_vec3();
        Self {
            rows: [row(DVec3::X), row(DVec3::Y), row(DVec3::Z)],
            shift_m: rendered_from_row.translation_m.as_vec3(),
        }
    }

    /// Returns the displacement of a pixel's point in the rendered image, if its depth is `1 / near`. To first order
    /// in the lens distortion, within 0.02 px over 10 px. [px]
    #[inline]
    fn shift_px(&self, pixel: &Pixel, near: f32) -> Vec2 {
        let ray = pixel.slope.extend(1.0);
        let [x, y, z] = self.rows.map(|row| row.dot(ray));
        let p = Vec3::new(x, y, z) + self.shift_m * near;
        let moved = p.truncate() / p.z - pixel.slope;
        pixel.by_slope[0] * moved.x + pixel.by_slope[1] * moved.y
    }
}

/// Rendered image in linear light, sampled at positions of the output image; it may be larger by a margin.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    light: &'a [f32],
    depth_m: &'a [f32],
    origin: Vec2,
    width: usize,
    height: usize,
}

impl<'a> Seen<'a> {
    /// Creates it from H x W x 3 linear light and H x W camera-z depths [m, cam], 0 without a surface.
    /// `origin` is the position of the output image's upper left corner in it. [px]
    ///
    /// # Panics
    /// If the slices do not have this size.
    pub fn new(size: (u32, u32), light: &'a [f32], depth_m: &'a [f32], origin: Vec2) -> Self {
        let (width, height) = (size.0 as usize, size.1 as usize);
        assert_eq!(light.len(), 3 * width * height);
        assert_eq!(depth_m.len(), width * height);
        Self { light, depth_m, origin, width, height }
    }

    /// Returns the inverse depth at a position; 0 without a surface. [1/m]
    #[inline]
    fn nearness(&self, at: Vec2) -> f32 {
        let at = (at + self.origin).max(Vec2::ZERO);
        let (x, y) = ((at.x as usize).min(self.width - 1), (at.y as usize).min(self.height - 1));
        let depth_m = self.depth_m[y * self.width + x];
        if depth_m > 0.0 { 1.0 / depth_m } else { 0.0 }
    }

    /// Returns the light at a position, interpolated between pixel centres.
    #[inline]
    fn light(&self, at: Vec2) -> Vec3 {
        let most = Vec2::new(self.width as f32 - 1.001, self.height as f32 - 1.001);
        let at = (at + self.origin - 0.5).max(Vec2::ZERO).min(most);
        let (x, y) = (at.x as usize, at.y as usize);
        let (u, v) = (at.x - x as f32, at.y - y as f32);
        let from = 3 * (y * self.width + x);
        let upper = &self.light[from..from + 6];
        let lower = &self.light[from + 3 * self.width..][..6];
        let mix = |row: &[f32]| {
            let (a, b) = (Vec3::new(row[0], row[1], row[2]), Vec3::new(row[3], row[4], row[5]));
            a + (b - a) * u
        };
        let (above, below) = (mix(upper), mix(lower));
        above + (below - above) * v
    }

    /// Writes the light that row `y` collects to `line`, three values per pixel, while its camera moves from
    /// `moved[0]` to `moved[1]`. Pixels that the lens does not image are left unchanged.
    pub fn expose_row(&self, pixels: &[Pixel], y: usize, moved: [Moved; 2], line: &mut [f32]) {
        for (x, (pixel, light)) in pixels.iter().zip(line.chunks_exact_mut(3)).enumerate() {
            // Pixels that the lens does not image stay dark.
            if !(pixel.slope.x.is_finite() && pixel.slope.y.is_finite()) {
                continue;
            }
            let here = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let ends = |near: f32| moved.map(|moved| here + moved.shift_px(pixel, near));
            // Depth of the point that the pixel sees, not of the point at the same place in the rendered image.
            let [a, b] = ends(self.nearness(here));
            let [a, b] = ends(self.nearness((a + b) * 0.5));
            let samples = (b - a).length().ceil().clamp(1.0, MOST_SAMPLES);
            let step = (b - a) / samples;
            let mut sum = Vec3::ZERO;
            for n in 0..samples as usize {
                sum += self.light(a + step * (n as f32 + 0.5));
            }
            light.copy_from_slice(&(sum / samples).to_array());
        }
    }
}

/// Maximum number of samples: one per pixel of path, more than a fast rotation needs. Longer paths are sampled more
/// sparsely.
const MOST_SAMPLES: f32 = 16.0;
