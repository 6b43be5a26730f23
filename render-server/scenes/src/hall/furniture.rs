//! Furniture around the net: tables with screens, shelves, crates, mats and a bench, all made of boxes.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use super::panel::{Block, Grain, Look, Painter};
use super::texture;
use crate::canvas::paint;
use crate::random::{Rng, fractal2, noise2};

/// Furniture of a hall.
#[derive(Debug)]
pub(crate) struct Furniture {
    seed: u64,
    pieces: Vec<Piece>,
}

/// Box with its texture.
#[derive(Debug)]
struct Piece {
    block: Block,
    colour: DVec3,
    kind: Surface,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Surface {
    Plain,
    Wood,
    /// Screen on the face towards the net.
    Screen,
    Carton,
}

impl Furniture {
    /// Places the furniture of a seed.
    pub(crate) fn place(seed: u64) -> Self {
        let mut furniture = Self { seed, pieces: Vec::new() };
        furniture.furnish(&mut Rng::new(seed, 21));
        furniture
    }

    /// Returns the solids.
    pub(crate) fn volumes(&self) -> impl Iterator<Item = Volume> {
        self.pieces.iter().map(|piece| piece.block.volume())
    }

    /// Returns the boxes that cast visible shadows.
    pub(crate) fn casters(&self) -> Vec<Volume> {
        let large = |piece: &&Piece| {
            let half_m = piece.block.half_m;
            half_m.x * half_m.y > 0.04
        };
        self.pieces.iter().filter(large).map(|piece| piece.block.volume()).collect()
    }

    /// Paints all pieces.
    pub(crate) fn paint(&self, painter: &mut Painter) {
        for (n, piece) in self.pieces.iter().enumerate() {
            let seed = self.seed ^ (n as u64 * 77);
            let colour = piece.colour;
            let size_m = piece.block.half_m.max_element();
            let coarse_m = if size_m < 0.12 { 0.06 } else { 0.11 };
            let grain = Grain { coarse_m, fine_m: 0.045 };
            let screen_face = if piece.block.center_m.y > 0.0 { 2 } else { 3 };
            // Undersides on a surface are never visible.
            let skip: &[usize] = if piece.block.half_m.z > 0.1 { &[4] } else { &[] };
            painter.cuboid(&piece.block, grain, skip, &|face, p| {
                Some(match piece.kind {
                    Surface::Plain => Look::matt(colour * (0.85 + 0.3 * noise2(seed, p / 0.12))),
                    Surface::Wood => {
                        let ring = fractal2(seed, DVec2::new(p.x / 0.5, p.y / 0.045), 2);
                        Look::matt(colour * (0.65 + 0.65 * ring))
                    }
                    Surface::Carton => {
                        let size = piece.block.face(face).size_m;
                        let tape = (p.x - size.x / 2.0).abs() < 0.03;
                        let label = (p - size * DVec2::new(0.72, 0.35)).abs();
                        if label.x < 0.07 && label.y < 0.05 && face != 5 {
                            Look::matt(paint(0xe6e4dc))
                        } else if tape {
                            Look::matt(colour * 1.35)
                        } else {
                            Look::matt(colour * (0.85 + 0.25 * noise2(seed, p / 0.2)))
                        }
                    }
                    Surface::Screen if face == screen_face => {
                        texture::screen(seed, p / piece.block.face(face).size_m)
                    }
                    Surface::Screen => Look::matt(colour),
                })
            });
        }
    }

    fn furnish(&mut self, rng: &mut Rng) {
        for x in [1.2, 4.6, 10.6] {
            let x = x + rng.spread(0.3);
            self.table(rng, DVec2::new(x, -4.2));
        }
        let [first, second, third] = [7.4, 3.2, 0.4].map(|x| x + rng.spread(0.3));
        self.shelf(rng, first, -4.72);
        self.table(rng, DVec2::new(second, 4.2));
        self.shelf(rng, third, 4.72);
        for at in [DVec2::new(8.6, 4.3), DVec2::new(12.9, 3.2), DVec2::new(-2.2, -3.4)] {
            self.crates(rng, at);
        }
        // Crash mats at the far end, and a bench in front of the near wall.
        let mat = Block::between(DVec3::new(13.3, -2.2, 0.0), DVec3::new(13.65, -0.2, 1.25));
        self.put(mat, paint(0x2858a8), Surface::Plain);
        let mat = Block::between(DVec3::new(13.3, 0.1, 0.0), DVec3::new(13.65, 2.1, 1.25));
        self.put(mat, paint(0xb8402c), Surface::Plain);
        let seat = Block::between(DVec3::new(-2.7, -1.6, 0.42), DVec3::new(-2.3, 1.6, 0.48));
        self.put(seat, paint(0x9a6f3f), Surface::Wood);
        for y in [-1.4, 1.35] {
            let leg = Block::between(DVec3::new(-2.65, y, 0.0), DVec3::new(-2.35, y + 0.06, 0.42));
            self.put(leg, paint(0x2c2e31), Surface::Plain);
        }
    }

    fn put(&mut self, block: Block, colour: DVec3, kind: Surface) {
        self.pieces.push(Piece { block, colour, kind });
    }

    fn table(&mut self, rng: &mut Rng, at: DVec2) {
        let half = DVec2::new(0.85, 0.38);
        let between = |min: DVec2, low_m, max: DVec2, high_m| {
            Block::between((at + min).extend(low_m), (at + max).extend(high_m))
        };
        self.put(between(-half, 0.71, half, 0.75), paint(0xb99a6b), Surface::Wood);
        for corner in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let foot = DVec2::from(corner) * (half - 0.06);
            let leg = between(foot - 0.03, 0.0, foot + 0.03, 0.71);
            self.put(leg, paint(0x303236), Surface::Plain);
        }
        // Screens are on the far side of the table and face the net.
        let back = half.y * 0.4 * at.y.signum();
        for x in [-0.45, 0.35] {
            let middle = DVec2::new(x + rng.spread(0.08), back);
            let size = DVec2::new(0.29, 0.02);
            let screen = between(middle - size, 0.84, middle + size, 1.2);
            self.put(screen, paint(0x17181b), Surface::Screen);
            let foot = DVec2::new(0.05, 0.03);
            let stand = between(middle - foot, 0.75, middle + foot, 0.84);
            self.put(stand, paint(0x17181b), Surface::Plain);
        }
        let cup = DVec2::new(rng.range(-0.1, 0.1), -0.15 * at.y.signum());
        let colour = BRIGHT[rng.below(BRIGHT.len())];
        self.put(between(cup - 0.06, 0.75, cup + 0.06, 0.87), paint(colour), Surface::Plain);
        // A chair in front of the table.
        let chair = DVec2::new(rng.range(-0.4, 0.4), -0.75 * at.y.signum());
        self.put(between(chair - 0.22, 0.43, chair + 0.22, 0.49), paint(0x25282d), Surface::Plain);
        self.put(between(chair - 0.03, 0.0, chair + 0.03, 0.43), paint(0x3a3d42), Surface::Plain);
    }

    fn shelf(&mut self, rng: &mut Rng, x: f64, y: f64) {
        let half = DVec2::new(0.8, 0.24);
        let at = DVec2::new(x, y);
        for level in 0..5 {
            let z = 0.1 + 0.46 * f64::from(level);
            let board = Block::between((at - half).extend(z), (at + half).extend(z + 0.03));
            self.put(board, paint(0x8f9399), Surface::Plain);
            if level == 4 {
                break;
            }
            let mut left = -half.x + 0.05;
            while left < half.x - 0.2 {
                let width = rng.range(0.14, 0.36).min(half.x - 0.03 - left);
                let height = rng.range(0.16, 0.38);
                let a = at + DVec2::new(left, -half.y * 0.85);
                let b = at + DVec2::new(left + width, half.y * rng.range(0.4, 0.85));
                let block = Block::between(a.extend(z + 0.03), b.extend(z + 0.03 + height));
                if rng.chance(0.6) {
                    self.put(block, paint(BRIGHT[rng.below(BRIGHT.len())]), Surface::Plain);
                } else {
                    self.put(block, paint(0xa47c4c), Surface::Carton);
                }
                left += width + rng.range(0.02, 0.1);
            }
        }
        for sx in [-1.0, 1.0] {
            let post = at + DVec2::new(sx * half.x, 0.0);
            let size = DVec2::new(0.02, half.y);
            let block = Block::between((post - size).extend(0.0), (post + size).extend(2.1));
            self.put(block, paint(0x44474c), Surface::Plain);
        }
    }

    fn crates(&mut self, rng: &mut Rng, at: DVec2) {
        let mut z = 0.0;
        let mut half = rng.range(0.34, 0.42);
        for _ in 0..3 {
            let height = rng.range(0.35, 0.6);
            let shift = DVec2::new(rng.spread(0.08), rng.spread(0.08));
            let block = Block::between(
                (at + shift - half).extend(z),
                (at + shift + half).extend(z + height),
            );
            let carton = rng.chance(0.55);
            let kind = if carton { Surface::Carton } else { Surface::Wood };
            self.put(block, paint(if carton { 0xa9814f } else { 0x8c6a3e }), kind);
            z += height;
            half *= rng.range(0.7, 0.9);
        }
    }
}

const BRIGHT: [u32; 8] =
    [0xc23b2e, 0x2f6db3, 0xd9a32b, 0x3f8f55, 0x7a4d9c, 0x2b2e33, 0xdedad0, 0xd5702a];
