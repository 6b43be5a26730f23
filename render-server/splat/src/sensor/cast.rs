//! One beam through the splats: what it meets, and the echoes that makes.
//!
//! Budget: some 0.5 us a beam and thread in a forest of 125 k splats, bound by the boxes and splats that it touches.
//!
//! The opacity of a splat along a ray is that of the renderers with an ideal pixel: the projection of the Gaussian onto the plane
//! across the ray, which is its greatest value along the ray. A beam is no line: its footprint, a Gaussian that grows with
//! range, widens the splat by convolution and dims it by what that adds to its area, as anti-aliased splats are by a pixel (Yu et
//! al. 2024, "Mip-Splatting", equation 10). Widening all three axes by the footprint widens the projection by exactly it.
//!
//! Its depth is where that greatest value lies (for a disc: where the ray meets its plane), not its centre's as in images: a range
//! must not depend on how large the splats of a surface are. Splats are taken in the order of these depths.

use glam::{DVec3, Vec3};

use super::Motion;
use super::tree::{LEAF, NONE, Tree, WIDTH};
use crate::cpu::simd::{InstructionSet, Kernel, Simd};
use crate::limits::{ALPHA_MAX, ALPHA_MIN};
use crate::{Scene, Splats};

/// A scene packed for beams; made once, then any sensor measures in it.
#[derive(Debug)]
pub struct SensorScene {
    instructions: InstructionSet,
    /// What stands still, then the objects.
    parts: Vec<Part>,
}

#[derive(Debug)]
struct Part {
    id: u16,
    tree: Tree,
    /// All of it is within this distance of its origin. [m]
    radius_m: f64,
}

impl SensorScene {
    /// Packs a scene. Splats that no image would show are left out, as renderers do.
    pub fn new<'a>(scene: impl Into<Scene<'a>>) -> Self {
        let sets = InstructionSet::available();
        let eight = sets.into_iter().find(|set| set.lanes() == WIDTH);
        Self::with_instructions(scene.into(), eight.expect("the portable set has eight lanes"))
    }

    pub(super) fn with_instructions(scene: Scene<'_>, instructions: InstructionSet) -> Self {
        let mut parts = vec![Part::new(0, scene.splats)];
        parts.extend(scene.objects.iter().map(|object| Part::new(object.id, &object.splats)));
        Self { instructions, parts }
    }

    /// Returns how many objects can move in it.
    pub fn objects(&self) -> usize {
        self.parts.len() - 1
    }

    /// Returns what a beam meets at a share of `motion`, 0 to 1.
    pub(super) fn cast(&self, motion: &Motion<'_>, share: f64, beam: &Beam) -> Hits {
        let mut hits = Hits::new(beam.max_m);
        let mut within = |part: &Part, number: usize, origin: DVec3, direction: DVec3| {
            let ray = Ray {
                origin_m: origin.as_vec3(),
                direction: direction.as_vec3(),
                spread: beam.spread,
            };
            let tag = Tag { id: part.id, part: number as u16 };
            self.instructions.run(Follow { tree: &part.tree, ray, tag, hits: &mut hits });
        };
        within(&self.parts[0], 0, beam.origin_m, beam.direction);
        for (i, (part, placements)) in self.parts[1..].iter().zip(motion.objects).enumerate() {
            let [Some(begin), Some(end)] = placements else { continue };
            // A sphere about its origin first, for most beams miss an object: a line costs less than a slerp.
            let middle_m = begin.translation_m.lerp(end.translation_m, share) - beam.origin_m;
            let along_m = middle_m.dot(beam.direction);
            let across_m2 = middle_m.length_squared() - along_m * along_m;
            let radius_m = part.radius_m + 4.0 * f64::from(beam.spread) * middle_m.length();
            if !(along_m > -radius_m && across_m2 < radius_m * radius_m) {
                continue;
            }
            let between = if begin == end { *begin } else { begin.interpolate(end, share) };
            let object_from_world = between.inverse();
            let origin = object_from_world.transform_point(beam.origin_m);
            within(part, i + 1, origin, object_from_world.rotate(beam.direction));
        }
        hits
    }
}

impl Part {
    fn new(id: u16, splats: &Splats) -> Self {
        let tree = Tree::new(splats);
        let mut radius_m = 0.0_f64;
        if let Some(node) = tree.nodes.first() {
            for lane in (0..WIDTH).filter(|&lane| node.children[lane] != NONE) {
                let vector = |v: &[[f32; WIDTH]; 3]| DVec3::from(v.map(|v| f64::from(v[lane])));
                let corner_m = vector(&node.center_m).abs() + vector(&node.half_m);
                radius_m = radius_m.max(corner_m.length());
            }
        }
        Self { id, tree, radius_m }
    }
}

/// One beam in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Beam {
    /// Where it begins. [m, world]
    pub(super) origin_m: DVec3,
    /// Unit. [world]
    pub(super) direction: DVec3,
    /// Standard deviation of its footprint per metre of range. [rad]
    pub(super) spread: f32,
    /// Nothing is looked for beyond. [m]
    pub(super) max_m: f32,
}

/// Returns the standard deviation per metre of a beam whose full angle is stated where its intensity is 1/e^2 of its
/// middle's, as for lasers: four deviations.
pub(super) fn spread_of(divergence_rad: f32) -> f32 {
    divergence_rad / 4.0
}

/// A splat that a beam meets.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Hit {
    /// Along the beam. [m]
    pub(super) range_m: f32,
    /// Share of the beam's light that ends there, once weighed; before that of what reaches it.
    pub(super) weight: f32,
    /// Cosine of the angle of incidence.
    pub(super) cosine: f32,
    pub(super) reflectivity: f32,
    pub(super) tag: Tag,
}

/// Of what a splat is part.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Tag {
    /// The object's id; 0 is what stands still.
    pub(super) id: u16,
    /// Its number in the scene, from 1; 0 is what stands still.
    pub(super) part: u16,
}

/// What a beam meets, nearest first.
#[derive(Debug)]
pub(super) struct Hits {
    hits: [Hit; MAX_HITS],
    len: usize,
    /// Nothing behind it is seen. [m]
    reach_m: f32,
}

/// Splats that one beam can meet before it ends. Some ten lie over one another on a painted surface; of more, the farthest are
/// dropped.
const MAX_HITS: usize = 48;
/// A beam ends where less of it is left.
const END: f32 = 0.01;

impl Hits {
    fn new(max_m: f32) -> Self {
        Self { hits: [Hit::default(); MAX_HITS], len: 0, reach_m: max_m }
    }

    /// Adds a splat at its place; `weight` is its alpha.
    #[inline(always)]
    fn insert(&mut self, hit: Hit) {
        if self.len == MAX_HITS {
            if self.hits[MAX_HITS - 1].range_m <= hit.range_m {
                return;
            }
            self.len -= 1;
        }
        let mut place = self.len;
        while place > 0 && self.hits[place - 1].range_m > hit.range_m {
            self.hits[place] = self.hits[place - 1];
            place -= 1;
        }
        self.hits[place] = hit;
        self.len += 1;
    }

    /// Drops what the beam does not get to.
    #[inline(always)]
    fn shorten(&mut self) {
        let mut left = 1.0;
        for i in 0..self.len {
            left *= 1.0 - self.hits[i].weight;
            if left < END {
                self.len = i + 1;
                self.reach_m = self.hits[i].range_m;
                return;
            }
        }
    }

    /// Returns the splats with the share of the beam's light that ends at each, nearest first.
    pub(super) fn weigh(&mut self) -> &[Hit] {
        let mut left = 1.0;
        for hit in &mut self.hits[..self.len] {
            let alpha = hit.weight;
            hit.weight = alpha * left;
            left *= 1.0 - alpha;
        }
        &self.hits[..self.len]
    }
}

/// What comes back together: hits within a receiver's resolution.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Echo {
    /// Where half of its power comes from before, half from behind. [m]
    pub(super) range_m: f32,
    /// Light that comes back per light that was sent to a white plane across the beam at that range.
    pub(super) power: f32,
    /// Mean cosine of incidence.
    pub(super) cosine: f32,
    /// Share of the beam that ends there.
    pub(super) weight: f32,
    /// Of which part of the scene.
    pub(super) tag: Tag,
}

/// Calls `f` with each echo of weighed hits, nearest first: hits apart by more than `resolution_m` from the echo's first
/// begin a new one.
pub(super) fn echoes(hits: &[Hit], resolution_m: f32, mut f: impl FnMut(Echo)) {
    let mut start = 0;
    while start < hits.len() {
        let first_m = hits[start].range_m;
        let count =
            hits[start..].iter().take_while(|h| h.range_m - first_m <= resolution_m).count();
        let group = &hits[start..start + count];
        start += count;
        let sum = |of: fn(&Hit) -> f32| group.iter().map(of).sum::<f32>();
        let power = sum(|h| h.weight * h.reflectivity * h.cosine);
        let weight = sum(|h| h.weight);
        if !(power > 0.0) {
            continue;
        }
        let mut before = 0.0;
        let mut middle = &group[0];
        for hit in group {
            middle = hit;
            before += hit.weight * hit.reflectivity * hit.cosine;
            if before >= 0.5 * power {
                break;
            }
        }
        f(Echo {
            range_m: middle.range_m,
            power,
            cosine: sum(|h| h.weight * h.cosine) / weight,
            weight,
            tag: middle.tag,
        });
    }
}

/// A beam in the axes of a part.
#[derive(Clone, Copy, Debug)]
struct Ray {
    origin_m: Vec3,
    direction: Vec3,
    spread: f32,
}

/// Follows a ray through a tree.
struct Follow<'a> {
    tree: &'a Tree,
    ray: Ray,
    tag: Tag,
    hits: &'a mut Hits,
}

/// Nodes that wait: seven at each of the levels, of which no scene that memory holds has more.
const MAX_STACK: usize = 160;
/// Standard deviations within which a footprint adds to a splat's box.
const FOOTPRINT: f32 = 3.4;

impl Kernel for Follow<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { tree, ray, tag, hits } = self;
        assert_eq!(S::LANES, WIDTH, "leaves hold the lanes of a vector");
        if tree.nodes.is_empty() {
            return;
        }
        let mut stack = [(0.0_f32, 0_u32); MAX_STACK];
        let mut waiting = 1;
        let d = ray.direction.to_array();
        // No infinity, so that no product is NaN.
        let inverse = d.map(|v| if v.abs() < 1e-12 { 1e12_f32.copysign(v) } else { 1.0 / v });
        let direction = d.map(|v| s.splat(v));
        let origin = ray.origin_m.to_array().map(|v| s.splat(v));
        let (inverse, steep) = (inverse.map(|v| s.splat(v)), inverse.map(|v| s.splat(v.abs())));
        let zero = s.splat(0.0);
        let footprint = s.splat(FOOTPRINT * ray.spread);
        while waiting > 0 {
            waiting -= 1;
            let (near_m, child) = stack[waiting];
            if near_m > hits.reach_m {
                continue;
            }
            if child & LEAF != 0 {
                meet(s, &tree.leaves[(child & !LEAF) as usize], &ray, tag, hits);
                hits.shorten();
                continue;
            }
            let node = &tree.nodes[child as usize];
            let rel = [0, 1, 2].map(|a| s.load(&node.center_m[a]) - origin[a]);
            let half = [0, 1, 2].map(|a| s.load(&node.half_m[a]));
            let along = s.mul_add(
                rel[0],
                direction[0],
                s.mul_add(rel[1], direction[1], rel[2] * direction[2]),
            );
            // The footprint at the box's far side at most.
            let margin = (s.max(along, zero) + half[0] + half[1] + half[2]) * footprint;
            let (mut near, mut far) = (zero, s.splat(hits.reach_m));
            for a in 0..3 {
                let middle = rel[a] * inverse[a];
                let side = (half[a] + margin) * steep[a];
                near = s.max(middle - side, near);
                far = s.min(middle + side, far);
            }
            let mut met = !s.bits(s.lt(far, near)) & 0xff;
            let mut nears = [0.0; WIDTH];
            s.store(near, &mut nears);
            // The nearest on top: by insertion, of mostly two or three.
            let first = waiting;
            while met != 0 {
                let lane = met.trailing_zeros() as usize;
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

/// Adds the splats of a leaf that a ray meets.
#[inline(always)]
fn meet<S: Simd>(s: S, leaf: &super::tree::Leaf, ray: &Ray, tag: Tag, hits: &mut Hits) {
    let zero = s.splat(0.0);
    let direction = ray.direction.to_array().map(|v| s.splat(v));
    let origin = ray.origin_m.to_array();
    // From the mean to the ray's origin.
    let from = [0, 1, 2].map(|a| s.splat(origin[a]) - s.load(&leaf.mean_m[a]));
    let dot =
        |a: [S::F; 3], b: [S::F; 3]| s.mul_add(a[0], b[0], s.mul_add(a[1], b[1], a[2] * b[2]));
    let along = dot(from, direction);
    let width = along * s.splat(ray.spread);
    let blur = width * width;
    let axes = [0, 1, 2].map(|k| [0, 1, 2].map(|row| s.load(&leaf.axes[k][row])));
    let d = axes.map(|axis| dot(axis, direction));
    let o = axes.map(|axis| dot(axis, from));
    let thin = [0, 1, 2].map(|k| s.load(&leaf.variance_m2[k]));
    let wide = thin.map(|v| v + blur);
    let one = s.splat(1.0);
    let weight = wide.map(|v| one / v);
    let wd = [0, 1, 2].map(|k| weight[k] * d[k]);
    let curvature = dot(wd, d);
    // Where the Gaussian is greatest along the ray.
    let range = (zero - dot(wd, o)) / curvature;
    let p = [0, 1, 2].map(|k| s.mul_add(range, d[k], o[k]));
    let squares = dot([0, 1, 2].map(|k| weight[k] * p[k]), p);
    // By what the footprint adds to the area of the projection, whose determinant is that of the covariance times the
    // curvature along the ray: sums of products, without a quotient that could overflow.
    let square = d.map(|v| v * v);
    let area = |v: [S::F; 3]| dot(square, [v[1] * v[2], v[0] * v[2], v[0] * v[1]]);
    let dimmed = s.sqrt(area(thin) / area(wide));
    let half_log2_e = s.splat(std::f32::consts::LOG2_E / 2.0);
    let level = s.neg_mul_add(squares, half_log2_e, s.load(&leaf.level));
    // exp2 promises nothing below -126.
    let alpha = s.min(s.exp2(s.max(level, s.splat(-100.0))) * dimmed, s.splat(ALPHA_MAX as f32));
    let seen = s.lt(s.splat(ALPHA_MIN as f32), alpha)
        & s.lt(zero, range)
        & s.lt(range, s.splat(hits.reach_m));
    let mut met = s.bits(seen);
    if met == 0 {
        return;
    }
    let (mut ranges, mut alphas, mut normals) = ([0.0; WIDTH], [0.0; WIDTH], [0.0; WIDTH]);
    s.store(range, &mut ranges);
    s.store(alpha, &mut alphas);
    s.store(d[2], &mut normals);
    while met != 0 {
        let lane = met.trailing_zeros() as usize;
        met &= met - 1;
        let flat = leaf.flatness[lane];
        hits.insert(Hit {
            range_m: ranges[lane],
            weight: alphas[lane],
            // A ball's mean over the directions that it faces.
            cosine: (flat * normals[lane].abs() + (1.0 - flat) * (2.0 / 3.0)).min(1.0),
            reflectivity: leaf.reflectivity[lane],
            tag,
        });
    }
}
