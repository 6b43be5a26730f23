//! Ray casting through a tree of splats, nearest first: eight boxes or splats at a time against a
//! fan of rays, then each remaining splat against eight rays at a time.
//!
//! Budget: 0.7 us per ray and thread in a forest of 128 k splats (docs/BENCHMARKS.md, "LiDAR").
//! There, a fan of eight rays touches tens of nodes and leaves, and evaluates tens of splats.
//!
//! The opacity of a splat along a ray is that of the renderers with an ideal pixel: the projection
//! of the Gaussian onto the plane across the ray, which is its maximum along the ray. A beam has a
//! width: its footprint, a Gaussian that grows with range, widens the splat by convolution and dims
//! it by the increase of its area, as pixels do to anti-aliased splats (Yu et al. 2024,
//! "Mip-Splatting", equation 10). Widening all three axes by the footprint widens the projection by
//! exactly the footprint.
//!
//! The depth of a splat is the position of that maximum (for a disc: the intersection of the ray
//! with its plane), not the depth of its centre as in images, because a range must not depend on
//! the size of a surface's splats.

use std::ops::Sub;

use glam::Vec3;

use super::cast::{Hit, Hits, Tag};
use super::tree::{LEAF, LEAST_ALPHA, Leaf, NONE, Node, Tree, WIDTH};
use crate::cpu::simd::{Kernel, Simd};
use crate::limits::ALPHA_MAX;

/// Beam in the axes of a part.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Ray {
    pub(super) origin_m: Vec3,
    /// Unit vector.
    pub(super) direction: Vec3,
    /// Standard deviation of its footprint per metre of range. [rad]
    pub(super) spread: f32,
}

/// Casts rays that are close to one another through a tree: boxes once for all rays, splats for
/// each ray.
pub(super) struct Follow<'a> {
    pub(super) tree: &'a Tree,
    pub(super) rays: &'a [Ray],
    pub(super) tag: Tag,
    /// Hits of each ray; the length equals that of `rays`.
    pub(super) hits: &'a mut [Hits],
}

const _: () = assert!(LEAST_ALPHA == 0.05, "LEAST_LEVEL and REACH follow from it");

/// Maximum nodes on the stack: at most seven of each level. In deeper trees (splats that halve in
/// size repeatedly), the excess nodes are dropped.
const MAX_STACK: usize = 128;
/// Maximum rounding error of a slope in f32. [m/m]
const ROUNDING: f32 = 2e-6;
/// log2 of [`LEAST_ALPHA`].
const LEAST_LEVEL: f32 = -4.321_928;
/// Standard deviations at which the most opaque splat falls below [`LEAST_ALPHA`]: sqrt(2 ln 20).
const REACH: f32 = 2.45;

// The functions below must not be replaced by closures or by `map` of arrays: these are not always
// inlined, and then run without the kernel's instructions.

/// Bounds of a group of rays as a fan, in every lane: maximum deviation from its axis, along each
/// axis of the part and of the fan.
#[derive(Clone, Copy)]
struct Fan<S: Simd> {
    origin: [S::F; 3],
    /// Orthonormal axes of the fan: its central direction, the side along which its rays spread,
    /// and the direction across.
    frame: [[S::F; 3]; 3],
    inverse: [S::F; 3],
    steep: [S::F; 3],
    /// Maximum deviation of rays and their footprints from the axis, along x, y and z of the part,
    /// per metre. [m/m]
    slope: [S::F; 3],
    /// Absolute components of the central direction and of the side along x, y and z.
    lean: [[S::F; 3]; 2],
    /// Maximum deviation of rays from the axis in the direction across, per metre. [m/m]
    across: S::F,
    /// Minimum position along the side of the rays from this lane on, and maximum position of the
    /// rays up to this lane, per metre. [m/m]
    side_low: [f32; WIDTH],
    side_high: [f32; WIDTH],
    /// Maximum absolute value of these positions. [m/m]
    side: S::F,
    /// Radius of the widest relevant footprint, per metre. [m/m]
    footprint: S::F,
    /// Maximum distance of a ray's origin from the origin of the fan. [m]
    apart: S::F,
    /// Maximum spread of the rays. [rad]
    spread: S::F,
}

impl<S: Simd> Fan<S> {
    #[inline(always)]
    fn around(s: S, rays: &[Ray], lanes: &Lanes<S>) -> Self {
        let (mut origin, mut direction) = (Vec3::ZERO, Vec3::ZERO);
        for ray in rays {
            origin += ray.origin_m;
            direction += ray.direction;
        }
        origin /= rays.len() as f32;
        // Directions that cancel are not a fan; `cast` never passes them.
        direction = unit(s, direction).unwrap_or(Vec3::X);
        let between = rays[rays.len() - 1].direction - rays[0].direction;
        let wide = between - direction * between.dot(direction);
        let side = unit(s, wide).unwrap_or_else(|| direction.any_orthonormal_vector());
        let across = direction.cross(side);
        // Deviation of each ray from the axis, one metre ahead.
        let axis = broadcast(s, direction.to_array());
        let per = s.splat(1.0) / s.max(dot(s, lanes.direction, axis), s.splat(1e-3));
        let mut ahead = lanes.direction;
        for (ahead, axis) in ahead.iter_mut().zip(axis) {
            *ahead = *ahead * per - axis;
        }
        let along_side = dot(s, ahead, broadcast(s, side.to_array()));
        let along_across = dot(s, ahead, broadcast(s, across.to_array()));
        let from_origin = from(lanes.origin, broadcast(s, origin.to_array()));
        let slope = Vec3::new(
            greatest(s, abs(s, ahead[0])),
            greatest(s, abs(s, ahead[1])),
            greatest(s, abs(s, ahead[2])),
        );
        let widest = greatest(s, abs(s, along_side));
        let off = greatest(s, abs(s, along_across));
        let apart = greatest(s, s.sqrt(dot(s, from_origin, from_origin)));
        let spread = greatest(s, lanes.spread);
        let (mut side_low, mut side_high) = ([0.0; WIDTH], [0.0; WIDTH]);
        s.store(along_side - s.splat(ROUNDING), &mut side_low);
        s.store(along_side + s.splat(ROUNDING), &mut side_high);
        for lane in 1..WIDTH {
            side_high[lane] = side_high[lane].max(side_high[lane - 1]);
            side_low[WIDTH - 1 - lane] = side_low[WIDTH - 1 - lane].min(side_low[WIDTH - lane]);
        }
        let slope = (slope + REACH * spread).to_array();
        let inverse = [inverse(direction.x), inverse(direction.y), inverse(direction.z)];
        let steep = [inverse[0].abs(), inverse[1].abs(), inverse[2].abs()];
        Self {
            origin: broadcast(s, origin.to_array()),
            frame: [
                broadcast(s, direction.to_array()),
                broadcast(s, side.to_array()),
                broadcast(s, across.to_array()),
            ],
            inverse: broadcast(s, inverse),
            steep: broadcast(s, steep),
            slope: broadcast(s, slope),
            lean: [broadcast(s, direction.abs().to_array()), broadcast(s, side.abs().to_array())],
            across: s.splat(off + ROUNDING),
            side_low,
            side_high,
            side: s.splat(widest + ROUNDING),
            footprint: s.splat(REACH * spread),
            // An offset of the origin along the axis also shifts a ray to the side.
            apart: s.splat(1.3 * apart + 1e-5),
            spread: s.splat(spread),
        }
    }
}

/// Rays, one per lane. Unused lanes repeat the last ray.
#[derive(Clone, Copy)]
struct Lanes<S: Simd> {
    origin: [S::F; 3],
    direction: [S::F; 3],
    spread: S::F,
}

impl<S: Simd> Lanes<S> {
    #[inline(always)]
    fn new(s: S, rays: &[Ray]) -> Self {
        let mut origin = [[0.0; WIDTH]; 3];
        let mut direction = [[0.0; WIDTH]; 3];
        let mut spread = [0.0; WIDTH];
        for lane in 0..WIDTH {
            let ray = &rays[lane.min(rays.len() - 1)];
            for axis in 0..3 {
                origin[axis][lane] = ray.origin_m[axis];
                direction[axis][lane] = ray.direction[axis];
            }
            spread[lane] = ray.spread;
        }
        Self { origin: load(s, &origin), direction: load(s, &direction), spread: s.load(&spread) }
    }
}

/// Values of a leaf's splats that all rays need, splat by splat.
struct Unpacked {
    mean_m: [[f32; WIDTH]; 3],
    axes: [[[f32; WIDTH]; 3]; 3],
    /// Variances along the axes of the splat. [m^2]
    thin: [[f32; WIDTH]; 3],
    /// log2 of the opacity.
    level: [f32; WIDTH],
}

/// Intersections of the rays with one splat.
#[derive(Clone, Copy, Default)]
struct Met {
    /// Rays that meet the splat, as bits.
    rays: u32,
    range_m: [f32; WIDTH],
    alpha: [f32; WIDTH],
    /// Cosine between ray and the splat's thinnest axis, of either sign.
    normal: [f32; WIDTH],
}

/// Returns 1 / `v`, limited to a finite value so that products are not NaN.
#[inline(always)]
fn inverse(v: f32) -> f32 {
    if v.abs() < 1e-12 { 1e12_f32.copysign(v) } else { 1.0 / v }
}

/// Returns the direction of a vector, or `None` if it is zero. Uses the square root of the kernel:
/// glam's compiles to an instruction from before AVX (of `libm`), and mixing one with AVX
/// instructions takes some hundred cycles.
#[inline(always)]
fn unit<S: Simd>(s: S, v: Vec3) -> Option<Vec3> {
    let mut length = [0.0; WIDTH];
    s.store(s.sqrt(s.splat(v.length_squared())), &mut length);
    (length[0] > 1e-9).then(|| v / length[0])
}

/// Returns the maximum of all lanes, which must not be negative.
#[inline(always)]
fn greatest<S: Simd>(s: S, v: S::F) -> f32 {
    let mut lanes = [0.0; WIDTH];
    s.store(v, &mut lanes);
    farthest(&lanes)
}

#[inline(always)]
fn broadcast<S: Simd>(s: S, v: [f32; 3]) -> [S::F; 3] {
    [s.splat(v[0]), s.splat(v[1]), s.splat(v[2])]
}

#[inline(always)]
fn load<S: Simd>(s: S, v: &[[f32; WIDTH]; 3]) -> [S::F; 3] {
    [s.load(&v[0]), s.load(&v[1]), s.load(&v[2])]
}

/// Returns the values of one splat, in the lanes of all rays.
#[inline(always)]
fn one_of<S: Simd>(s: S, v: &[[f32; WIDTH]; 3], splat: usize) -> [S::F; 3] {
    [s.splat(v[0][splat]), s.splat(v[1][splat]), s.splat(v[2][splat])]
}

#[inline(always)]
fn abs<S: Simd>(s: S, v: S::F) -> S::F {
    s.max(v, s.splat(0.0) - v)
}

#[inline(always)]
fn from<F: Copy + Sub<Output = F>>(a: [F; 3], b: [F; 3]) -> [F; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot<S: Simd>(s: S, a: [S::F; 3], b: [S::F; 3]) -> S::F {
    s.mul_add(a[0], b[0], s.mul_add(a[1], b[1], a[2] * b[2]))
}

/// Returns the squared area of the projection of a Gaussian with these variances, along a direction
/// in its own axes: the determinant of the covariance times the curvature along the ray, as sums of
/// products.
#[inline(always)]
fn area<S: Simd>(s: S, square: [S::F; 3], v: [S::F; 3]) -> S::F {
    dot(s, square, [v[1] * v[2], v[0] * v[2], v[0] * v[1]])
}

/// Returns the columns of the rotation matrix of a unit quaternion.
#[inline(always)]
fn axes<S: Simd>(s: S, rotation: &[[u16; WIDTH]; 4]) -> [[S::F; 3]; 3] {
    let (x, y) = (s.load_f16(&rotation[0]), s.load_f16(&rotation[1]));
    let (z, w) = (s.load_f16(&rotation[2]), s.load_f16(&rotation[3]));
    let (x2, y2, z2, one) = (x + x, y + y, z + z, s.splat(1.0));
    let (xx, yy, zz) = (x * x2, y * y2, z * z2);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    let (wx, wy, wz) = (w * x2, w * y2, w * z2);
    [
        [one - (yy + zz), xy + wz, xz - wy],
        [xy - wz, one - (xx + zz), yz + wx],
        [xz + wy, yz - wx, one - (xx + yy)],
    ]
}

impl Kernel for Follow<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { tree, rays, tag, hits } = self;
        assert_eq!(S::LANES, WIDTH, "leaves hold the lanes of a vector");
        assert!(
            rays.len() == hits.len() && rays.len() <= WIDTH,
            "hits for each of a vector's rays"
        );
        if tree.nodes.is_empty() || rays.is_empty() {
            return;
        }
        let lanes = Lanes::new(s, rays);
        let fan = Fan::around(s, rays, &lanes);
        // Current reach of each ray; unused lanes meet nothing.
        let mut reach = [-1.0; WIDTH];
        for (reach, hits) in reach.iter_mut().zip(&*hits) {
            *reach = hits.reach_m;
        }
        let mut reach_m = farthest(&reach);
        let mut unpacked = Unpacked {
            mean_m: [[0.0; WIDTH]; 3],
            axes: [[[0.0; WIDTH]; 3]; 3],
            thin: [[0.0; WIDTH]; 3],
            level: [0.0; WIDTH],
        };
        let mut met = [Met::default(); WIDTH];
        let mut stack = [(0.0_f32, 0_u32); MAX_STACK];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let (near_m, child) = stack[waiting];
            // Restrict the fan to the rays between the first and the last that still reach this
            // far.
            let looking = !s.bits(s.lt(s.load(&reach), s.splat(near_m))) & 0xff;
            if looking == 0 {
                continue;
            }
            let first = looking.trailing_zeros() as usize % WIDTH;
            let last = looking.ilog2() as usize % WIDTH;
            let window = [s.splat(fan.side_low[first]), s.splat(fan.side_high[last])];
            if child & LEAF != 0 {
                let leaf = &tree.leaves[(child & !LEAF) as usize];
                let close = unpack(s, leaf, &fan, window, reach_m, &mut unpacked);
                // First evaluate all splats without branches, then insert the results.
                let mut left = close;
                while left != 0 {
                    let splat = left.trailing_zeros() as usize % WIDTH;
                    left &= left - 1;
                    meet(s, &unpacked, splat, &lanes, &reach, &mut met[splat]);
                }
                let (mut left, mut longer) = (close, 0);
                while left != 0 {
                    let splat = left.trailing_zeros() as usize % WIDTH;
                    left &= left - 1;
                    longer |= met[splat].rays;
                    insert(leaf, splat, &met[splat], tag, hits);
                }
                if longer != 0 {
                    while longer != 0 {
                        let i = longer.trailing_zeros() as usize % WIDTH;
                        longer &= longer - 1;
                        hits[i].shorten();
                        reach[i] = hits[i].reach_m;
                    }
                    reach_m = farthest(&reach);
                }
                continue;
            }
            let node = &tree.nodes[child as usize];
            let (mut touched, nears) = touch(s, node, &fan, window, reach_m);
            // Insertion sort with the nearest child on top; typically two or three children.
            let first = waiting;
            while touched != 0 {
                let lane = touched.trailing_zeros() as usize % WIDTH;
                touched &= touched - 1;
                let child = node.children[lane];
                if child == NONE || waiting == MAX_STACK {
                    continue;
                }
                let mut place = waiting;
                while place > first && stack[place - 1].0 < nears[lane] {
                    stack[place] = stack[place - 1];
                    place -= 1;
                }
                stack[place] = (nears[lane], child);
                waiting += 1;
                prefetch(s, tree, child);
            }
        }
    }
}

/// Prefetches the memory of a child. The tree exceeds the first levels of caches.
#[inline(always)]
fn prefetch<S: Simd>(s: S, tree: &Tree, child: u32) {
    if child & LEAF == 0 {
        let node = &tree.nodes[child as usize];
        s.prefetch(&node.center_m[0]);
        s.prefetch(&node.center_m[2]);
        s.prefetch(&node.half_m[1]);
        s.prefetch(&node.children);
    } else {
        let leaf = &tree.leaves[(child & !LEAF) as usize];
        s.prefetch(&leaf.mean_m[0]);
        s.prefetch(&leaf.mean_m[2]);
        s.prefetch(&leaf.rotation[2]);
        s.prefetch(&leaf.level);
    }
}

/// Returns the maximum of non-negative numbers. [m]
#[inline(always)]
fn farthest(reach: &[f32; WIDTH]) -> f32 {
    let mut reach_m = 0.0_f32;
    for &reach in reach {
        reach_m = reach_m.max(reach);
    }
    reach_m
}

/// Returns the boxes of a node that rays of a fan within a window meet within `reach_m`, as bits,
/// and the distance to each box.
#[inline(always)]
fn touch<S: Simd>(
    s: S,
    node: &Node,
    fan: &Fan<S>,
    window: [S::F; 2],
    reach_m: f32,
) -> (u32, [f32; WIDTH]) {
    let zero = s.splat(0.0);
    let (center, half) = (load(s, &node.center_m), load(s, &node.half_m));
    let rel = from(center, fan.origin);
    let (ahead, sideways) = (dot(s, rel, fan.frame[0]), dot(s, rel, fan.frame[1]));
    let [deep, wide] = [dot(s, half, fan.lean[0]), dot(s, half, fan.lean[1])];
    let far_side = s.max(ahead + deep, zero) + fan.apart;
    let (mut near, mut far) = (zero, s.splat(reach_m));
    for axis in 0..3 {
        let middle = rel[axis] * fan.inverse[axis];
        let margin = s.mul_add(far_side, fan.slope[axis], fan.apart);
        let side = (half[axis] + margin) * fan.steep[axis];
        near = s.max(middle - side, near);
        far = s.min(middle + side, far);
    }
    let reach = s.mul_add(far_side, fan.footprint, wide) + fan.apart;
    let beside = beside(s, fan, window, [ahead - deep, far_side], sideways, reach);
    let mut nears = [0.0; WIDTH];
    s.store(near, &mut nears);
    (!s.bits(s.lt(far, near)) & s.bits(beside) & 0xff, nears)
}

/// Returns the lanes whose content overlaps the window along the side of the fan. The content lies
/// between two distances ahead, at `at` along the side, and extends by `reach`.
#[inline(always)]
fn beside<S: Simd>(
    s: S,
    fan: &Fan<S>,
    [low, high]: [S::F; 2],
    [near_side, far_side]: [S::F; 2],
    at: S::F,
    reach: S::F,
) -> S::M {
    let near_side = s.max(near_side - fan.apart, s.splat(0.0));
    let low = s.min(low * near_side, low * far_side);
    let high = s.max(high * near_side, high * far_side);
    s.lt(low, at + reach) & s.lt(at - reach, high)
}

/// Returns the splats of a leaf that rays of a fan within a window can meet within `reach_m`, as
/// bits. If there are any, all splats of the leaf are unpacked.
///
/// A splat is relevant within an ellipsoid. Its extent along a direction is the root of its
/// variance there, and the extent of the fan is that of its outermost ray at the end of the splat.
/// If these do not overlap, no ray meets the splat.
#[inline(always)]
fn unpack<S: Simd>(
    s: S,
    leaf: &Leaf,
    fan: &Fan<S>,
    window: [S::F; 2],
    reach_m: f32,
    out: &mut Unpacked,
) -> u32 {
    let zero = s.splat(0.0);
    let mean = load(s, &leaf.mean_m);
    let rel = from(mean, fan.origin);
    let at = [dot(s, rel, fan.frame[0]), dot(s, rel, fan.frame[1]), dot(s, rel, fan.frame[2])];
    // Maximum width of the footprint.
    let sideways = s.mul_add(abs(s, at[1]), fan.side, abs(s, at[2]) * fan.across);
    let width = (abs(s, at[0]) + sideways + fan.apart) * fan.spread;
    let blur = width * width;
    let level = s.load_f16(&leaf.level);
    // Squared deviations within which the splat exceeds the minimum alpha, plus a small margin.
    let deviations = (level - s.splat(LEAST_LEVEL)) * s.splat(2.004 * std::f32::consts::LN_2);
    let scale =
        [s.load_f16(&leaf.scale_m[0]), s.load_f16(&leaf.scale_m[1]), s.load_f16(&leaf.scale_m[2])];
    let thin = [scale[0] * scale[0], scale[1] * scale[1], scale[2] * scale[2]];
    // Bounding spheres first: they are cheap, and exclude most splats.
    let ball = s.sqrt(s.max(deviations * (thin[0] + blur), zero));
    let counts = s.lt(zero, deviations);
    let balls = overlap(s, fan, window, at, [ball; 3], reach_m);
    if !s.any(counts & balls) {
        return 0;
    }
    let axes = axes(s, &leaf.rotation);
    let mut extent = [ball; 3];
    for (extent, side) in extent.iter_mut().zip(&fan.frame) {
        let v = [dot(s, axes[0], *side), dot(s, axes[1], *side), dot(s, axes[2], *side)];
        let variance = dot(s, thin, [v[0] * v[0], v[1] * v[1], v[2] * v[2]]) + blur;
        *extent = s.sqrt(s.max(deviations * variance, zero));
    }
    let close = s.bits(counts & overlap(s, fan, window, at, extent, reach_m)) & 0xff;
    if close != 0 {
        for axis in 0..3 {
            s.store(mean[axis], &mut out.mean_m[axis]);
            s.store(thin[axis], &mut out.thin[axis]);
            for row in 0..3 {
                s.store(axes[axis][row], &mut out.axes[axis][row]);
            }
        }
        s.store(level, &mut out.level);
    }
    close
}

/// Returns the lanes whose content overlaps the window of the fan, given its centre and extent in
/// the axes of the fan.
#[inline(always)]
fn overlap<S: Simd>(
    s: S,
    fan: &Fan<S>,
    window: [S::F; 2],
    at: [S::F; 3],
    extent: [S::F; 3],
    reach_m: f32,
) -> S::M {
    let near_side = at[0] - extent[0];
    let end = at[0] + extent[0] + fan.apart;
    let far_side = s.max(end, s.splat(0.0));
    let ahead = s.lt(s.splat(0.0), end);
    let before = s.lt(near_side, s.splat(reach_m) + fan.apart);
    let across = s.lt(abs(s, at[2]), s.mul_add(far_side, fan.across, extent[2] + fan.apart));
    let beside = beside(s, fan, window, [near_side, far_side], at[1], extent[1] + fan.apart);
    ahead & before & across & beside
}

/// Computes for each ray the intersection with a splat of a leaf and its alpha, and which rays meet
/// it.
#[inline(always)]
fn meet<S: Simd>(
    s: S,
    unpacked: &Unpacked,
    splat: usize,
    rays: &Lanes<S>,
    reach: &[f32; WIDTH],
    out: &mut Met,
) {
    let (zero, one) = (s.splat(0.0), s.splat(1.0));
    let Unpacked { mean_m, axes, thin, level } = unpacked;
    // Vector from the mean to the origin of each ray.
    let from = from(rays.origin, one_of(s, mean_m, splat));
    let along = dot(s, from, rays.direction);
    let width = along * rays.spread;
    let blur = width * width;
    let (mut d, mut o) = ([zero; 3], [zero; 3]);
    for (axis, of) in axes.iter().enumerate() {
        let of = one_of(s, of, splat);
        d[axis] = dot(s, of, rays.direction);
        o[axis] = dot(s, of, from);
    }
    let thin = one_of(s, thin, splat);
    let wide = [thin[0] + blur, thin[1] + blur, thin[2] + blur];
    // The inverse covariance times its determinant: one division for all three axes.
    let weight = [wide[1] * wide[2], wide[0] * wide[2], wide[0] * wide[1]];
    let wd = [weight[0] * d[0], weight[1] * d[1], weight[2] * d[2]];
    let wide_area = one / dot(s, wd, d);
    // Range of the Gaussian's maximum along the ray.
    let range = (zero - dot(s, wd, o)) * wide_area;
    let p =
        [s.mul_add(range, d[0], o[0]), s.mul_add(range, d[1], o[1]), s.mul_add(range, d[2], o[2])];
    let squares =
        dot(s, [weight[0] * p[0], weight[1] * p[1], weight[2] * p[2]], p) / (wide[0] * weight[0]);
    let half_log2_e = s.splat(std::f32::consts::LOG2_E / 2.0);
    let level = s.neg_mul_add(squares, half_log2_e, s.splat(level[splat]));
    // The level is compared before dimming, because many small splats under a wide footprint are
    // also a wall.
    let near = s.lt(s.splat(LEAST_LEVEL), level) & s.lt(zero, range) & s.lt(range, s.load(reach));
    // Dimmed by the increase of the projected area due to the footprint.
    let square = [d[0] * d[0], d[1] * d[1], d[2] * d[2]];
    let dimmed = s.sqrt(area(s, square, thin) * wide_area);
    // exp2 is undefined below -126.
    let alpha = s.exp2(s.max(level, s.splat(-100.0))) * dimmed;
    let alpha = s.min(alpha, s.splat(ALPHA_MAX as f32));
    out.rays = s.bits(near & s.lt(zero, alpha)) & 0xff;
    s.store(range, &mut out.range_m);
    s.store(alpha, &mut out.alpha);
    s.store(d[2], &mut out.normal);
}

/// Inserts a splat into the hits of the rays that meet it.
#[inline(always)]
fn insert(leaf: &Leaf, splat: usize, met: &Met, tag: Tag, hits: &mut [Hits]) {
    let flat = f32::from(leaf.flatness[splat]) / 255.0;
    let reflectivity = f32::from(leaf.reflectivity[splat]) / 255.0;
    let mut left = met.rays;
    while left != 0 {
        let i = left.trailing_zeros() as usize % WIDTH;
        left &= left - 1;
        hits[i].insert(Hit {
            range_m: met.range_m[i],
            weight: met.alpha[i],
            // For a ball, the mean over all directions of its surface.
            cosine: (flat * met.normal[i].abs() + (1.0 - flat) * (2.0 / 3.0)).min(1.0),
            reflectivity,
            tag,
        });
    }
}
