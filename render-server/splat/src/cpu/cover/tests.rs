//! Compares covered blocks with the pixels that they contain.

use proptest::prelude::*;

use super::*;
use crate::cpu::simd::{InstructionSet, Kernel};

/// Returns a projected splat in the form of `project`, from its mean, covariance `[a b; b c]` [px^2] and the binary
/// logarithm of its opacity.
fn splat([mean_x, mean_y]: [f32; 2], [a, b, c]: [f32; 3], level: f32) -> Splat2d {
    let half = std::f32::consts::LOG2_E / 2.0;
    let reach = (level - MIN_LEVEL) * 2.0 * std::f32::consts::LN_2;
    let scale_x = (half * c / (a * c - b * b)).sqrt();
    Splat2d {
        mean_x,
        mean_y,
        shear: b / c,
        scale_x,
        scale_y: (half / c).sqrt(),
        level,
        tip_y: b * (reach / a).sqrt(),
        extent_y: (reach * c).sqrt(),
        width: 1.0 / scale_x,
        ..Splat2d::default()
    }
}

/// Returns the splat's level at a pixel's centre above the minimum visible level.
fn above(splat: &Splat2d, [x, y]: [usize; 2]) -> f32 {
    let (dx, dy) = (x as f32 + 0.5 - splat.mean_x, y as f32 + 0.5 - splat.mean_y);
    let (u, v) = ((dx - splat.shear * dy) * splat.scale_x, dy * splat.scale_y);
    splat.level - u * u - v * v - MIN_LEVEL
}

/// Finds the blocks of 4x4 tiles with [`Bands`]: by row of tiles, then tile.
struct Large<'a>(&'a Splat2d);

impl Kernel for Large<'_> {
    type Output = [[u32; 4]; 4];

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> [[u32; 4]; 4] {
        let mut tiles = [[0; 4]; 4];
        let step = S::LANES / bands(S::LANES);
        for first in (0..4).step_by(step) {
            let bands = Bands::new(s, self.0, (first * TILE) as f32);
            for column in 0..4 {
                let bits = bands.of_column(s, (column * TILE) as f32);
                for row in 0..step {
                    tiles[first + row][column] = Bands::<S>::of_row(bits, row);
                }
            }
        }
        tiles
    }
}

/// Finds the same blocks with [`window`] and [`Cover::split`], for a window that starts at a given block.
struct Small<'a>(&'a Splat2d, [usize; 2]);

impl Kernel for Small<'_> {
    type Output = [[u32; 4]; 4];

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> [[u32; 4]; 4] {
        let Self(splat, [left, top]) = self;
        let height = block_height(S::LANES);
        let corner = [s.splat((left * BLOCK_WIDTH) as f32), s.splat((top * height) as f32)];
        let halves = window(s, &Ellipse::of(s, splat), corner, [64, 64]).map(|half| {
            let mut lanes = [0.0; 16];
            s.store(half, &mut lanes);
            lanes[0] as u32
        });
        let blocks = halves[0] | halves[1] << 16;
        let cover = Cover { left: left as u16, top: top as u16, blocks };
        let [first, right, below, last] = cover.split(S::LANES);
        let (row, column) = (top / bands(S::LANES), left / COLUMNS);
        let mut tiles = [[0; 4]; 4];
        for (row, column, blocks) in [
            (row, column, first),
            (row, column + 1, right),
            (row + 1, column, below),
            (row + 1, column + 1, last),
        ] {
            if row < 4 && column < 4 {
                tiles[row][column] = blocks;
            } else {
                assert_eq!(blocks, 0, "beyond the image");
            }
        }
        tiles
    }
}

/// Checks 64x64 pixels: every visible pixel is in a listed block, and every listed block is needed, that is within a
/// pixel of it a point is visible or nearly visible.
fn check(
    splat: &Splat2d,
    lanes: usize,
    tiles: &[[u32; 4]; 4],
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
) {
    let (height, bands) = (block_height(lanes), bands(lanes));
    for y in rows.clone() {
        for x in columns.clone() {
            let block = x % TILE / BLOCK_WIDTH * bands + y % TILE / height;
            let listed = tiles[y / TILE][x / TILE] >> block & 1 == 1;
            let level = above(splat, [x, y]);
            assert!(listed || level < 1e-3, "pixel {x}, {y} of level {level} above is missed");
        }
    }
    for (row, tiles) in tiles.iter().enumerate() {
        for (column, &blocks) in tiles.iter().enumerate() {
            for block in (0..COLUMNS * bands).filter(|block| blocks >> block & 1 == 1) {
                let x = column * TILE + block / bands * BLOCK_WIDTH;
                let y = row * TILE + block % bands * height;
                // On a grid of eighths of a pixel between the block's pixel centres, ends included.
                let best = (0..=8 * (height - 1))
                    .flat_map(|j| (0..=8 * (BLOCK_WIDTH - 1)).map(move |i| (i, j)))
                    .map(|(i, j)| {
                        let shifted = Splat2d {
                            mean_x: splat.mean_x - i as f32 / 8.0,
                            mean_y: splat.mean_y - j as f32 / 8.0,
                            ..*splat
                        };
                        above(&shifted, [x, y])
                    })
                    .fold(f32::NEG_INFINITY, f32::max);
                assert!(best > -2.0, "block {x}, {y} is listed, its best is {best} above");
            }
        }
    }
}

proptest! {
    #[test]
    fn every_visible_pixel_is_in_a_listed_block(
        x in -10.0..74.0f32, y in -10.0..74.0f32,
        a in 0.3..400.0f32, c in 0.3..400.0f32, turn in -0.99..0.99f32, level in -7.9..-0.01f32,
    ) {
        let splat = splat([x, y], [a, turn * (a * c).sqrt(), c], level);
        for set in InstructionSet::available() {
            let tiles = set.run(Large(&splat));
            check(&splat, set.lanes(), &tiles, 0..64, 0..64);
        }
    }

    #[test]
    fn split_moves_a_window_to_its_tiles(
        left in 0usize..16, top in 0usize..32, x in 0.0..16.0f32, y in 0.0..16.0f32,
        a in 0.3..6.0f32, c in 0.3..6.0f32, turn in -0.99..0.99f32, level in -7.9..-0.01f32,
    ) {
        for set in InstructionSet::available() {
            let height = block_height(set.lanes());
            let top = top % (64 / height);
            let corner = [left * BLOCK_WIDTH, top * height];
            let mean = [corner[0] as f32 + x, corner[1] as f32 + y];
            let splat = splat(mean, [a, turn * (a * c).sqrt(), c], level);
            let tiles = set.run(Small(&splat, [left, top]));
            let ends = corner.map(|first| (first + TILE).min(64));
            check(&splat, set.lanes(), &tiles, corner[0]..ends[0], corner[1]..ends[1]);
        }
    }
}
