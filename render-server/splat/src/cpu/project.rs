//! Pass 2: the splats of visible blocks onto the image plane.
//!
//! Budget: 52 bytes read per splat of a visible block, its harmonics where a lane of its vector
//! survives; 48 bytes written per survivor. Some 4 ns per splat and thread without harmonics.
//!
//! A projected Gaussian is kept in the form that is cheap and stable to evaluate. With covariance
//! `[a b; b c]` and `det = a c - b^2`,
//!   `sigma = c/det (dx - b/c dy)^2 / 2 + dy^2 / c / 2`:
//! two squares, so never negative, where the usual conic cancels. `det` itself comes from the
//! minors of the 2x3 square root (Cauchy-Binet), so it cannot cancel either.

use rayon::prelude::*;

use super::cull::View;
use super::scene::{BLOCK, GROUP, GROUP_NUMBERS, Scene, column};
use super::simd::{Kernel, Simd};
use crate::harmonics::{C0, C1, C2, C3};
use crate::limits::BLUR_PX2;

/// log2(1/255): below this level a splat is not seen.
pub(super) const MIN_LEVEL: f32 = -7.994_353_5;
/// Half of log2(e): sigma's 1/2, for powers of two.
const HALF_LOG2_E: f32 = std::f32::consts::LOG2_E / 2.0;
/// Extent^2 of the ellipse per level and variance: 2 ln 2.
const EXTENT2: f32 = 2.0 * std::f32::consts::LN_2;
/// No splat is wider; guards f32 against overflow. [px]
const MAX_EXTENT_PX: f32 = 1e18;

/// A Gaussian on the image plane: alpha at (x, y) is
/// `2^(level - falloff_x (dx - shear dy)^2 - falloff_y dy^2)`, dx and dy from the mean. [px]
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct Splat2d {
    pub(super) mean_x: f32,
    pub(super) mean_y: f32,
    pub(super) shear: f32,
    pub(super) falloff_x: f32,
    pub(super) falloff_y: f32,
    /// log2 of the opacity.
    pub(super) level: f32,
    /// dy of the rightmost point of the ellipse alpha = 1/255.
    pub(super) tip_y: f32,
    /// Half the height of that ellipse.
    pub(super) extent_y: f32,
    /// Camera z. [m]
    pub(super) z_m: f32,
    pub(super) rgb: [f32; 3],
}

/// What the pass leaves behind: per visible block a region of [`BLOCK`] slots, filled from its
/// start.
#[derive(Debug, Default)]
pub(super) struct Projected {
    /// Indexed by slot.
    pub(super) splats: Vec<Splat2d>,
    /// Camera z as bits, which order as the positive numbers do. Indexed by slot.
    pub(super) keys: Vec<u32>,
    /// Filled slots of each region.
    pub(super) counts: Vec<u32>,
}

/// Projects all splats of the visible blocks.
pub(super) fn project<S: Simd>(
    simd: S,
    scene: &Scene,
    view: &View,
    visible: &[u32],
    out: &mut Projected,
) {
    let slots = visible.len() * BLOCK;
    if out.splats.len() < slots {
        out.splats.resize(slots, Splat2d::default());
        out.keys.resize(slots, 0);
    }
    out.counts.resize(visible.len(), 0);
    out.splats
        .par_chunks_mut(BLOCK)
        .zip(out.keys.par_chunks_mut(BLOCK))
        .zip(&mut out.counts)
        .zip(visible)
        // Four blocks are some 5 us of work.
        .with_min_len(4)
        .for_each(|(((splats, keys), count), &block)| {
            let task = ProjectBlock { scene, view, block: block as usize, splats, keys };
            *count = simd.run(task) as u32;
        });
}

/// One block; returns how many splats survived.
struct ProjectBlock<'a> {
    scene: &'a Scene,
    view: &'a View,
    block: usize,
    splats: &'a mut [Splat2d],
    keys: &'a mut [u32],
}

impl Kernel for ProjectBlock<'_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> usize {
        let groups = BLOCK / GROUP;
        let sh_numbers = self.scene.coefficients * 3 * GROUP;
        let geometry = &self.scene.geometry[self.block * groups * GROUP_NUMBERS..];
        let sh = &self.scene.sh[self.block * groups * sh_numbers..];
        let mut count = 0;
        for group in 0..groups {
            let geometry = &geometry[group * GROUP_NUMBERS..][..GROUP_NUMBERS];
            let sh = &sh[group * sh_numbers..][..sh_numbers];
            for first in (0..GROUP).step_by(S::LANES) {
                count = vector(s, self.view, geometry, sh, first, self.splats, self.keys, count);
            }
        }
        count
    }
}

/// Projects the lanes from `first` of a group, appends survivors from slot `count` on, and returns
/// the new count.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one loop body, split for reading only")]
fn vector<S: Simd>(
    s: S,
    view: &View,
    geometry: &[f32],
    sh: &[u16],
    first: usize,
    splats: &mut [Splat2d],
    keys: &mut [u32],
    mut count: usize,
) -> usize {
    let f = |v: f32| s.splat(v);
    let load = |column: usize| s.load(&geometry[column * GROUP + first..]);
    // Relative to the camera before anything else: large coordinates cancel while still exact.
    let d: [S::F; 3] = std::array::from_fn(|k| load(column::MEAN + k) - f(view.center_m[k]));
    let rotate = |row: usize| {
        let r = view.rows[row];
        s.mul_add(d[0], f(r.x), s.mul_add(d[1], f(r.y), d[2] * f(r.z)))
    };
    let z = rotate(2);
    // NaN, of padding too, fails here.
    let ahead = s.lt(f(view.near_m), z);
    if !s.any(ahead) {
        return count;
    }
    let inverse_z = f(1.0) / z;
    let (tx, ty) = (rotate(0) * inverse_z, rotate(1) * inverse_z);
    let mean_x = s.mul_add(tx, f(view.fx_px), f(view.cx_px));
    let mean_y = s.mul_add(ty, f(view.fy_px), f(view.cy_px));

    // Rows of J W M, M the square root of the covariance.
    let jx = s.max(s.min(tx, f(view.slope_x[1])), f(view.slope_x[0]));
    let jy = s.max(s.min(ty, f(view.slope_y[1])), f(view.slope_y[0]));
    let (ax, ay) = (inverse_z * f(view.fx_px), inverse_z * f(view.fy_px));
    let gradient = |a: S::F, j: S::F, row: usize| -> [S::F; 3] {
        std::array::from_fn(|k| a * s.neg_mul_add(j, f(view.rows[2][k]), f(view.rows[row][k])))
    };
    let (gx, gy) = (gradient(ax, jx, 0), gradient(ay, jy, 1));
    let times_axes = |g: [S::F; 3]| -> [S::F; 3] {
        std::array::from_fn(|k| {
            let axis = |row: usize| load(column::AXES + 3 * k + row);
            s.mul_add(g[0], axis(0), s.mul_add(g[1], axis(1), g[2] * axis(2)))
        })
    };
    let (u, v) = (times_axes(gx), times_axes(gy));
    let dot =
        |p: &[S::F; 3], q: &[S::F; 3]| s.mul_add(p[0], q[0], s.mul_add(p[1], q[1], p[2] * q[2]));
    let blur = f(BLUR_PX2 as f32);
    let (uu, b, vv) = (dot(&u, &u), dot(&u, &v), dot(&v, &v));
    let (a, c) = (uu + blur, vv + blur);
    let minor = |i: usize, j: usize| s.neg_mul_add(u[j], v[i], u[i] * v[j]);
    let minors = [minor(0, 1), minor(1, 2), minor(2, 0)];
    let blur2 = f((BLUR_PX2 * BLUR_PX2) as f32);
    let determinant = s.mul_add(blur, uu + vv, dot(&minors, &minors) + blur2);

    let level = load(column::LEVEL);
    let reach2 = (level - f(MIN_LEVEL)) * f(EXTENT2);
    let extent_x = s.sqrt(reach2 * a);
    let extent_y = s.sqrt(reach2 * c);
    // Some pixel centre lies within the bounding box's rows and columns of the image. NaN and
    // overflow fail.
    let inside = |mean: S::F, extent: S::F, size: u32| {
        s.lt(f(0.5), mean + extent)
            & s.lt(mean - extent, f(size as f32 - 0.5))
            & s.lt(extent, f(MAX_EXTENT_PX))
    };
    let seen =
        ahead & inside(mean_x, extent_x, view.width_px) & inside(mean_y, extent_y, view.height_px);
    let mut bits = s.bits(seen);
    if bits == 0 {
        return count;
    }

    let inverse_c = f(1.0) / c;
    let inverse_length = f(1.0) / s.sqrt(dot(&d, &d));
    let direction = d.map(|v| v * inverse_length);
    let rgb = colour(s, &sh[first..], direction);
    let fields = [
        mean_x,
        mean_y,
        b * inverse_c,
        f(HALF_LOG2_E) * c / determinant,
        f(HALF_LOG2_E) * inverse_c,
        level,
        b * extent_x / a,
        extent_y,
        z,
        rgb[0],
        rgb[1],
        rgb[2],
    ];
    let mut lanes = [[0f32; GROUP]; 12];
    for (lanes, field) in lanes.iter_mut().zip(fields) {
        s.store(field, lanes);
    }
    while bits != 0 {
        let lane = bits.trailing_zeros() as usize % GROUP;
        bits &= bits - 1;
        let field = |k: usize| lanes[k][lane];
        splats[count] = Splat2d {
            mean_x: field(0),
            mean_y: field(1),
            shear: field(2),
            falloff_x: field(3),
            falloff_y: field(4),
            level: field(5),
            tip_y: field(6),
            extent_y: field(7),
            z_m: field(8),
            rgb: [field(9), field(10), field(11)],
        };
        keys[count] = field(8).to_bits();
        count += 1;
    }
    count
}

/// Returns the colour of a vector of splats seen along unit directions; the vector form of
/// [`crate::harmonics::colour`].
#[inline(always)]
fn colour<S: Simd>(s: S, sh: &[u16], [x, y, z]: [S::F; 3]) -> [S::F; 3] {
    let f = |v: f64| s.splat(v as f32);
    let weight = |k: usize, channel: usize| s.load_f16(&sh[(k * 3 + channel) * GROUP..]);
    let degree = sh.len() / (3 * GROUP);
    let mut rgb: [S::F; 3] =
        std::array::from_fn(|channel| s.mul_add(weight(0, channel), f(C0), f(0.5)));
    let mut add = |k: usize, basis: S::F| {
        for (channel, sum) in rgb.iter_mut().enumerate() {
            *sum = s.mul_add(weight(k, channel), basis, *sum);
        }
    };
    // The slice starts at a lane, so whole coefficients are counted rounding up.
    if degree >= 3 {
        add(1, y * f(-C1));
        add(2, z * f(C1));
        add(3, x * f(-C1));
    }
    if degree >= 8 {
        let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
        let two = f(2.0);
        add(4, xy * f(C2[0]));
        add(5, yz * f(C2[1]));
        add(6, (two * zz - xx - yy) * f(C2[2]));
        add(7, xz * f(C2[3]));
        add(8, (xx - yy) * f(C2[4]));
        if degree >= 15 {
            let (three, four) = (f(3.0), f(4.0));
            add(9, y * (three * xx - yy) * f(C3[0]));
            add(10, xy * z * f(C3[1]));
            add(11, y * (four * zz - xx - yy) * f(C3[2]));
            add(12, z * (two * zz - three * xx - three * yy) * f(C3[3]));
            add(13, x * (four * zz - xx - yy) * f(C3[4]));
            add(14, z * (xx - yy) * f(C3[5]));
            add(15, x * (xx - three * yy) * f(C3[6]));
        }
    }
    rgb.map(|v| s.max(v, s.splat(0.0)))
}
