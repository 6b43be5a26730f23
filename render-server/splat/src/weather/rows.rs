//! Per-pixel effects, in bands of rows for parallel processing: each band is read once and written
//! once.

use core::ops::Range;

use rayon::prelude::*;

use super::cloud::{self, Cloud, CloudPass, EDGES};
use super::exp::exp_neg;
use super::glare::Glare;
use super::light::{Illumination, RowLight};
use super::particles::ParticlePass;
use super::random::{mix, unit};
use super::rays::Rays;
use crate::{Atmosphere, RgbdImage};

/// Effects to apply to an image.
pub(super) struct Rows<'a> {
    pub(super) width: usize,
    pub(super) seed: u64,
    pub(super) atmosphere: Atmosphere,
    pub(super) rays: &'a Rays,
    pub(super) cloud: Option<(&'a CloudPass, Cloud)>,
    /// Extinction by rain and snow. [1/m]
    pub(super) veil_per_m: f32,
    pub(super) illumination: Option<(Illumination, RowLight)>,
    pub(super) particles: &'a ParticlePass,
    pub(super) glare: Option<Glare>,
    pub(super) depth_loss: bool,
}

/// Buffers of all bands.
#[derive(Debug, Default)]
pub(super) struct RowPass {
    bands: Vec<Band>,
}

/// Rows per band.
const ROWS: usize = 16;
/// Maximum depth of a surface. [m, cam]
const DEEPEST_M: f32 = 1e6;

/// Values of the pixels of one row; and, for all rows of a band, the optical depth up to the
/// surface.
#[derive(Debug, Default)]
struct Band {
    sx: Vec<f32>,
    sy: Vec<f32>,
    norm: Vec<f32>,
    z_m: Vec<f32>,
    /// Integrals of the cloud's density over z: up to the surface, and total.
    near: Vec<f32>,
    all: Vec<f32>,
    /// Transmitted share of the light.
    left: Vec<f32>,
    /// Light of the lamps, and of the vehicle.
    lamps: Vec<f32>,
    own: Vec<f32>,
    table: Vec<f32>,
    taken: Vec<f32>,
}

/// Rows of an image in one band.
struct BandImage<'a> {
    first_row: usize,
    rgb: &'a mut [f32],
    alpha: &'a [f32],
    expected_m: &'a mut [f32],
    median_m: &'a mut [f32],
    ids: &'a mut [u16],
}

impl RowPass {
    /// Applies all effects.
    pub(super) fn run(&mut self, rows: &Rows<'_>, image: &mut RgbdImage) {
        let pixels = ROWS * rows.width;
        self.bands
            .resize_with(image.alpha.len().div_ceil(pixels).max(self.bands.len()), Band::default);
        let images = image
            .rgb
            .par_chunks_mut(3 * pixels)
            .zip(image.alpha.par_chunks(pixels))
            .zip(image.depth_expected_m.par_chunks_mut(pixels))
            .zip(image.depth_median_m.par_chunks_mut(pixels))
            .zip(image.ids.par_chunks_mut(pixels));
        images.zip(&mut self.bands).enumerate().for_each(|(index, (parts, band))| {
            let ((((rgb, alpha), expected_m), median_m), ids) = parts;
            let first_row = index * ROWS;
            rows.run(band, &mut BandImage { first_row, rgb, alpha, expected_m, median_m, ids });
        });
    }
}

impl Rows<'_> {
    fn run(&self, band: &mut Band, image: &mut BandImage<'_>) {
        let width = self.width;
        let Band { sx, sy, norm, z_m, near, all, left, lamps, own, .. } = &mut *band;
        for row in [sx, sy, norm, z_m, near, all, left, lamps, own] {
            row.resize(width, 0.0);
        }
        band.table.resize(self.rays.columns * EDGES, 0.0);
        band.taken.resize(image.alpha.len(), 0.0);
        let takes_light = self.cloud.is_some() || self.veil_per_m > 0.0;
        for row in 0..image.alpha.len() / width {
            let y = image.first_row + row;
            let pixels = row * width..(row + 1) * width;
            self.look(band, y, &image.expected_m[pixels.clone()]);
            let rgb = &mut image.rgb[3 * pixels.start..3 * pixels.end];
            if let Some((illumination, light)) = &self.illumination {
                let Band { sx, sy, norm, z_m, lamps, own, .. } = &mut *band;
                illumination.light_row([sx, sy, norm, z_m], [lamps, own], light.of(y), rgb);
            }
            if takes_light {
                self.take_light(band, y, &image.alpha[pixels.clone()], rgb);
            }
            if self.depth_loss {
                self.note_taken(band, pixels);
            }
        }
        self.draw_particles(image);
        if let Some(glare) = &self.glare {
            for (row, rgb) in image.rgb.chunks_exact_mut(3 * width).enumerate() {
                self.look_along(band, image.first_row + row);
                glare.add_to_row([&band.sx, &band.sy, &band.norm], rgb);
            }
        }
        if self.depth_loss {
            self.lose_returns(band, image);
        }
    }

    /// Computes the directions of a row's pixels.
    fn look_along(&self, band: &mut Band, y: usize) {
        self.rays.write_row(y, &mut band.sx, &mut band.sy);
        for ((norm, sx), sy) in band.norm.iter_mut().zip(&band.sx).zip(&band.sy) {
            *norm = (1.0 + sx * sx + sy * sy).sqrt();
        }
    }

    /// Computes the directions of a row's pixels and the depths of their surfaces; 0 without
    /// surface.
    fn look(&self, band: &mut Band, y: usize, expected_m: &[f32]) {
        self.look_along(band, y);
        for (z_m, &expected_m) in band.z_m.iter_mut().zip(expected_m) {
            *z_m = if expected_m >= 0.0 { expected_m.min(DEEPEST_M) } else { 0.0 };
        }
    }

    /// Attenuates the light of a row by cloud, rain and snow, and adds their colours. The
    /// background of a pixel is infinitely far away.
    fn take_light(&self, band: &mut Band, y: usize, alpha: &[f32], rgb: &mut [f32]) {
        let veil = self.atmosphere.fog;
        let Some((pass, cloud)) = &self.cloud else {
            let pixels = band.norm.iter().zip(&band.z_m).zip(alpha).zip(rgb.chunks_exact_mut(3));
            for (((&norm, &z_m), &alpha), rgb) in pixels {
                let left = exp_neg(self.veil_per_m * z_m * norm);
                let given = 1.0 - alpha * left;
                for c in 0..3 {
                    rgb[c] = rgb[c] * left + veil[c] * given;
                }
            }
            return;
        };
        pass.write_row(self.rays, y, &mut band.table);
        self.integrate(band);
        let is_open = cloud.is_bounded() && self.veil_per_m == 0.0;
        let Band { norm, z_m, near, all, left, .. } = band;
        for ((((left, near), all), norm), z_m) in
            left.iter_mut().zip(&*near).zip(&mut *all).zip(&*norm).zip(&*z_m)
        {
            *left = exp_neg((cloud.per_m * near + self.veil_per_m * z_m) * norm);
            *all = if is_open { exp_neg(cloud.per_m * *all * norm) } else { 0.0 };
        }
        let pixels = rgb.chunks_exact_mut(3).zip(alpha).zip(&*left).zip(&*all);
        if self.veil_per_m == 0.0 {
            for (((rgb, &alpha), &left), &behind) in pixels {
                let given = 1.0 - alpha * left - (1.0 - alpha) * behind;
                for c in 0..3 {
                    rgb[c] = rgb[c] * left + cloud.color[c] * given;
                }
            }
            return;
        }
        for ((((rgb, &alpha), &left), &near), &z_m) in
            rgb.chunks_exact_mut(3).zip(alpha).zip(&*left).zip(&*near).zip(&*z_m)
        {
            let given = 1.0 - alpha * left;
            let (of_cloud, of_veil) = (cloud.per_m * near, self.veil_per_m * z_m);
            let share = of_veil / (of_cloud + of_veil).max(1e-12);
            for c in 0..3 {
                let color = cloud.color[c] + (veil[c] - cloud.color[c]) * share;
                rgb[c] = rgb[c] * left + color * given;
            }
        }
    }

    /// Computes the cloud's integrals over z for each pixel: up to its depth, and total.
    fn integrate(&self, band: &mut Band) {
        let Band { z_m, near, all, table, .. } = band;
        let cell = self.rays.cell_px;
        let per_px = 1.0 / cell as f32;
        let cells =
            z_m.chunks(cell).zip(near.chunks_mut(cell)).zip(all.chunks_mut(cell)).enumerate();
        for (column, ((z_m, near), all)) in cells {
            let pair = &table[column * EDGES..(column + 2) * EDGES];
            for (x, ((near, all), &z_m)) in near.iter_mut().zip(all).zip(z_m).enumerate() {
                (*near, *all) = cloud::integral_at(pair, (x as f32 + 0.5) * per_px, z_m);
            }
        }
    }

    /// Stores the optical depth up to each pixel's surface.
    fn note_taken(&self, band: &mut Band, pixels: Range<usize>) {
        let homogeneous = self.veil_per_m + self.atmosphere.fog_per_m;
        let per_m = self.cloud.as_ref().map_or(0.0, |(_, cloud)| cloud.per_m);
        let Band { norm, z_m, near, taken, .. } = band;
        for (((taken, norm), z_m), near) in taken[pixels].iter_mut().zip(norm).zip(z_m).zip(near) {
            *taken = (per_m * *near + homogeneous * *z_m) * *norm;
        }
    }

    /// Removes random returns of a depth camera, according to the optical depth there and back.
    fn lose_returns(&self, band: &Band, image: &mut BandImage<'_>) {
        let first = image.first_row * self.width;
        for (at, &taken) in band.taken.iter().enumerate().take(image.alpha.len()) {
            let chance = unit(mix(self.seed ^ mix((first + at) as u64)));
            if chance >= exp_neg(2.0 * taken) {
                (image.expected_m[at], image.median_m[at], image.ids[at]) = (0.0, 0.0, 0);
            }
        }
    }

    /// Draws drops and flakes that are in front of the surface.
    fn draw_particles(&self, image: &mut BandImage<'_>) {
        let (width, first) = (self.width, image.first_row as i32);
        let rows = [first, first + (image.alpha.len() / width) as i32];
        for streak in self.particles.streaks() {
            streak.draw(width as i32, rows, |x, y, opacity| {
                let pixel = (y - first) as usize * width + x as usize;
                let surface_m = image.median_m[pixel];
                // A pixel without surface is infinitely far away.
                if surface_m > 0.0 && surface_m < streak.z_m {
                    return;
                }
                for (value, color) in
                    image.rgb[3 * pixel..3 * pixel + 3].iter_mut().zip(streak.color)
                {
                    *value += (color - *value) * opacity;
                }
            });
        }
    }
}
