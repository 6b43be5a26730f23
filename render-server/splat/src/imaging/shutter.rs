//! The shutter: what each pixel sees while it is exposed, by the camera's path and by depth, from one rendered image.
//!
//! A row is exposed from one instant to another. Where the camera is at both is known; a pixel's point is where its depth says,
//! so its path through the rendered image is known to first order, and the light along it is what the pixel collects. Rows that
//! are exposed one after the other see the camera at their own instants: rolling shutter and motion blur are one thing.
//!
//! Limits: what was hidden when the image was rendered is filled from beside it; what moves by itself stands still; the path is
//! straight within one exposure. `film/tests.rs` of the scenes and `tests.rs` here hold it against every row rendered at its instants.

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose};

/// What is the same in every image of a lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pixel {
    /// Slope of its ray in `cam`; NaN where the lens shows nothing.
    slope: Vec2,
    /// How far it moves when the slope does: columns of d(pixel) / d(slope). [px]
    by_slope: [Vec2; 2],
}

impl Pixel {
    /// Returns the slope `(x / z, y / z)` of its ray; NaN where the lens shows nothing. [cam]
    #[inline]
    pub fn slope(&self) -> Vec2 {
        self.slope
    }
}

/// Returns every pixel of a lens, row by row.
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

/// How a row's camera has moved from the one that was rendered.
#[derive(Clone, Copy, Debug)]
pub struct Moved {
    /// Rows of the rotation into the rendered camera.
    rows: [Vec3; 3],
    shift_m: Vec3,
}

impl Moved {
    /// Makes it of the row's camera in the rendered one.
    pub fn new(rendered_from_row: Pose<Cam, Cam>) -> Self {
        // The transpose's columns are the rotation's rows.
        let back = rendered_from_row.rotation.conjugate();
        let row = |axis: DVec3| (back * axis).as_vec3();
        Self {
            rows: [row(DVec3::X), row(DVec3::Y), row(DVec3::Z)],
            shift_m: rendered_from_row.translation_m.as_vec3(),
        }
    }

    /// Returns how far from a pixel its point is in the rendered image, if its depth is `1 / near`; to first order in the
    /// lens's bend, within 0.02 px over 10 px. [px]
    #[inline]
    fn shift_px(&self, pixel: &Pixel, near: f32) -> Vec2 {
        let ray = pixel.slope.extend(1.0);
        let [x, y, z] = self.rows.map(|row| row.dot(ray));
        let p = Vec3::new(x, y, z) + self.shift_m * near;
        let moved = p.truncate() / p.z - pixel.slope;
        pixel.by_slope[0] * moved.x + pixel.by_slope[1] * moved.y
    }
}

/// A rendered image in linear light, looked at by places of the image that is made; it may be larger by a margin.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    light: &'a [f32],
    depth_m: &'a [f32],
    origin: Vec2,
    width: usize,
    height: usize,
}

impl<'a> Seen<'a> {
    /// Makes it of H x W x 3 linear light and H x W camera-z depths [m, cam], 0 where nothing is; `origin` is where the image's
    /// upper left corner lies in it. [px]
    ///
    /// # Panics
    /// If the slices are not of this size.
    pub fn new(size: (u32, u32), light: &'a [f32], depth_m: &'a [f32], origin: Vec2) -> Self {
        let (width, height) = (size.0 as usize, size.1 as usize);
        assert_eq!(light.len(), 3 * width * height);
        assert_eq!(depth_m.len(), width * height);
        Self { light, depth_m, origin, width, height }
    }

    /// Returns one over the depth at a place; 0 where nothing is. [1/m]
    #[inline]
    fn nearness(&self, at: Vec2) -> f32 {
        let at = (at + self.origin).max(Vec2::ZERO);
        let (x, y) = ((at.x as usize).min(self.width - 1), (at.y as usize).min(self.height - 1));
        let depth_m = self.depth_m[y * self.width + x];
        if depth_m > 0.0 { 1.0 / depth_m } else { 0.0 }
    }

    /// Returns the light at a place, interpolated between pixels' middles.
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

    /// Writes the light that row `y` collects into `line`, three values a pixel, if its camera moves from `moved[0]` to
    /// `moved[1]` meanwhile. Where the lens shows nothing `line` is left as it is.
    pub fn expose_row(&self, pixels: &[Pixel], y: usize, moved: [Moved; 2], line: &mut [f32]) {
        for (x, (pixel, light)) in pixels.iter().zip(line.chunks_exact_mut(3)).enumerate() {
            // Where the lens shows nothing it stays dark.
            if !(pixel.slope.x.is_finite() && pixel.slope.y.is_finite()) {
                continue;
            }
            let here = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let ends = |near: f32| moved.map(|moved| here + moved.shift_px(pixel, near));
            // The depth of what the pixel sees, not of what stood there when the image was rendered.
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

/// More than a fast turn needs: one a pixel. A longer path is sampled more sparsely.
const MOST_SAMPLES: f32 = 16.0;
