//! One image from its bands: every row at its own instants, then the sensor.

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose};

use super::{Band, BandImage, Exposure, Film, Track};
use crate::random::Rng;

/// What is the same in every image of a lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pixel {
    /// Slope of its ray in `cam`; NaN where the lens shows nothing.
    slope: Vec2,
    /// How far it moves when the slope does: columns of d(pixel) / d(slope). [px]
    by_slope: [Vec2; 2],
}

/// Returns every pixel of a lens, row by row.
pub(super) fn pixels(k: &Intrinsics) -> Vec<Pixel> {
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

/// Standard normal numbers, of which every row takes some.
#[derive(Debug)]
pub(super) struct Noise {
    normals: Vec<f32>,
}

impl Noise {
    pub(super) fn new() -> Self {
        let mut rng = Rng::new(0x0064_756e_6b65_6c00, 0);
        // Box and Muller 1958.
        let normal = |rng: &mut Rng| {
            let radius = (-2.0 * libm::log(1.0 - rng.unit())).sqrt();
            (radius * libm::cos(rng.angle())) as f32
        };
        Self { normals: (0..NORMALS).map(|_| normal(&mut rng)).collect() }
    }
}

impl Film {
    /// Returns an image, H x W x 3 bytes, from what its bands saw. `middle_s` is the middle of its middle row's exposure;
    /// `seed` determines the noise.
    ///
    /// # Panics
    /// If the bands are not this film's.
    pub fn develop(
        &self,
        images: &[BandImage],
        track: &Track<'_>,
        middle_s: f64,
        exposure: &Exposure,
        seed: u64,
    ) -> Vec<u8> {
        assert_eq!(images.len(), self.bands.len());
        let width = self.phone.intrinsics.width_px as usize;
        let mut bytes = vec![0; 3 * self.phone.intrinsics.pixels()];
        bytes.par_chunks_mut(3 * width).enumerate().for_each_init(Vec::new, |line, (y, out)| {
            let n = self.bands.partition_point(|band| band.rows.end as usize <= y);
            line.clear();
            line.resize(3 * width, 0.0);
            self.expose_row(&self.bands[n], &images[n], track, middle_s, exposure, y, line);
            self.read_row(line, exposure, y, seed, out);
        });
        bytes
    }

    /// Adds up the light of a row while it is exposed.
    #[expect(clippy::too_many_arguments, reason = "a row of all that an image is made of")]
    fn expose_row(
        &self,
        band: &Band,
        image: &BandImage,
        track: &Track<'_>,
        middle_s: f64,
        exposure: &Exposure,
        y: usize,
        line: &mut [f32],
    ) {
        let instant_s = self.phone.row_instant_s(y as f64 + 0.5, middle_s);
        let half_s = exposure.shutter_s / 2.0;
        let moved = [instant_s - half_s, instant_s + half_s]
            .map(|at_s| Moved::new(image.world_from_cam.inverse() * track(at_s)));
        let seen = Seen::new(band, image);
        let width = self.phone.intrinsics.width_px as usize;
        for (x, (pixel, light)) in
            self.pixels[y * width..][..width].iter().zip(line.chunks_exact_mut(3)).enumerate()
        {
            // Where the lens shows nothing it stays dark.
            if !(pixel.slope.x.is_finite() && pixel.slope.y.is_finite()) {
                continue;
            }
            let here = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let ends = |near: f32| moved.map(|moved| here + moved.shift_px(pixel, near));
            // The depth of what the pixel sees, not of what stood there when the band was rendered.
            let [a, b] = ends(seen.nearness(here));
            let [a, b] = ends(seen.nearness((a + b) * 0.5));
            let samples = (b - a).length().ceil().clamp(1.0, MOST_SAMPLES);
            let step = (b - a) / samples;
            let mut sum = Vec3::ZERO;
            for n in 0..samples as usize {
                sum += seen.light(a + step * (n as f32 + 0.5));
            }
            light.copy_from_slice(&(sum / samples).to_array());
        }
    }

    /// Reads a row of light out: vignette, gain, noise, tone.
    fn read_row(&self, line: &[f32], exposure: &Exposure, y: usize, seed: u64, out: &mut [u8]) {
        let k = &self.phone.intrinsics;
        let (shot, read) = self.phone.noise(exposure.iso);
        let (shot, read, gain) = (shot as f32, read as f32, exposure.gain as f32);
        let mut rng = Rng::new(seed, y as u64);
        let from = rng.below(NORMALS - line.len().min(NORMALS - 1));
        let normals = &self.noise.normals[from..];
        let v = (y as f32 + 0.5) / k.height_px as f32 - 0.5;
        let fall = 2.0 * self.phone.vignette as f32;
        for (x, (light, out)) in line.chunks_exact(3).zip(out.chunks_exact_mut(3)).enumerate() {
            let u = (x as f32 + 0.5) / k.width_px as f32 - 0.5;
            let bright = gain * (1.0 - fall * (u * u + v * v));
            for c in 0..3 {
                let signal = bright * light[c];
                let noise = (shot * signal + read).sqrt() * normals[(3 * x + c) % normals.len()];
                out[c] = self.tone.shown(signal + noise);
            }
        }
    }
}

/// How a row's camera has moved from its band's.
#[derive(Clone, Copy)]
struct Moved {
    /// Rows of the rotation into the band's camera.
    rows: [Vec3; 3],
    shift_m: Vec3,
}

impl Moved {
    fn new(band_from_row: Pose<Cam, Cam>) -> Self {
        // The transpose's columns are the rotation's rows.
        let back = band_from_row.rotation.conjugate();
        let row = |axis: DVec3| (back * axis).as_vec3();
        Self {
            rows: [row(DVec3::X), row(DVec3::Y), row(DVec3::Z)],
            shift_m: band_from_row.translation_m.as_vec3(),
        }
    }

    /// Returns how far from a pixel its point is in the band's image, if its depth is `1 / near`; to first order in the
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

/// A band's image, looked at by places of the whole image.
struct Seen<'a> {
    image: &'a BandImage,
    origin: Vec2,
    width: usize,
    height: usize,
}

impl<'a> Seen<'a> {
    fn new(band: &Band, image: &'a BandImage) -> Self {
        let k = &band.intrinsics;
        assert_eq!(image.light.len(), 3 * k.pixels());
        assert_eq!(image.depth_m.len(), k.pixels());
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        Self { image, origin: band.origin_px().as_vec2(), width, height }
    }

    /// Returns one over the depth at a place; 0 where nothing is. [1/m]
    #[inline]
    fn nearness(&self, at: Vec2) -> f32 {
        let at = (at + self.origin).max(Vec2::ZERO);
        let (x, y) = ((at.x as usize).min(self.width - 1), (at.y as usize).min(self.height - 1));
        let depth_m = self.image.depth_m[y * self.width + x];
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
        let upper = &self.image.light[from..from + 6];
        let lower = &self.image.light[from + 3 * self.width..][..6];
        let mix = |row: &[f32]| {
            let (a, b) = (Vec3::new(row[0], row[1], row[2]), Vec3::new(row[3], row[4], row[5]));
            a + (b - a) * u
        };
        let (above, below) = (mix(upper), mix(lower));
        above + (below - above) * v
    }
}

/// Numbers in the table of noise; a row takes them from anywhere on.
const NORMALS: usize = 1 << 16;
/// More than a fast turn needs: one a pixel. A longer path is sampled more sparsely.
const MOST_SAMPLES: f32 = 16.0;
