//! The hall about the net: floor, walls with windows and posters, ceiling with tubes, truss, net
//! and furniture. The same for `room` and `race`, but for colours and posters by seed.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use super::light::{LAMPS_M, TUBE_HALF_M};
use super::panel::{Block, Grain, INSET_M, Look, Painter, Panel};
use super::texture;
use crate::canvas::{Patch, paint};
use crate::random::{Rng, fractal2, noise2, smoothstep};

/// Inside of the hall's walls. [m, world]
pub(crate) const HALL_MIN_M: DVec3 = DVec3::new(-3.0, -5.0, 0.0);
/// Inside of the hall's walls and ceiling. [m, world]
pub(crate) const HALL_MAX_M: DVec3 = DVec3::new(14.0, 5.0, 5.0);
/// The netted flight space: 11 x 4.5 x 3.65 m. [m, world]
pub(crate) const NET_MIN_M: DVec3 = DVec3::new(0.0, -2.25, 0.0);
/// The netted flight space. [m, world]
pub(crate) const NET_MAX_M: DVec3 = DVec3::new(11.0, 2.25, 3.65);

/// A window of the north wall, in metres along the wall from its west end and up.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    min_m: DVec2,
    max_m: DVec2,
}

/// The windows.
pub(crate) const WINDOWS: [Window; 4] =
    [Window::at(1.2), Window::at(5.2), Window::at(9.2), Window::at(13.2)];

impl Window {
    const fn at(left_m: f64) -> Self {
        Self { min_m: DVec2::new(left_m, 1.5), max_m: DVec2::new(left_m + 2.6, 4.1) }
    }

    fn contains(&self, p: DVec2, margin_m: f64) -> bool {
        p.cmpge(self.min_m - margin_m).all() && p.cmple(self.max_m + margin_m).all()
    }

    /// Whether light passes at a point of the wall: within the window, beside its bars.
    pub(crate) fn is_pane(&self, p: DVec2) -> bool {
        let across = (p - self.min_m) / (self.max_m - self.min_m);
        let bar = |t: f64| (t - t.round()).abs() < 0.055;
        self.contains(p, 0.0) && !bar(across.x * 3.0) && !bar(across.y * 2.0)
    }
}

/// A piece of furniture with its texture.
struct Furniture {
    block: Block,
    colour: DVec3,
    kind: Surface,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Surface {
    Plain,
    Wood,
    /// Shows something on its face towards the net.
    Screen,
    Carton,
}

/// The hall of a seed.
pub(crate) struct Shell {
    seed: u64,
    furniture: Vec<Furniture>,
    truss: Vec<Block>,
}

impl Shell {
    /// Plans the hall of a seed.
    pub(crate) fn plan(seed: u64) -> Self {
        let mut rng = Rng::new(seed, 21);
        let mut shell = Self { seed, furniture: Vec::new(), truss: truss() };
        shell.furnish(&mut rng);
        shell
    }

    /// Returns the true solids: floor, walls, ceiling, truss and furniture.
    pub(crate) fn truth(&self) -> Vec<Volume> {
        let (a, b) = (HALL_MIN_M, HALL_MAX_M);
        let thick_m = 0.3;
        let wall = |min: DVec3, max: DVec3| Volume::aabb(min, max);
        let mut volumes = vec![
            Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 },
            wall(DVec3::new(a.x - thick_m, a.y, -0.1), DVec3::new(a.x, b.y, b.z)),
            wall(DVec3::new(b.x, a.y, -0.1), DVec3::new(b.x + thick_m, b.y, b.z)),
            wall(DVec3::new(a.x, a.y - thick_m, -0.1), DVec3::new(b.x, a.y, b.z)),
            wall(DVec3::new(a.x, b.y, -0.1), DVec3::new(b.x, b.y + thick_m, b.z)),
            wall(DVec3::new(a.x, a.y, b.z), DVec3::new(b.x, b.y, b.z + thick_m)),
        ];
        volumes.extend(self.truss.iter().map(Block::volume));
        volumes.extend(self.furniture.iter().map(|piece| piece.block.volume()));
        volumes
    }

    /// Returns the boxes whose shadows are seen.
    pub(crate) fn casters(&self) -> Vec<Volume> {
        let large = |piece: &&Furniture| {
            let half_m = piece.block.half_m;
            half_m.x * half_m.y > 0.04
        };
        self.furniture.iter().filter(large).map(|piece| piece.block.volume()).collect()
    }

    /// Paints the hall; `mats` colours the floor within the net.
    pub(crate) fn paint(&self, painter: &mut Painter, mats: &dyn Fn(DVec2) -> DVec3) {
        self.paint_floor(painter, mats);
        self.paint_walls(painter);
        paint_ceiling(painter);
        for block in &self.truss {
            let grain = Grain { coarse_m: 0.11, fine_m: 0.11 };
            painter.cuboid(block, grain, &[], &|_, p| {
                let band = noise2(7, DVec2::new(p.y / 0.3, p.x / 0.3));
                Some(Look::matt(paint(0x5b5f66).lerp(paint(0xa9adb2), band)))
            });
        }
        self.paint_furniture(painter);
        paint_net(painter);
    }

    fn paint_floor(&self, painter: &mut Painter, mats: &dyn Fn(DVec2) -> DVec3) {
        let (a, b) = (NET_MIN_M, NET_MAX_M);
        let inside = floor_panel(a.truncate(), b.truncate());
        let grain = Grain { coarse_m: 0.095, fine_m: 0.04 };
        painter.backed_panel(&inside, grain, &|p| Some(Look::matt(mats(p + a.truncate()))));
        // Polished concrete about it, with yellow tape along the net.
        let seed = self.seed;
        let concrete = move |at: DVec2| {
            let stain = fractal2(seed ^ 0x31, at / 1.9, 4);
            let speck = noise2(seed ^ 0x32, at / 0.11);
            let base = paint(0x6f7072).lerp(paint(0xa3a19b), 0.7 * stain + 0.3 * speck);
            let joint = |v: f64| (v / 3.0 - (v / 3.0).round()).abs() * 3.0 < 0.02;
            let out = (a.truncate() - at).max(at - b.truncate()).max_element();
            if (0.28..0.36).contains(&out) {
                paint(0xd8b21c) * (0.7 + 0.4 * speck)
            } else if joint(at.x - 1.0) || joint(at.y - 0.5) {
                base * 0.45
            } else {
                base
            }
        };
        let (low, high) = (HALL_MIN_M.truncate(), HALL_MAX_M.truncate());
        let strips = [
            (low, DVec2::new(high.x, a.y)),
            (DVec2::new(low.x, b.y), high),
            (DVec2::new(low.x, a.y), DVec2::new(a.x, b.y)),
            (DVec2::new(b.x, a.y), DVec2::new(high.x, b.y)),
        ];
        for (min, max) in strips {
            let grain = Grain { coarse_m: 0.19, fine_m: 0.09 };
            painter.backed_panel(&floor_panel(min, max), grain, &|p| {
                Some(Look::matt(concrete(p + min)))
            });
        }
    }

    fn paint_walls(&self, painter: &mut Painter) {
        let (a, b) = (HALL_MIN_M, HALL_MAX_M);
        let long = DVec2::new(b.x - a.x, b.z);
        let short = DVec2::new(b.y - a.y, b.z);
        let panel = |corner_m, right, size_m| Panel {
            corner_m,
            right,
            up: DVec3::Z,
            size_m,
            inset_m: INSET_M,
        };
        let north = panel(DVec3::new(a.x, b.y, 0.0), DVec3::X, long);
        let south = panel(DVec3::new(b.x, a.y, 0.0), DVec3::NEG_X, long);
        let east = panel(DVec3::new(b.x, b.y, 0.0), DVec3::NEG_Y, short);
        let west = panel(DVec3::new(a.x, a.y, 0.0), DVec3::Y, short);
        let grain = Grain { coarse_m: 0.36, fine_m: 0.042 };
        let seed = self.seed;
        painter.backed_panel(&north, grain, &|p| {
            if let Some(window) = WINDOWS.iter().find(|window| window.contains(p, 0.09)) {
                return Some(if window.is_pane(p) {
                    Look::lamp(texture::outside(seed, p))
                } else {
                    Look::matt(paint(0xe8e8e4))
                });
            }
            Some(Look::matt(texture::wall(seed, p)))
        });
        painter.backed_panel(&south, grain, &|p| Some(texture::with_pictures(seed, 1, p)));
        painter.backed_panel(&east, grain, &|p| Some(texture::with_pictures(seed, 2, p)));
        painter.backed_panel(&west, grain, &|p| Some(texture::with_pictures(seed, 3, p)));
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
        // Crash mats leaning at the far end, and a bench before the near wall.
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
        self.furniture.push(Furniture { block, colour, kind });
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
        // Screens stand on the far side of the table and look at the net.
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
        // A chair before it.
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

    fn paint_furniture(&self, painter: &mut Painter) {
        for (n, piece) in self.furniture.iter().enumerate() {
            let seed = self.seed ^ (n as u64 * 77);
            let colour = piece.colour;
            let size_m = piece.block.half_m.max_element();
            let coarse_m = if size_m < 0.12 { 0.06 } else { 0.11 };
            let grain = Grain { coarse_m, fine_m: 0.045 };
            let screen_face = if piece.block.center_m.y > 0.0 { 2 } else { 3 };
            // Undersides that stand on something are never seen.
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
}

/// Returns a level panel that looks up. [m, world]
pub(crate) fn floor_panel(min: DVec2, max: DVec2) -> Panel {
    // At a grazing angle a pixel takes the depth of the nearest patch that covers it: two
    // centimetres down, the floor is seen where it is.
    Panel {
        corner_m: min.extend(0.0),
        right: DVec3::X,
        up: DVec3::Y,
        size_m: max - min,
        inset_m: 0.024,
    }
}

/// Posts and rails that carry the net, just outside it.
fn truss() -> Vec<Block> {
    let half_m = 0.055;
    let (a, b) = (NET_MIN_M - 0.14, NET_MAX_M + 0.14);
    let mut blocks = Vec::new();
    for x in [a.x, 5.5, b.x] {
        for y in [a.y, b.y] {
            let low = DVec3::new(x - half_m, y - half_m, 0.0);
            blocks.push(Block::between(low, DVec3::new(x + half_m, y + half_m, b.z)));
        }
        let low = DVec3::new(x - half_m, a.y - half_m, b.z);
        let high = DVec3::new(x + half_m, b.y + half_m, b.z + 2.0 * half_m);
        blocks.push(Block::between(low, high));
    }
    for y in [a.y, b.y] {
        let low = DVec3::new(a.x - half_m, y - half_m, b.z);
        let high = DVec3::new(b.x + half_m, y + half_m, b.z + 2.0 * half_m);
        blocks.push(Block::between(low, high));
    }
    blocks
}

fn paint_ceiling(painter: &mut Painter) {
    let panel = Panel {
        corner_m: DVec3::new(HALL_MAX_M.x, HALL_MIN_M.y, HALL_MAX_M.z),
        right: DVec3::NEG_X,
        up: DVec3::Y,
        size_m: (HALL_MAX_M - HALL_MIN_M).truncate(),
        inset_m: INSET_M,
    };
    let grain = Grain { coarse_m: 0.4, fine_m: 0.1 };
    painter.backed_panel(&panel, grain, &|p| {
        let at = DVec2::new(HALL_MAX_M.x - p.x, HALL_MIN_M.y + p.y);
        let lamp = LAMPS_M
            .iter()
            .any(|lamp| (at.x - lamp.x).abs() < TUBE_HALF_M && (at.y - lamp.y).abs() < 0.14);
        if lamp {
            return Some(Look::lamp(DVec3::new(1.7, 1.68, 1.6)));
        }
        // Trapezoidal sheet between steel beams.
        let beam = (at.x / 2.83 - (at.x / 2.83).round()).abs() * 2.83 < 0.12;
        let rib = smoothstep(0.3, 0.5, (at.y / 0.9 - (at.y / 0.9).round()).abs());
        Some(Look::matt(if beam {
            paint(0x7a7d82)
        } else {
            paint(0xd6d6d2).lerp(paint(0xb4b5b2), rib)
        }))
    });
}

/// Thin, see-through strands on all sides of the flight space and above it. Fainter than what
/// counts as an obstacle: the fence keeps vehicles off the net.
fn paint_net(painter: &mut Painter) {
    let (a, b) = (NET_MIN_M - 0.05, NET_MAX_M + 0.05);
    let mut strand = |from_m: DVec3, to_m: DVec3| {
        let axis = to_m - from_m;
        let pieces = (axis.length() / 0.42).ceil();
        for n in 0..pieces as usize {
            painter.canvas.add(Patch {
                center_m: from_m + axis * ((n as f64 + 0.5) / pieces),
                normal: axis.cross(DVec3::new(0.3, 0.5, 0.8)),
                along: axis,
                sigma_m: DVec3::new(axis.length() / pieces * 0.55, 0.0025, 0.0025),
                opacity: 0.17,
                radiance: DVec3::splat(0.04),
            });
        }
    };
    let count = |length_m: f64| (length_m / NET_PITCH_M).round() as usize;
    let steps = |low: f64, high: f64| {
        let n = count(high - low);
        (0..=n).map(move |i| low + (high - low) * i as f64 / n as f64)
    };
    for y in [a.y, b.y] {
        for x in steps(a.x, b.x) {
            strand(DVec3::new(x, y, 0.0), DVec3::new(x, y, b.z));
        }
        for z in steps(0.0, b.z).skip(1) {
            strand(DVec3::new(a.x, y, z), DVec3::new(b.x, y, z));
        }
    }
    for x in [a.x, b.x] {
        for y in steps(a.y, b.y) {
            strand(DVec3::new(x, y, 0.0), DVec3::new(x, y, b.z));
        }
        for z in steps(0.0, b.z).skip(1) {
            strand(DVec3::new(x, a.y, z), DVec3::new(x, b.y, z));
        }
    }
    for x in steps(a.x, b.x) {
        strand(DVec3::new(x, a.y, b.z), DVec3::new(x, b.y, b.z));
    }
    for y in steps(a.y, b.y) {
        strand(DVec3::new(a.x, y, b.z), DVec3::new(b.x, y, b.z));
    }
}

/// Mesh width of the net; wider than real nets, so that it stays a net at 320 pixels. [m]
const NET_PITCH_M: f64 = 0.31;
const BRIGHT: [u32; 8] =
    [0xc23b2e, 0x2f6db3, 0xd9a32b, 0x3f8f55, 0x7a4d9c, 0x2b2e33, 0xdedad0, 0xd5702a];
