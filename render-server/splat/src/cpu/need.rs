//! Counts the work that an image needs, and computes the minimum time for it on a machine. Compared with measured
//! times, this shows how close the renderer is to the hardware limit.

use std::hint::black_box;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::bin::{Bins, Entry, TILE};
use super::cover::{BLOCK_WIDTH, bands, block_height};
use super::project::{MIN_LEVEL, Splat2d};
use super::simd::{InstructionSet, Kernel, Simd};
use crate::PassTimes;
use crate::limits::{ALPHA_MAX, TRANSMITTANCE_MIN};

/// Minimum work of any renderer that uses this method.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Need {
    /// Splats of the blocks in view: all are read and projected, many are then dropped.
    pub projected: u64,
    /// Visible splats: written, sorted and binned.
    pub visible: u64,
    /// Bytes of a splat's harmonics.
    pub harmonics_bytes: u64,
    /// (Tile, splat) pairs.
    pub pairs: u64,
    /// Pairs before the end of their tile's last pixel.
    pub pairs_used: u64,
    /// (Pixel, splat) pairs that change a pixel before it ends.
    pub evaluations: u64,
    /// Vectors of pixels, one per block, in which at least one pixel is evaluated. The other lanes of such a vector
    /// are idle.
    pub vectors: u64,
    /// Pixels of the image.
    pub pixels: u64,
}

/// Measured maximum throughput of all threads of this machine together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Machine {
    /// Values in a vector.
    pub lanes: usize,
    /// Vector operations such as multiply-add. [1/s]
    pub operations_per_s: f64,
    /// Bytes read and written, in a working set of the size that an image needs. [1/s]
    pub bytes_per_s: f64,
}

/// Operations of `blend_hits` on the floating-point ports, for one vector of pixels.
const OPERATIONS: u64 = 26;
/// Bytes of a packed splat's geometry.
const GEOMETRY: u64 = 52;
/// Bytes that projection writes per splat: splat, cover and key.
const PROJECTED: u64 = 64 + 8 + 4;
/// Bytes that two passes of the sort read and write per splat.
const SORTED: u64 = 2 * 4 + 8 + 2 * 8 + 4;
/// Bytes that binning reads per splat: slot and cover.
const BINNED: u64 = 4 + 8;
/// Bytes per pair: written to a piece, read, and written to the tile's list.
const PAIR: u64 = 8 + 8 + 8;
/// Bytes that blending reads per pair.
const BLENDED: u64 = 8 + 64;
/// Bytes per pixel: written to and read from a tile, and written to the image.
const PIXEL: u64 = 2 * 28 + 26;

impl Need {
    /// Returns the bytes that all passes read and write.
    pub fn bytes(&self) -> u64 {
        self.project_bytes() + self.sort_bytes() + self.bin_bytes() + self.blend_bytes()
    }

    fn project_bytes(&self) -> u64 {
        self.projected * GEOMETRY + self.visible * (PROJECTED + self.harmonics_bytes)
    }

    fn sort_bytes(&self) -> u64 {
        self.visible * SORTED
    }

    fn bin_bytes(&self) -> u64 {
        self.visible * BINNED + self.pairs * PAIR
    }

    fn blend_bytes(&self) -> u64 {
        self.pairs_used * BLENDED + self.pixels * PIXEL
    }

    /// Returns the minimum time of each pass: the longer of its operations (without idle lanes) and its memory
    /// traffic.
    pub fn bound(&self, machine: &Machine) -> PassTimes {
        let bytes = |bytes: u64| (bytes as f64 / machine.bytes_per_s * 1e3) as f32;
        let vectors = self.evaluations as f64 / machine.lanes as f64;
        let blend_ms = (vectors * OPERATIONS as f64 / machine.operations_per_s * 1e3) as f32;
        let mut bound = PassTimes {
            project_ms: bytes(self.project_bytes()),
            sort_ms: bytes(self.sort_bytes()),
            bin_ms: bytes(self.bin_bytes()),
            blend_ms: blend_ms.max(bytes(self.blend_bytes())),
            ..PassTimes::default()
        };
        bound.total_ms = bound.project_ms + bound.sort_ms + bound.bin_ms + bound.blend_ms;
        bound
    }
}

impl Machine {
    /// Measures the machine with an instruction set and `bytes` of memory; the best of several tries.
    pub(super) fn measure(set: InstructionSet, bytes: usize) -> Self {
        let threads = rayon::current_num_threads();
        let compute_s = fastest(&|| {
            let start = Instant::now();
            set.run(Multiply);
            start.elapsed()
        });
        let operations = (threads * Multiply::ROUNDS * Multiply::CHAINS) as f64;
        let len = (bytes / threads / 8).max(1024);
        let rounds = (16 << 20) / len + 1;
        let copy_s = fastest(&|| {
            let from = vec![1.0f32; len];
            let mut to = from.clone();
            let start = Instant::now();
            for _ in 0..rounds {
                to.copy_from_slice(black_box(&from));
                black_box(&mut to);
            }
            start.elapsed()
        });
        Self {
            lanes: set.lanes(),
            operations_per_s: operations / compute_s,
            bytes_per_s: (threads * rounds * len * 8) as f64 / copy_s,
        }
    }
}

/// Returns the time that all threads need in parallel, the best of several tries. [s]
fn fastest(work: &(dyn Fn() -> Duration + Sync)) -> f64 {
    const TRIES: usize = 8;
    let once = || rayon::broadcast(|_| work()).into_iter().max().unwrap_or_default();
    (0..TRIES).map(|_| once().as_secs_f64()).fold(f64::INFINITY, f64::min)
}

/// Independent chains of multiply-add, enough to hide the latency of an operation.
struct Multiply;

impl Multiply {
    const CHAINS: usize = 12;
    const ROUNDS: usize = 1 << 20;
}

impl Kernel for Multiply {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let factor = s.splat(black_box(0.999));
        let mut chains = [s.splat(1.0); Self::CHAINS];
        for _ in 0..Self::ROUNDS {
            for chain in &mut chains {
                *chain = s.mul_add(*chain, factor, factor);
            }
        }
        black_box(chains.map(|chain| s.sum(chain)));
    }
}

/// Counts the work of blending lists of `splats`, on an image of a given size [px], with vectors of `lanes` lanes.
pub(super) fn count(
    splats: &[Splat2d],
    bins: &Bins,
    [width_px, height_px]: [usize; 2],
    lanes: usize,
) -> Need {
    let tiles = bins.tiles_x * bins.tiles_y;
    let count = |tile: usize| {
        let origin = [tile % bins.tiles_x * TILE, tile / bins.tiles_x * TILE];
        let exists = |pixel: usize| {
            origin[0] + pixel % TILE < width_px && origin[1] + pixel / TILE < height_px
        };
        let mut live: Vec<usize> = (0..TILE * TILE).filter(|&pixel| exists(pixel)).collect();
        let mut need = Need { pairs: bins.list(tile).len() as u64, ..Need::default() };
        let mut transmittance = [1.0f32; TILE * TILE];
        for entry in bins.list(tile) {
            if live.is_empty() {
                break;
            }
            need.pairs_used += 1;
            let splat = &splats[Entry::of(entry).slot];
            let mut blocks = 0u32;
            live.retain(|&pixel| {
                let level = level(splat, [origin[0] + pixel % TILE, origin[1] + pixel / TILE]);
                if level <= MIN_LEVEL {
                    return true;
                }
                need.evaluations += 1;
                let band = pixel / TILE / block_height(lanes);
                blocks |= 1 << (pixel % TILE / BLOCK_WIDTH * bands(lanes) + band);
                transmittance[pixel] *= 1.0 - level.exp2().min(ALPHA_MAX as f32);
                transmittance[pixel] > TRANSMITTANCE_MIN as f32
            });
            need.vectors += u64::from(blocks.count_ones());
        }
        need
    };
    let none = || Need { pixels: (width_px * height_px) as u64, ..Need::default() };
    (0..tiles).into_par_iter().map(count).reduce(none, |a, b| Need {
        pairs: a.pairs + b.pairs,
        pairs_used: a.pairs_used + b.pairs_used,
        evaluations: a.evaluations + b.evaluations,
        vectors: a.vectors + b.vectors,
        pixels: a.pixels.max(b.pixels),
        ..a
    })
}

/// Returns log2 of a splat's alpha at a pixel's centre.
fn level(splat: &Splat2d, [x, y]: [usize; 2]) -> f32 {
    let dy = y as f32 + 0.5 - splat.mean_y;
    let dx = x as f32 + 0.5 - splat.mean_x - splat.shear * dy;
    splat.level - (splat.scale_y * dy).powi(2) - (splat.scale_x * dx).powi(2)
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};
    use vizflyt_protocol::geometry::{Intrinsics, Pose};

    use crate::{Camera, CpuRenderer, Need, Rasterizer, RgbdImage, Splats};

    /// Renders round splats ahead of the camera, given by distance [m] and opacity.
    fn need_of(splats: &[(f32, f32)]) -> (Need, RgbdImage) {
        let mut scene = Splats::default();
        for &(distance_m, opacity) in splats {
            scene.means_m.push(Vec3::Z * distance_m);
            scene.scales_m.push(Vec3::splat(0.2 * distance_m));
            scene.rotations.push(Quat::IDENTITY);
            scene.opacities.push(opacity);
            scene.sh.extend([0.5; 3]);
        }
        let intrinsics = Intrinsics::from_horizontal_fov(80, 60, 1.2);
        let camera = Camera::new(intrinsics, Pose::IDENTITY, 0.05);
        let mut renderer = CpuRenderer::new(&scene);
        let mut image = [RgbdImage::default()];
        renderer.render(&[], &[camera], &mut image).expect("a valid camera");
        let [image] = image;
        (renderer.need([80, 60]), image)
    }

    #[test]
    fn evaluates_one_splat_once_per_pixel() {
        let (need, image) = need_of(&[(2.0, 0.8)]);
        let shown = image.alpha.iter().filter(|&&alpha| alpha > 0.0).count() as u64;
        assert!(shown > 500 && need.evaluations == shown, "{need:?}, shown {shown}");
        // Most lanes of the vectors of a round splat are its own pixels.
        let lanes = CpuRenderer::new(&Splats::default()).machine(1 << 16).lanes as u64;
        assert!(need.vectors * lanes >= shown && need.vectors * lanes < 2 * shown, "{need:?}");
        assert_eq!((need.visible, need.pixels, need.pairs), (1, 80 * 60, need.pairs_used));
    }

    #[test]
    fn splats_behind_the_end_of_a_pixel_need_no_evaluation() {
        // Three of these leave a millionth of the light in the middle.
        let front = [(1.0, 1.0); 3];
        let (alone, _) = need_of(&front);
        let (all, _) = need_of(&[front[0], front[1], front[2], (3.0, 1.0)]);
        let behind = all.evaluations - alone.evaluations;
        assert!(behind > 0 && behind < alone.evaluations / 3, "{all:?} compared with {alone:?}");
    }

    #[test]
    fn bound_halves_on_a_machine_of_twice_the_speed() {
        let (need, _) = need_of(&[(2.0, 0.8)]);
        let machine = super::Machine { lanes: 8, operations_per_s: 1e9, bytes_per_s: 1e9 };
        let bound = need.bound(&machine);
        let by_hand = need.evaluations as f64 / 8.0 * super::OPERATIONS as f64 / 1e6;
        let bytes_ms = need.blend_bytes() as f64 / 1e6;
        assert!((f64::from(bound.blend_ms) - by_hand.max(bytes_ms)).abs() < 1e-4, "{bound:?}");
        let fast = super::Machine { lanes: 8, operations_per_s: 2e9, bytes_per_s: 2e9 };
        assert!((bound.total_ms - 2.0 * need.bound(&fast).total_ms).abs() < 1e-4);
    }
}
