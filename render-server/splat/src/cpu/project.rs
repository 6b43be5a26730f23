//! Pass 2: projects the splats of visible blocks onto the image plane.
//!
//! Budget: 52 bytes read per splat of a visible block, plus its harmonics if a lane of its vector survives; 76 bytes
//! written per survivor. About 4 ns per splat and thread without harmonics.
//!
//! A projected Gaussian is kept in the form that is cheap and stable to evaluate. With covariance
//! `[a b; b c]` and `det = a c - b^2`,
//!   `sigma = c/det (dx - b/c dy)^2 / 2 + dy^2 / c / 2`:
//! two squares, so it is never negative, while the usual conic cancels. `det` is computed from the minors of the 2x3
//! square root (Cauchy-Binet), so it cannot cancel either.

use glam::Vec3;
use rayon::prelude::*;

use super::cover::{self, BLOCK_WIDTH, COLUMNS, Cover, Ellipse};
use super::cull::{ObjectView, Visible};
use super::lens::{self, Model};
use super::scene::{BLOCK, GROUP, GROUP_NUMBERS, Part, column};
use super::simd::{Kernel, Simd};
use crate::Atmosphere;
use crate::harmonics::{C0, C1, C2, C3};
use crate::limits::BLUR_PX2;

/// log2(1/255): minimum level of a visible splat.
pub(super) const MIN_LEVEL: f32 = -7.994_353_5;
/// Half of log2(e): the factor 1/2 of sigma, for powers of two.
const HALF_LOG2_E: f32 = std::f32::consts::LOG2_E / 2.0;
/// Extent^2 of the ellipse per level and variance: 2 ln 2.
const EXTENT2: f32 = 2.0 * std::f32::consts::LN_2;
/// Maximum extent of a splat; prevents overflow of f32. [px]
const MAX_EXTENT_PX: f32 = 1e18;

/// Gaussian on the image plane. Alpha at (x, y) is `2^(level - (scale_x (dx - shear dy))^2 - (scale_y dy)^2)`, with
/// dx and dy relative to the mean. [px] Exactly one cache line, so that reading it is one memory access.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(super) struct Splat2d {
    pub(super) mean_x: f32,
    pub(super) mean_y: f32,
    pub(super) shear: f32,
    pub(super) scale_x: f32,
    pub(super) scale_y: f32,
    /// Binary logarithm of the opacity.
    pub(super) level: f32,
    /// dy of the rightmost point of the ellipse alpha = 1/255.
    pub(super) tip_y: f32,
    /// Half height of that ellipse.
    pub(super) extent_y: f32,
    /// `1 / scale_x`, limited to 1e15, so that 0 times it is 0.
    pub(super) width: f32,
    /// Camera z. [m]
    pub(super) z_m: f32,
    pub(super) rgb: [f32; 3],
    pub(super) tiles: TileBox,
}

/// Tiles that the box around the ellipse alpha = 1/255 touches, both ends included.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct TileBox {
    pub(super) left: u16,
    pub(super) right: u16,
    pub(super) top: u16,
    pub(super) bottom: u16,
}

/// Output of the pass: per visible block a region of [`BLOCK`] slots, filled from its start.
#[derive(Debug, Default)]
pub(super) struct Projected {
    /// Indexed by slot.
    pub(super) splats: Vec<Splat2d>,
    /// Blocks of pixels by slot. Separate from the splats, because binning needs only the cover of most splats.
    pub(super) covers: Vec<Cover>,
    /// Camera z by slot, as bits; for positive numbers their order is the same.
    pub(super) keys: Vec<u32>,
    /// Filled slots of each region.
    pub(super) counts: Vec<u32>,
}

/// Projects all splats of the visible blocks; `views` contains the camera relative to each of `parts`.
pub(super) fn project<S: Simd>(
    simd: S,
    parts: &[Part],
    views: &[ObjectView],
    visible: &[Visible],
    out: &mut Projected,
) {
    let slots = visible.len() * BLOCK;
    if out.splats.len() < slots {
        out.splats.resize(slots, Splat2d::default());
        out.covers.resize(slots, Cover::default());
        out.keys.resize(slots, 0);
    }
    out.counts.resize(visible.len(), 0);
    // A camera has the same lens for all parts.
    let distorted = views.first().is_some_and(|view| view.model != Model::Pinhole);
    out.splats
        .par_chunks_mut(BLOCK)
        .zip(out.covers.par_chunks_mut(BLOCK))
        .zip(out.keys.par_chunks_mut(BLOCK))
        .zip(&mut out.counts)
        .zip(visible)
        // Four blocks are about 5 us of work.
        .with_min_len(4)
        .for_each(|((((splats, covers), keys), count), &Visible { part, block })| {
            let out = Region { splats, covers, keys };
            let (part, view) = (&parts[part as usize], &views[part as usize]);
            let block = block as usize;
            *count = match (distorted, part.antialiased) {
                (false, false) => simd.run(ProjectBlock::<false, false> { part, view, block, out }),
                (true, false) => simd.run(ProjectBlock::<true, false> { part, view, block, out }),
                (false, true) => simd.run(ProjectBlock::<false, true> { part, view, block, out }),
                (true, true) => simd.run(ProjectBlock::<true, true> { part, view, block, out }),
            } as u32;
        });
}

/// Projects one block, through a lens or a pinhole, anti-aliased or classic. Returns the number of surviving splats.
struct ProjectBlock<'a, const LENS: bool, const ANTIALIASED: bool> {
    part: &'a Part,
    view: &'a ObjectView,
    block: usize,
    out: Region<'a>,
}

/// Slots of one block.
struct Region<'a> {
    splats: &'a mut [Splat2d],
    covers: &'a mut [Cover],
    keys: &'a mut [u32],
}

impl<const LENS: bool, const ANTIALIASED: bool> Kernel for ProjectBlock<'_, LENS, ANTIALIASED> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) -> usize {
        let groups = BLOCK / GROUP;
        let sh_numbers = self.part.coefficients * 3 * GROUP;
        let geometry = &self.part.geometry[self.block * groups * GROUP_NUMBERS..];
        let sh = &self.part.sh[self.block * groups * sh_numbers..];
        let mut count = 0;
        for group in 0..groups {
            let geometry = &geometry[group * GROUP_NUMBERS..][..GROUP_NUMBERS];
            let sh = &sh[group * sh_numbers..][..sh_numbers];
            for first in (0..GROUP).step_by(S::LANES) {
                let columns = Columns { s, geometry, first };
                let (view, out) = (self.view, &mut self.out);
                count = vector::<S, LENS, ANTIALIASED>(columns, view, sh, out, count);
            }
        }
        count
    }
}

/// Projects the lanes from `first` of a group, and appends survivors from slot `count` on. Returns the new count.
#[inline(always)]
fn vector<S: Simd, const LENS: bool, const ANTIALIASED: bool>(
    columns: Columns<'_, S>,
    view: &ObjectView,
    sh: &[u16],
    out: &mut Region,
    mut count: usize,
) -> usize {
    let Columns { s, first, .. } = columns;
    let mean = columns.vector(column::MEAN);
    // Subtracts the camera's position first: large coordinates cancel while they are exact.
    let centre = view.center_m;
    let d = [mean[0] - s.splat(centre.x), mean[1] - s.splat(centre.y), mean[2] - s.splat(centre.z)];
    let rows = [broadcast(s, view.rows[0]), broadcast(s, view.rows[1]), broadcast(s, view.rows[2])];
    let z = dot(s, rows[2], d);
    // NaN fails here, including that of padding.
    let mut ahead = s.lt(s.splat(view.near_m), z);
    if !s.any(ahead) {
        return count;
    }
    let inverse_z = s.splat(1.0) / z;
    let (tx, ty) = (dot(s, rows[0], d) * inverse_z, dot(s, rows[1], d) * inverse_z);
    let (fx, fy) = (s.splat(view.fx_px), s.splat(view.fy_px));
    // Rows of J W, linearised where the slope is clamped.
    let mut at = [clamp(s, tx, view.slope_x), clamp(s, ty, view.slope_y)];
    let mut slope = [tx, ty];
    let (gx, gy) = if LENS {
        let reach = s.splat(view.reach);
        ahead = ahead & s.lt(s.mul_add(tx, tx, ty * ty), reach * reach);
        if !s.any(ahead) {
            return count;
        }
        slope = lens::distort(s, &view.model, slope).slope;
        let shorten = s.min(reach / s.sqrt(s.mul_add(at[0], at[0], at[1] * at[1])), s.splat(1.0));
        at = [at[0] * shorten, at[1] * shorten];
        let [xx, xy, yy] = lens::distort(s, &view.model, at).jacobian;
        let pinhole_x = gradient(s, inverse_z, at[0], rows[0], rows[2]);
        let pinhole_y = gradient(s, inverse_z, at[1], rows[1], rows[2]);
        (
            mix(s, fx * xx, pinhole_x, fx * xy, pinhole_y),
            mix(s, fy * xy, pinhole_x, fy * yy, pinhole_y),
        )
    } else {
        (
            gradient(s, inverse_z * fx, at[0], rows[0], rows[2]),
            gradient(s, inverse_z * fy, at[1], rows[1], rows[2]),
        )
    };
    let mean_x = s.mul_add(slope[0], fx, s.splat(view.cx_px));
    let mean_y = s.mul_add(slope[1], fy, s.splat(view.cy_px));

    // Rows of J W M, M the square root of the covariance.
    let axes = [
        columns.vector(column::AXES),
        columns.vector(column::AXES + 3),
        columns.vector(column::AXES + 6),
    ];
    let u = [dot(s, gx, axes[0]), dot(s, gx, axes[1]), dot(s, gx, axes[2])];
    let v = [dot(s, gy, axes[0]), dot(s, gy, axes[1]), dot(s, gy, axes[2])];
    let blur = s.splat(BLUR_PX2 as f32);
    let (uu, b, vv) = (dot(s, u, u), dot(s, u, v), dot(s, v, v));
    let (a, c) = (uu + blur, vv + blur);
    let minors = [
        s.neg_mul_add(u[1], v[0], u[0] * v[1]),
        s.neg_mul_add(u[2], v[1], u[1] * v[2]),
        s.neg_mul_add(u[0], v[2], u[2] * v[0]),
    ];
    let blur2 = s.splat((BLUR_PX2 * BLUR_PX2) as f32);
    let sharp = dot(s, minors, minors);
    let determinant = s.mul_add(blur, uu + vv, sharp + blur2);

    let mut level = columns.load(column::LEVEL);
    if ANTIALIASED {
        // Dimmed by the area that the blur adds; not if both overflow. For a needle, the logarithm of 0 is far below
        // any visible level.
        let ratio = s.min(sharp / determinant, s.splat(1.0));
        level = s.mul_add(s.log2(ratio), s.splat(0.5), level);
    }
    let reach2 = (level - s.splat(MIN_LEVEL)) * s.splat(EXTENT2);
    let extent_x = s.sqrt(reach2 * a);
    let extent_y = s.sqrt(reach2 * c);
    let seen = ahead
        & inside(s, mean_x, extent_x, view.width_px)
        & inside(s, mean_y, extent_y, view.height_px);
    let mut bits = s.bits(seen);
    if bits == 0 {
        return count;
    }

    let inverse_c = s.splat(1.0) / c;
    let scale_x = s.sqrt(s.splat(HALF_LOG2_E) * c / determinant);
    let ellipse = Ellipse {
        mean_x,
        mean_y,
        shear: b * inverse_c,
        width: s.min(s.splat(1.0) / scale_x, s.splat(1e15)),
        scale_y: s.sqrt(s.splat(HALF_LOG2_E) * inverse_c),
        level,
        tip_y: b * extent_x / a,
        extent_y,
    };
    // Blocks of the first and the last pixel centre in the box around the ellipse.
    let height = cover::block_height(S::LANES) as f32;
    let left = first_block(s, mean_x - extent_x, BLOCK_WIDTH as f32, view.width_px);
    let right = last_block(s, mean_x + extent_x, BLOCK_WIDTH as f32, view.width_px);
    let top = first_block(s, mean_y - extent_y, height, view.height_px);
    let bottom = last_block(s, mean_y + extent_y, height, view.height_px);
    let bands = cover::bands(S::LANES);
    let fits = s.lt(right - left, s.splat(COLUMNS as f32 - 0.5))
        & s.lt(bottom - top, s.splat(bands as f32 - 0.5));
    let mut blocks = [s.splat(0.0); 2];
    if s.any(seen & fits) {
        let corner = [left * s.splat(BLOCK_WIDTH as f32), top * s.splat(height)];
        let size = [view.width_px, view.height_px];
        let [low, high] = cover::window(s, &ellipse, corner, size);
        blocks = [s.keep(fits, low), s.keep(fits, high)];
        // Drops splats that lie between pixel centres.
        bits &= !s.bits(fits) | s.bits(s.lt(s.splat(0.5), low + high));
        if bits == 0 {
            return count;
        }
    }

    let distance = s.sqrt(dot(s, d, d));
    let inverse_length = s.splat(1.0) / distance;
    let direction = [d[0] * inverse_length, d[1] * inverse_length, d[2] * inverse_length];
    let mut rgb = colour(s, &sh[first..], direction);
    if let Some(atmosphere) = &view.atmosphere {
        rgb = attenuate(s, atmosphere, rgb, distance);
    }
    let fields = [
        mean_x,
        mean_y,
        ellipse.shear,
        scale_x,
        ellipse.scale_y,
        level,
        ellipse.tip_y,
        extent_y,
        ellipse.width,
        z,
        rgb[0],
        rgb[1],
        rgb[2],
        left,
        right,
        top,
        bottom,
        blocks[0],
        blocks[1],
    ];
    let mut lanes = [[0f32; GROUP]; 19];
    for (lanes, field) in lanes.iter_mut().zip(fields) {
        s.store(field, lanes);
    }
    while bits != 0 {
        let lane = bits.trailing_zeros() as usize % GROUP;
        bits &= bits - 1;
        let (left, top) = (lanes[13][lane] as u16, lanes[15][lane] as u16);
        out.splats[count] = Splat2d {
            mean_x: lanes[0][lane],
            mean_y: lanes[1][lane],
            shear: lanes[2][lane],
            scale_x: lanes[3][lane],
            scale_y: lanes[4][lane],
            level: lanes[5][lane],
            tip_y: lanes[6][lane],
            extent_y: lanes[7][lane],
            width: lanes[8][lane],
            z_m: lanes[9][lane],
            rgb: [lanes[10][lane], lanes[11][lane], lanes[12][lane]],
            tiles: TileBox {
                left: left / COLUMNS as u16,
                right: lanes[14][lane] as u16 / COLUMNS as u16,
                top: top / bands as u16,
                bottom: lanes[16][lane] as u16 / bands as u16,
            },
        };
        out.covers[count] =
            Cover { left, top, blocks: lanes[17][lane] as u32 | (lanes[18][lane] as u32) << 16 };
        out.keys[count] = lanes[9][lane].to_bits();
        count += 1;
    }
    count
}

// The functions below cannot be closures: closures are not always inlined, and then run without the kernel's
// instructions.

/// Columns of some lanes of a group.
#[derive(Clone, Copy)]
struct Columns<'a, S> {
    s: S,
    geometry: &'a [f32],
    first: usize,
}

impl<S: Simd> Columns<'_, S> {
    #[inline(always)]
    fn load(&self, column: usize) -> S::F {
        self.s.load(&self.geometry[column * GROUP + self.first..])
    }

    /// Loads three consecutive columns.
    #[inline(always)]
    fn vector(&self, column: usize) -> [S::F; 3] {
        [self.load(column), self.load(column + 1), self.load(column + 2)]
    }
}

#[inline(always)]
fn broadcast<S: Simd>(s: S, v: Vec3) -> [S::F; 3] {
    [s.splat(v.x), s.splat(v.y), s.splat(v.z)]
}

#[inline(always)]
fn dot<S: Simd>(s: S, a: [S::F; 3], b: [S::F; 3]) -> S::F {
    s.mul_add(a[0], b[0], s.mul_add(a[1], b[1], a[2] * b[2]))
}

#[inline(always)]
fn clamp<S: Simd>(s: S, v: S::F, [low, high]: [f32; 2]) -> S::F {
    s.max(s.min(v, s.splat(high)), s.splat(low))
}

/// Returns a row of the projection's Jacobian in world axes: `scale (row - slope forward)`.
#[inline(always)]
fn gradient<S: Simd>(
    s: S,
    scale: S::F,
    slope: S::F,
    row: [S::F; 3],
    forward: [S::F; 3],
) -> [S::F; 3] {
    [
        scale * s.neg_mul_add(slope, forward[0], row[0]),
        scale * s.neg_mul_add(slope, forward[1], row[1]),
        scale * s.neg_mul_add(slope, forward[2], row[2]),
    ]
}

/// Returns `p a + q b`.
#[inline(always)]
fn mix<S: Simd>(s: S, p: S::F, a: [S::F; 3], q: S::F, b: [S::F; 3]) -> [S::F; 3] {
    [s.mul_add(p, a[0], q * b[0]), s.mul_add(p, a[1], q * b[1]), s.mul_add(p, a[2], q * b[2])]
}

/// Returns whether a pixel centre lies between `mean - extent` and `mean + extent`; false for NaN and overflow.
#[inline(always)]
fn inside<S: Simd>(s: S, mean: S::F, extent: S::F, size: u32) -> S::M {
    s.lt(s.splat(0.5), mean + extent)
        & s.lt(mean - extent, s.splat(size as f32 - 0.5))
        & s.lt(extent, s.splat(MAX_EXTENT_PX))
}

/// Returns the row or column of blocks of the first pixel centre at or after `low`. `ceil` is written as the floor
/// after adding slightly less than 1.
#[inline(always)]
fn first_block<S: Simd>(s: S, low: S::F, block: f32, size: u32) -> S::F {
    let pixel = s.max(low + s.splat(0.999_99 - 0.5), s.splat(0.0));
    let pixel = s.min(pixel, s.splat(size as f32 - 1.0));
    s.floor(pixel * s.splat(1.0 / block))
}

/// Returns the row or column of blocks of the last pixel centre at or before `high`.
#[inline(always)]
fn last_block<S: Simd>(s: S, high: S::F, block: f32, size: u32) -> S::F {
    let pixel = s.min(high - s.splat(0.5), s.splat(size as f32 - 1.0));
    s.floor(pixel * s.splat(1.0 / block))
}

/// Returns the colour of a vector of splats along unit viewing directions; the vector form of
/// [`crate::harmonics::colour`].
#[inline(always)]
fn colour<S: Simd>(s: S, sh: &[u16], [x, y, z]: [S::F; 3]) -> [S::F; 3] {
    // The slice starts at a lane, so its last coefficient may be cut: the count is rounded up.
    let coefficients = sh.len().div_ceil(3 * GROUP);
    let half = s.splat(0.5);
    let mut rgb = [half; 3];
    add(s, &mut rgb, sh, 0, s.splat(C0 as f32));
    if coefficients >= 4 {
        add(s, &mut rgb, sh, 1, y * s.splat(-C1 as f32));
        add(s, &mut rgb, sh, 2, z * s.splat(C1 as f32));
        add(s, &mut rgb, sh, 3, x * s.splat(-C1 as f32));
    }
    if coefficients >= 9 {
        let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
        let (two, three, four) = (s.splat(2.0), s.splat(3.0), s.splat(4.0));
        add(s, &mut rgb, sh, 4, xy * s.splat(C2[0] as f32));
        add(s, &mut rgb, sh, 5, yz * s.splat(C2[1] as f32));
        add(s, &mut rgb, sh, 6, (two * zz - xx - yy) * s.splat(C2[2] as f32));
        add(s, &mut rgb, sh, 7, xz * s.splat(C2[3] as f32));
        add(s, &mut rgb, sh, 8, (xx - yy) * s.splat(C2[4] as f32));
        if coefficients >= 16 {
            add(s, &mut rgb, sh, 9, y * (three * xx - yy) * s.splat(C3[0] as f32));
            add(s, &mut rgb, sh, 10, xy * z * s.splat(C3[1] as f32));
            add(s, &mut rgb, sh, 11, y * (four * zz - xx - yy) * s.splat(C3[2] as f32));
            let upright = two * zz - three * xx - three * yy;
            add(s, &mut rgb, sh, 12, z * upright * s.splat(C3[3] as f32));
            add(s, &mut rgb, sh, 13, x * (four * zz - xx - yy) * s.splat(C3[4] as f32));
            add(s, &mut rgb, sh, 14, z * (xx - yy) * s.splat(C3[5] as f32));
            add(s, &mut rgb, sh, 15, x * (xx - three * yy) * s.splat(C3[6] as f32));
        }
    }
    let zero = s.splat(0.0);
    [s.max(rgb[0], zero), s.max(rgb[1], zero), s.max(rgb[2], zero)]
}

/// Returns colours after light and fog at a distance [m]; the vector form of [`Atmosphere::attenuate`].
#[inline(always)]
fn attenuate<S: Simd>(s: S, atmosphere: &Atmosphere, rgb: [S::F; 3], distance: S::F) -> [S::F; 3] {
    // Clamped to the range of `exp2`; the remaining light is then 1e-12.
    let lost = distance * s.splat(-atmosphere.fog_per_m * std::f32::consts::LOG2_E);
    let left = s.exp2(s.max(lost, s.splat(-40.0)));
    let mut seen = rgb;
    for channel in 0..3 {
        let fog = s.splat(atmosphere.fog[channel]);
        let lit = rgb[channel] * s.splat(atmosphere.light[channel]);
        seen[channel] = s.mul_add(lit - fog, left, fog);
    }
    seen
}

/// Adds coefficient `k` times its basis function.
#[inline(always)]
fn add<S: Simd>(s: S, rgb: &mut [S::F; 3], sh: &[u16], k: usize, basis: S::F) {
    for channel in 0..3 {
        let weight = s.load_f16(&sh[(k * 3 + channel) * GROUP..]);
        rgb[channel] = s.mul_add(weight, basis, rgb[channel]);
    }
}
