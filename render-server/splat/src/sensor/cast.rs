//! One beam through the splats: what it meets, and the echoes that makes.
//!
//! Budget: some 0.7 us a beam and thread in a forest of 125 k splats, bound by the boxes and splats that it touches.
//!
//! `follow` finds the splats; here they become echoes. Splats are taken in the order of their depths, and what one lets pass
//! meets the next, as in an image.

use glam::DVec3;

use super::SensorMotion;
use super::follow::{Follow, Ray};
use super::tree::{NONE, Tree, WIDTH};
use crate::cpu::simd::InstructionSet;
use crate::{Placement, Scene, Splats};

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

    /// Finds what each of some beams meets, at its share of `motion`, 0 to 1. Beams close to one another, as neighbours of a ring are,
    /// take less time together; any others get the same.
    pub(super) fn cast(&self, motion: &SensorMotion<'_>, beams: &[(f64, Beam)], hits: &mut [Hits]) {
        let mut rays = [Ray::default(); TOGETHER];
        for (beams, hits) in beams.chunks(TOGETHER).zip(hits.chunks_mut(TOGETHER)) {
            for (((_, beam), ray), hits) in beams.iter().zip(&mut rays).zip(hits.iter_mut()) {
                hits.begin(beam.max_m);
                *ray = beam.ray(beam.origin_m, beam.direction);
            }
            // A cone around rays must be narrow, or its boxes are no bounds.
            let first = beams[0].1.direction;
            let narrow = beams.iter().all(|(_, beam)| beam.direction.dot(first) > NARROW);
            let together = if narrow { TOGETHER } else { 1 };
            for (rays, hits) in rays[..beams.len()].chunks(together).zip(hits.chunks_mut(together))
            {
                self.follow(0, rays, hits);
            }
            for (i, placements) in motion.objects.iter().enumerate() {
                for ((share, beam), hits) in beams.iter().zip(hits.iter_mut()) {
                    if let Some(ray) = self.in_object(i + 1, placements, *share, beam) {
                        self.follow(i + 1, &[ray], std::slice::from_mut(hits));
                    }
                }
            }
        }
    }

    /// Casts `count` beams in groups of neighbours: `beam` says which is the n-th and at which share of `motion` it leaves, and
    /// `met` is told what it meets, weighed and nearest first, one after the other.
    pub(super) fn cast_each(
        &self,
        motion: &SensorMotion<'_>,
        count: usize,
        hits: &mut [Hits; TOGETHER],
        beam: impl Fn(usize) -> (f64, Beam),
        mut met: impl FnMut(usize, &[Hit]),
    ) {
        let mut beams = [(0.0, Beam::default()); TOGETHER];
        for first in (0..count).step_by(TOGETHER) {
            let group = TOGETHER.min(count - first);
            for (i, place) in beams[..group].iter_mut().enumerate() {
                *place = beam(first + i);
            }
            self.cast(motion, &beams[..group], &mut hits[..group]);
            for (i, hits) in hits[..group].iter_mut().enumerate() {
                met(first + i, hits.weigh());
            }
        }
    }

    fn follow(&self, number: usize, rays: &[Ray], hits: &mut [Hits]) {
        let part = &self.parts[number];
        let tag = Tag { id: part.id, part: number as u16 };
        self.instructions.run(Follow { tree: &part.tree, rays, tag, hits });
    }

    /// Returns a beam as an object sees it that is placed at both ends of the motion; `None` if it passes by.
    fn in_object(
        &self,
        number: usize,
        placements: &[Placement; 2],
        share: f64,
        beam: &Beam,
    ) -> Option<Ray> {
        let [Some(begin), Some(end)] = placements else { return None };
        // A sphere about its origin first, for most beams miss an object: a line costs less than a slerp.
        let middle_m = begin.translation_m.lerp(end.translation_m, share) - beam.origin_m;
        let along_m = middle_m.dot(beam.direction);
        let across_m2 = middle_m.length_squared() - along_m * along_m;
        let around_m = self.parts[number].radius_m;
        let radius_m = around_m + 4.0 * f64::from(beam.spread) * (middle_m.length() + around_m);
        if !(along_m > -radius_m && across_m2 < radius_m * radius_m) {
            return None;
        }
        let between = if begin == end { *begin } else { begin.interpolate(end, share) };
        let object_from_world = between.inverse();
        let origin = object_from_world.transform_point(beam.origin_m);
        Some(beam.ray(origin, object_from_world.rotate(beam.direction)))
    }
}

/// Beams that go through the tree together.
pub(super) const TOGETHER: usize = 8;
/// Cosine of the angle within which they have to be: 14 degrees.
const NARROW: f64 = 0.97;

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
#[derive(Clone, Copy, Debug, Default)]
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

impl Beam {
    fn ray(&self, origin_m: DVec3, direction: DVec3) -> Ray {
        Ray { origin_m: origin_m.as_vec3(), direction: direction.as_vec3(), spread: self.spread }
    }
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
#[derive(Clone, Copy, Debug)]
pub(super) struct Hits {
    hits: [Hit; MAX_HITS],
    len: usize,
    /// Share of light that passes all of them.
    left: f32,
    /// Nothing behind it is seen. [m]
    pub(super) reach_m: f32,
}

/// Splats that one beam can meet before it ends. Some ten lie over one another on a painted surface; of more, as under a wide
/// footprint, the two that are closest become one.
const MAX_HITS: usize = 64;
/// A beam ends where less of it is left, and all of that ends there too: between the splats of an opaque surface up to a fifth
/// would go on (Gaussians that cover their surface 1.8 times leave exp(-1.8)), and no wall is behind itself.
const END: f32 = 0.25;

impl Hits {
    /// Makes room for one beam after the other.
    pub(super) fn new() -> Self {
        Self { hits: [Hit::default(); MAX_HITS], len: 0, left: 1.0, reach_m: 0.0 }
    }

    fn begin(&mut self, max_m: f32) {
        self.len = 0;
        self.left = 1.0;
        self.reach_m = max_m;
    }

    /// Adds a splat at its place; `weight` is its alpha.
    #[inline(always)]
    pub(super) fn insert(&mut self, hit: Hit) {
        if self.len == MAX_HITS {
            self.merge_closest();
        }
        let mut place = self.len;
        while place > 0 && self.hits[place - 1].range_m > hit.range_m {
            self.hits[place] = self.hits[place - 1];
            place -= 1;
        }
        self.hits[place] = hit;
        self.len += 1;
        self.left *= 1.0 - hit.weight;
    }

    /// Drops what the beam does not get to.
    #[inline(always)]
    pub(super) fn shorten(&mut self) {
        // By a product in another order, so with its rounding.
        if self.left > END * 1.001 {
            return;
        }
        let mut left = 1.0;
        for i in 0..self.len {
            left *= 1.0 - self.hits[i].weight;
            if left < END {
                self.len = i + 1;
                self.left = left;
                self.reach_m = self.hits[i].range_m;
                return;
            }
        }
    }

    /// Makes one of the two that are nearest to one another.
    #[cold]
    fn merge_closest(&mut self) {
        let gap = |i: &usize| self.hits[i + 1].range_m - self.hits[*i].range_m;
        let pairs = 0..MAX_HITS - 1;
        let i = pairs.min_by(|a, b| gap(a).total_cmp(&gap(b))).expect("there are pairs");
        let [near, far] = [self.hits[i], self.hits[i + 1]];
        let both = 1.0 - (1.0 - near.weight) * (1.0 - far.weight);
        let share = near.weight / both;
        let mix = |a: f32, b: f32| b + share * (a - b);
        self.hits[i] = Hit {
            range_m: mix(near.range_m, far.range_m),
            weight: both,
            cosine: mix(near.cosine, far.cosine),
            reflectivity: mix(near.reflectivity, far.reflectivity),
            tag: near.tag,
        };
        self.hits.copy_within(i + 2.., i + 1);
        self.len -= 1;
    }

    /// Returns the splats with the share of the beam's light that ends at each, nearest first.
    pub(super) fn weigh(&mut self) -> &[Hit] {
        let mut left = 1.0;
        for hit in &mut self.hits[..self.len] {
            let alpha = hit.weight;
            hit.weight = alpha * left;
            left *= 1.0 - alpha;
        }
        if let Some(last) = self.hits[..self.len].last_mut()
            && left < END
        {
            last.weight += left;
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
