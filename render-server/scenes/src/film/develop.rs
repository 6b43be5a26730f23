//! One image from its bands: every row at its own instants, then the sensor.

use rayon::prelude::*;
use vizflyt_protocol::geometry::{Cam, Pose, World};
use vizflyt_splat::imaging::exposure::vignetting;
use vizflyt_splat::imaging::shutter::{Moved, Seen};

use super::{Band, BandImage, Exposure, Film, Track};
use crate::random::Rng;

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
            let instant_s = self.phone.row_instant_s(y as f64 + 0.5, middle_s);
            let half_s = exposure.shutter_s / 2.0;
            let path = [instant_s - half_s, instant_s + half_s].map(track);
            self.expose_row(&self.bands[n], &images[n], path, y, line);
            self.read_row(line, exposure, y, seed, out);
        });
        bytes
    }

    /// Adds up the light of a row; `path` holds the camera's poses when its exposure begins and ends.
    fn expose_row(
        &self,
        band: &Band,
        image: &BandImage,
        path: [Pose<World, Cam>; 2],
        y: usize,
        line: &mut [f32],
    ) {
        let moved = path.map(|pose| Moved::new(image.world_from_cam.inverse() * pose));
        let size = (band.intrinsics.width_px, band.intrinsics.height_px);
        let seen = Seen::new(size, &image.light, &image.depth_m, band.origin_px().as_vec2());
        let width = self.phone.intrinsics.width_px as usize;
        seen.expose_row(&self.pixels[y * width..][..width], y, moved, line);
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
        let vignette = self.phone.vignette as f32;
        for (x, (light, out)) in line.chunks_exact(3).zip(out.chunks_exact_mut(3)).enumerate() {
            let u = (x as f32 + 0.5) / k.width_px as f32 - 0.5;
            let bright = gain * vignetting(vignette, u, v);
            for c in 0..3 {
                let signal = bright * light[c];
                let noise = (shot * signal + read).sqrt() * normals[(3 * x + c) % normals.len()];
                out[c] = self.tone.shown(signal + noise);
            }
        }
    }
}

/// Numbers in the table of noise; a row takes them from anywhere on.
const NORMALS: usize = 1 << 16;
