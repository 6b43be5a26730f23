//! Drops on the lens. Each shows its surroundings upside down and out of focus, for some seconds;
//! some run off.

use glam::Vec2;
use rayon::prelude::*;

use super::cloud::smooth;
use super::random::Random;

/// Drop on the lens at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
struct LensDrop {
    center_px: Vec2,
    radius_px: f32,
    /// Opacity; the drop fades in and out.
    opacity: f32,
}

/// Downscaled image without drops, and its buffers.
#[derive(Debug, Default)]
pub(super) struct LensPass {
    columns: usize,
    rows: usize,
    small: Vec<[f32; 3]>,
    drops: Vec<LensDrop>,
}

/// Size of a pixel of the downscaled image. [px of the image]
const SMALL: usize = 8;
/// Minimum and maximum radius, as shares of the image's height: drops of 1 to 4 mm in front of a
/// small lens, out of focus.
const RADII: [f32; 2] = [0.025, 0.085];
/// Minimum and maximum lifetime of a drop. [s]
const LIFE_S: [f64; 2] = [3.0, 9.0];
/// Share of the drops that run off at the end of their life, and the distance as a share of the
/// image's height.
const RUNNING: f32 = 0.4;
const RUN: f32 = 0.35;
/// Section of the image that a drop shows, as a share of the image's height.
const VIEW: f32 = 0.55;

impl LensPass {
    /// Draws the drops at an instant.
    pub(super) fn draw(
        &mut self,
        count: u32,
        seed: u64,
        at_s: f64,
        size: [usize; 2],
        rgb: &mut [f32],
    ) {
        let [width, height] = size;
        self.shrink(size, rgb);
        self.drops.clear();
        self.drops.extend((0..count).map(|index| drop_at(index, seed, at_s, size)));
        let this = &*self;
        rgb.par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
            for drop in &this.drops {
                this.draw_row(drop, y, width, height, row);
            }
        });
    }

    fn draw_row(&self, drop: &LensDrop, y: usize, width: usize, height: usize, row: &mut [f32]) {
        let down = (y as f32 + 0.5 - drop.center_px.y) / drop.radius_px;
        if down.abs() >= 1.0 {
            return;
        }
        let half = (1.0 - down * down).sqrt() * drop.radius_px;
        let from = (drop.center_px.x - half).max(0.0) as usize;
        let to = ((drop.center_px.x + half).max(0.0) as usize + 1).min(width);
        for x in from..to {
            let across = (x as f32 + 0.5 - drop.center_px.x) / drop.radius_px;
            let square = across * across + down * down;
            // Soft border, because the drop is out of focus.
            let opacity = drop.opacity * smooth((1.0 - square.sqrt()) * 1.8);
            if opacity <= 0.0 {
                continue;
            }
            // A steeper surface refracts to a point farther on the other side.
            let bend = (0.6 + 0.4 * square) * VIEW * height as f32;
            let at = drop.center_px - Vec2::new(across, down) * bend;
            let seen = self.sample(at);
            // The border shows surroundings outside the image, and reflects some light.
            let shade = 1.06 - 0.45 * square * square;
            for c in 0..3 {
                let value = &mut row[3 * x + c];
                *value += (seen[c] * shade - *value) * opacity;
            }
        }
    }

    /// Downscales the image by averaging blocks of pixels. Non-finite values count as black.
    fn shrink(&mut self, [width, height]: [usize; 2], rgb: &[f32]) {
        (self.columns, self.rows) = (width.div_ceil(SMALL), height.div_ceil(SMALL));
        self.small.resize(self.columns * self.rows, [0.0; 3]);
        let columns = self.columns;
        self.small.par_chunks_mut(columns).enumerate().for_each(|(row, out)| {
            out.fill([0.0; 3]);
            let rows = row * SMALL..(row * SMALL + SMALL).min(height);
            let down = rows.len();
            for y in rows {
                let line = &rgb[3 * y * width..3 * (y + 1) * width];
                for (sum, block) in out.iter_mut().zip(line.chunks(3 * SMALL)) {
                    for pixel in block.chunks_exact(3) {
                        for c in 0..3 {
                            sum[c] += if pixel[c] >= 0.0 { pixel[c].min(4.0) } else { 0.0 };
                        }
                    }
                }
            }
            for (column, sum) in out.iter_mut().enumerate() {
                let across = SMALL.min(width - column * SMALL);
                *sum = sum.map(|value| value / (across * down) as f32);
            }
        });
    }

    /// Samples the downscaled image at a position of the full-size image.
    fn sample(&self, at_px: Vec2) -> [f32; 3] {
        let most = Vec2::new((self.columns - 1) as f32, (self.rows - 1) as f32);
        let at = (at_px / SMALL as f32 - 0.5).clamp(Vec2::ZERO, most);
        let (x, y) = (at.x as usize, at.y as usize);
        let (x1, y1) = ((x + 1).min(self.columns - 1), (y + 1).min(self.rows - 1));
        let (tx, ty) = (at.x - x as f32, at.y - y as f32);
        let of = |x: usize, y: usize| self.small[y * self.columns + x];
        [0, 1, 2].map(|c| {
            let top = of(x, y)[c] + (of(x1, y)[c] - of(x, y)[c]) * tx;
            let bottom = of(x, y1)[c] + (of(x1, y1)[c] - of(x, y1)[c]) * tx;
            top + (bottom - top) * ty
        })
    }
}

/// Returns the current drop of a slot. A slot holds one drop after another.
fn drop_at(index: u32, seed: u64, at_s: f64, [width, height]: [usize; 2]) -> LensDrop {
    let mut of_place = Random::of(seed ^ SALT, [index.into(), 0, 0, 0]);
    let life_s = LIFE_S[0] + f64::from(of_place.unit()) * (LIFE_S[1] - LIFE_S[0]);
    let lives = at_s / life_s + f64::from(of_place.unit());
    let (generation, age) = (lives.floor(), (lives - lives.floor()) as f32);
    let mut random = Random::of(seed ^ SALT, [index.into(), 1, generation as i64, 0]);
    let size = Vec2::new(width as f32, height as f32);
    let mut center_px = Vec2::new(random.unit(), random.unit()) * size;
    let share = random.unit();
    let radius_px = RADII[0] * (RADII[1] / RADII[0]).powf(share * share) * size.y;
    if random.unit() < RUNNING {
        let run = ((age - 0.7) / 0.3).max(0.0);
        center_px.y += run * run * RUN * size.y;
    }
    let opacity = smooth(age / 0.01) * smooth((1.0 - age) / 0.12);
    LensDrop { center_px, radius_px, opacity }
}

/// Separates the random numbers of the drops from those of other effects.
const SALT: u64 = 0x1e45;
