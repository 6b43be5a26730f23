//! Rays through a tree of splats: boxes eight at a time for a bundle of rays, then splats eight at a time for each, nearest first.
//!
//! Budget: some 1.2 us a ray and thread in a forest of 125 k splats, for the boxes and splats that it touches: some 30 and 17 leaves.
//!
//! The opacity of a splat along a ray is that of the renderers with an ideal pixel: the projection of the Gaussian onto the plane
//! across the ray, which is its greatest value along the ray. A beam is no line: its footprint, a Gaussian that grows with
//! range, widens the splat by convolution and dims it by what that adds to its area, as anti-aliased splats are by a pixel (Yu et
//! al. 2024, "Mip-Splatting", equation 10). Widening all three axes by the footprint widens the projection by exactly it.
//!
//! Its depth is where that greatest value lies (for a disc: where the ray meets its plane), not its centre's as in images: a range
//! must not depend on how large the splats of a surface are.

use glam::Vec3;

use super::cast::{Hit, Hits, Tag};
use super::tree::{LEAF, LEAST_ALPHA, Leaf, NONE, Node, Tree, WIDTH};
use crate::cpu::simd::{Kernel, Simd};
use crate::limits::ALPHA_MAX;

/// A beam in the axes of a part.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Ray {
    pub(super) origin_m: Vec3,
    /// Unit.
    pub(super) direction: Vec3,
    /// Standard deviation of its footprint per metre of range. [rad]
    pub(super) spread: f32,
}

/// Follows rays that are close to one another through a tree: boxes once for all of them, splats for each.
pub(super) struct Follow<'a> {
    pub(super) tree: &'a Tree,
    pub(super) rays: &'a [Ray],
    pub(super) tag: Tag,
    /// What each meets, as many as there are rays.
    pub(super) hits: &'a mut [Hits],
}

const _: () = assert!(LEAST_ALPHA == 0.05, "LEAST_LEVEL and REACH follow from it");

/// Nodes that wait: at most seven of each level. Deeper trees, of splats that halve in size again and again, lose some.
const MAX_STACK: usize = 128;
/// log2 of [`LEAST_ALPHA`].
const LEAST_LEVEL: f32 = -4.321_928;
/// Standard deviations at which the most opaque splat falls below it: sqrt(2 ln 20).
const REACH: f32 = 2.45;

// Closures are no substitute for the functions below, nor are maps of arrays: they are not always inlined, and then run without the
// kernel's instructions.

/// A cone around some rays, in every lane.
#[derive(Clone, Copy)]
struct Bundle<S: Simd> {
    origin: [S::F; 3],
    direction: [S::F; 3],
    inverse: [S::F; 3],
    steep: [S::F; 3],
    /// How far from its axis its rays and their footprints are, per metre. [m/m]
    slope: S::F,
    /// How far from its origin theirs are. [m]
    apart: S::F,
}

impl<S: Simd> Bundle<S> {
    #[inline(always)]
    fn around(s: S, rays: &[Ray]) -> Self {
        let (mut origin, mut direction) = (Vec3::ZERO, Vec3::ZERO);
        for ray in rays {
            origin += ray.origin_m;
            direction += ray.direction;
        }
        origin /= rays.len() as f32;
        // Rays that cancel are no bundle, and their slopes below say so.
        direction = direction.normalize_or(Vec3::X);
        let (mut slope, mut apart) = (0.0_f32, 0.0_f32);
        for ray in rays {
            let turned = (ray.direction - direction).length();
            slope = slope.max(1.1 * turned + REACH * ray.spread);
            apart = apart.max((ray.origin_m - origin).length());
        }
        let inverse = [inverse(direction.x), inverse(direction.y), inverse(direction.z)];
        let steep = [inverse[0].abs(), inverse[1].abs(), inverse[2].abs()];
        Self {
            origin: broadcast(s, origin.to_array()),
            direction: broadcast(s, direction.to_array()),
            inverse: broadcast(s, inverse),
            steep: broadcast(s, steep),
            slope: s.splat(slope),
            apart: s.splat(apart),
        }
    }
}

/// Rays, one a lane.
#[derive(Clone, Copy)]
struct Lanes<S: Simd> {
    origin: [S::F; 3],
    inverse: [S::F; 3],
    steep: [S::F; 3],
    /// Radius of the widest footprint that counts, per metre. [m/m]
    footprint: f32,
}

impl<S: Simd> Lanes<S> {
    #[inline(always)]
    fn new(s: S, rays: &[Ray]) -> Self {
        let mut origin = [[0.0; WIDTH]; 3];
        let mut inverses = [[1.0; WIDTH]; 3];
        let mut steeps = [[1.0; WIDTH]; 3];
        let mut footprint = 0.0_f32;
        for (lane, ray) in rays.iter().enumerate() {
            for axis in 0..3 {
                origin[axis][lane] = ray.origin_m[axis];
                inverses[axis][lane] = inverse(ray.direction[axis]);
                steeps[axis][lane] = inverses[axis][lane].abs();
            }
            footprint = footprint.max(REACH * ray.spread);
        }
        Self {
            origin: load(s, &origin),
            inverse: load(s, &inverses),
            steep: load(s, &steeps),
            footprint,
        }
    }
}

/// Returns 1 over `v`; no infinity, so that no product is NaN.
#[inline(always)]
fn inverse(v: f32) -> f32 {
    if v.abs() < 1e-12 { 1e12_f32.copysign(v) } else { 1.0 / v }
}

#[inline(always)]
fn broadcast<S: Simd>(s: S, v: [f32; 3]) -> [S::F; 3] {
    [s.splat(v[0]), s.splat(v[1]), s.splat(v[2])]
}

#[inline(always)]
fn load<S: Simd>(s: S, v: &[[f32; WIDTH]; 3]) -> [S::F; 3] {
    [s.load(&v[0]), s.load(&v[1]), s.load(&v[2])]
}

#[inline(always)]
fn dot<S: Simd>(s: S, a: [S::F; 3], b: [S::F; 3]) -> S::F {
    s.mul_add(a[0], b[0], s.mul_add(a[1], b[1], a[2] * b[2]))
}

/// Returns the squared area of the projection of a Gaussian of these variances along a direction in its own axes: the
/// determinant of the covariance times the curvature along the ray, as sums of products.
#[inline(always)]
fn area<S: Simd>(s: S, square: [S::F; 3], v: [S::F; 3]) -> S::F {
    dot(s, square, [v[1] * v[2], v[0] * v[2], v[0] * v[1]])
}

/// Returns the columns of the matrix of a unit quaternion.
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
        let (bundle, lanes) = (Bundle::around(s, rays), Lanes::new(s, rays));
        let mut reach_m = farthest(hits);
        let mut stack = [(0.0_f32, 0_u32); MAX_STACK];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let (near_m, child) = stack[waiting];
            if near_m > reach_m {
                continue;
            }
            if child & LEAF != 0 {
                let leaf = &tree.leaves[(child & !LEAF) as usize];
                let mut any = false;
                let mut through = touched(s, leaf, &lanes, near_m, hits);
                while through != 0 {
                    let i = through.trailing_zeros() as usize % WIDTH;
                    through &= through - 1;
                    if meet(s, leaf, &rays[i], tag, &mut hits[i]) {
                        hits[i].shorten();
                        any = true;
                    }
                }
                if any {
                    reach_m = farthest(hits);
                }
                continue;
            }
            let node = &tree.nodes[child as usize];
            let (mut met, nears) = touch(s, node, &bundle, reach_m);
            // The nearest on top: by insertion, of mostly two or three.
            let first = waiting;
            while met != 0 {
                let lane = met.trailing_zeros() as usize % WIDTH;
                met &= met - 1;
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
            }
        }
    }
}

/// Returns how far the farthest of some rays still looks. [m]
#[inline(always)]
fn farthest(hits: &[Hits]) -> f32 {
    let mut reach_m = 0.0_f32;
    for hits in hits {
        reach_m = reach_m.max(hits.reach_m);
    }
    reach_m
}

/// Returns which boxes of a node a bundle meets within `reach_m`, as bits, and where.
#[inline(always)]
fn touch<S: Simd>(s: S, node: &Node, ray: &Bundle<S>, reach_m: f32) -> (u32, [f32; WIDTH]) {
    let zero = s.splat(0.0);
    let (center, half) = (load(s, &node.center_m), load(s, &node.half_m));
    let rel = [center[0] - ray.origin[0], center[1] - ray.origin[1], center[2] - ray.origin[2]];
    let along = dot(s, rel, ray.direction);
    // The cone's radius at the box's far side at most.
    let far_side = s.max(along, zero) + half[0] + half[1] + half[2];
    let margin = s.mul_add(far_side, ray.slope, ray.apart);
    let (mut near, mut far) = (zero, s.splat(reach_m));
    for axis in 0..3 {
        let middle = rel[axis] * ray.inverse[axis];
        let side = (half[axis] + margin) * ray.steep[axis];
        near = s.max(middle - side, near);
        far = s.min(middle + side, far);
    }
    let mut nears = [0.0; WIDTH];
    s.store(near, &mut nears);
    (!s.bits(s.lt(far, near)) & 0xff, nears)
}

/// Returns which rays meet a leaf's box, which begins at `near_m`, before they end.
#[inline(always)]
fn touched<S: Simd>(s: S, leaf: &Leaf, rays: &Lanes<S>, near_m: f32, hits: &[Hits]) -> u32 {
    let half = leaf.half_m;
    let margin = rays.footprint * (near_m + 4.0 * (half[0] + half[1] + half[2]));
    let mut reach = [-1.0; WIDTH];
    for (reach, hits) in reach.iter_mut().zip(hits) {
        *reach = hits.reach_m;
    }
    let (mut near, mut far) = (s.splat(0.0), s.load(&reach));
    for axis in 0..3 {
        let middle = (s.splat(leaf.center_m[axis]) - rays.origin[axis]) * rays.inverse[axis];
        let side = s.splat(half[axis] + margin) * rays.steep[axis];
        near = s.max(middle - side, near);
        far = s.min(middle + side, far);
    }
    !s.bits(s.lt(far, near)) & ((1 << hits.len()) - 1)
}

/// Adds the splats of a leaf that a ray meets; returns whether there are any.
#[inline(always)]
fn meet<S: Simd>(s: S, leaf: &Leaf, ray: &Ray, tag: Tag, hits: &mut Hits) -> bool {
    let (zero, one) = (s.splat(0.0), s.splat(1.0));
    let mean = load(s, &leaf.mean_m);
    let origin = broadcast(s, ray.origin_m.to_array());
    let direction = broadcast(s, ray.direction.to_array());
    // From the mean to the ray's origin.
    let from = [origin[0] - mean[0], origin[1] - mean[1], origin[2] - mean[2]];
    let along = dot(s, from, direction);
    let width = along * s.splat(ray.spread);
    let blur = width * width;
    let scale =
        [s.load_f16(&leaf.scale_m[0]), s.load_f16(&leaf.scale_m[1]), s.load_f16(&leaf.scale_m[2])];
    let thin = [scale[0] * scale[0], scale[1] * scale[1], scale[2] * scale[2]];
    // Balls around them first: half of the leaves are missed by all. The squares' rounding is allowed for.
    let away = dot(s, from, from);
    let across = s.neg_mul_add(along, along, away);
    let ball = s.mul_add(thin[0] + blur, s.splat(REACH * REACH), away * s.splat(1e-6));
    if !s.any(s.lt(across, ball)) {
        return false;
    }
    let axes = axes(s, &leaf.rotation);
    let d = [dot(s, axes[0], direction), dot(s, axes[1], direction), dot(s, axes[2], direction)];
    let o = [dot(s, axes[0], from), dot(s, axes[1], from), dot(s, axes[2], from)];
    let wide = [thin[0] + blur, thin[1] + blur, thin[2] + blur];
    let weight = [one / wide[0], one / wide[1], one / wide[2]];
    let wd = [weight[0] * d[0], weight[1] * d[1], weight[2] * d[2]];
    // Where the Gaussian is greatest along the ray.
    let range = (zero - dot(s, wd, o)) / dot(s, wd, d);
    let p =
        [s.mul_add(range, d[0], o[0]), s.mul_add(range, d[1], o[1]), s.mul_add(range, d[2], o[2])];
    let squares = dot(s, [weight[0] * p[0], weight[1] * p[1], weight[2] * p[2]], p);
    let half_log2_e = s.splat(std::f32::consts::LOG2_E / 2.0);
    let level = s.neg_mul_add(squares, half_log2_e, s.load_f16(&leaf.level));
    // Before it is dimmed: many small splats under a wide footprint are a wall, too.
    let near =
        s.lt(s.splat(LEAST_LEVEL), level) & s.lt(zero, range) & s.lt(range, s.splat(hits.reach_m));
    if !s.any(near) {
        return false;
    }
    // By what the footprint adds to the area of the projection.
    let square = [d[0] * d[0], d[1] * d[1], d[2] * d[2]];
    let dimmed = s.sqrt(area(s, square, thin) / area(s, square, wide));
    // exp2 promises nothing below -126.
    let alpha = s.exp2(s.max(level, s.splat(-100.0))) * dimmed;
    let alpha = s.min(alpha, s.splat(ALPHA_MAX as f32));
    let mut met = s.bits(near & s.lt(zero, alpha));
    let any = met != 0;
    let (mut ranges, mut alphas, mut normals) = ([0.0; WIDTH], [0.0; WIDTH], [0.0; WIDTH]);
    s.store(range, &mut ranges);
    s.store(alpha, &mut alphas);
    s.store(d[2], &mut normals);
    while met != 0 {
        let lane = met.trailing_zeros() as usize % WIDTH;
        met &= met - 1;
        let flat = f32::from(leaf.flatness[lane]) / 255.0;
        hits.insert(Hit {
            range_m: ranges[lane],
            weight: alphas[lane],
            // A ball's mean over the directions that it faces.
            cosine: (flat * normals[lane].abs() + (1.0 - flat) * (2.0 / 3.0)).min(1.0),
            reflectivity: f32::from(leaf.reflectivity[lane]) / 255.0,
            tag,
        });
    }
    any
}
