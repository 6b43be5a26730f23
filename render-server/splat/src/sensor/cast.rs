//! Casting of one beam through the splats: hits, and the echoes that they form.
//!
//! Budget: about 0.7 us per beam and thread in a forest of 125 k splats, limited by the boxes and
//! splats that it touches.
//!
//! `follow` finds the splats; this module combines them to echoes. Splats are sorted by depth, and
//! light that one transmits reaches the next, as in an image.

use glam::DVec3;

use super::SensorMotion;
use super::follow::{Follow, Ray};
use super::tree::{NONE, Tree, WIDTH};
use crate::cpu::simd::InstructionSet;
use crate::{Placement, Scene, Splats};

/// Scene that is packed for beams. It is created once; any sensor can measure in it.
#[derive(Debug)]
pub struct SensorScene {
    instructions: InstructionSet,
    /// The static scene, then the objects.
    parts: Vec<Part>,
}

#[derive(Debug)]
struct Part {
    id: u16,
    tree: Tree,
    /// Radius of a sphere around the origin that contains the part. [m]
    radius_m: f64,
}

impl SensorScene {
    /// Packs a scene. Invisible splats are dropped, as in the renderers.
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

    /// Returns the number of movable objects.
    pub fn objects(&self) -> usize {
        self.parts.len() - 1
    }

    /// Finds the hits of each beam, at its share of `motion`, 0 to 1. Beams close to one another
    /// (neighbours of a ring) take less time together. The result does not depend on the grouping.
    pub(super) fn cast(&self, motion: &SensorMotion<'_>, beams: &[(f64, Beam)], hits: &mut [Hits]) {
        let mut rays = [Ray::default(); TOGETHER];
        for (beams, hits) in beams.chunks(TOGETHER).zip(hits.chunks_mut(TOGETHER)) {
            for (((_, beam), ray), hits) in beams.iter().zip(&mut rays).zip(hits.iter_mut()) {
                hits.begin(beam.max_m);
                *ray = beam.ray(beam.origin_m, beam.direction);
            }
            // The bounds of boxes are valid only for a narrow cone around the rays.
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

    /// Casts `count` beams in groups of neighbours. `beam` returns the n-th beam and its share of
    /// `motion`. `met` is called for each beam in order, with its weighted hits, nearest first.
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

    /// Returns a beam in the axes of an object with the given placements at both ends of the
    /// motion, or `None` if it misses the object.
    fn in_object(
        &self,
        number: usize,
        placements: &[Placement; 2],
        share: f64,
        beam: &Beam,
    ) -> Option<Ray> {
        let [Some(begin), Some(end)] = placements else { return None };
        // A sphere around its origin first, because most beams miss an object: linear interpolation
        // is cheaper than a slerp.
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

/// Number of beams that are cast through the tree together.
pub(super) const TOGETHER: usize = 8;
/// Minimum cosine of the angle between such beams: 14 degrees.
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

/// Beam in the world.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Beam {
    /// Start of the beam. [m, world]
    pub(super) origin_m: DVec3,
    /// Unit vector. [world]
    pub(super) direction: DVec3,
    /// Standard deviation of its footprint per metre of range. [rad]
    pub(super) spread: f32,
    /// Maximum range. [m]
    pub(super) max_m: f32,
}

impl Beam {
    fn ray(&self, origin_m: DVec3, direction: DVec3) -> Ray {
        Ray { origin_m: origin_m.as_vec3(), direction: direction.as_vec3(), spread: self.spread }
    }
}

/// Returns the standard deviation per metre of a beam, given its full angle at 1/e^2 of the central
/// intensity, as stated for lasers: four standard deviations.
pub(super) fn spread_of(divergence_rad: f32) -> f32 {
    divergence_rad / 4.0
}

/// Hit: a splat that a beam meets.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Hit {
    /// Range along the beam. [m]
    pub(super) range_m: f32,
    /// Share of the beam's light that ends at the splat, after weighting; before it, the share of
    /// the light that reaches the splat.
    pub(super) weight: f32,
    /// Cosine of the angle of incidence.
    pub(super) cosine: f32,
    pub(super) reflectivity: f32,
    pub(super) tag: Tag,
}

/// Part of the scene that a splat belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Tag {
    /// Id of the object; 0 is the static scene.
    pub(super) id: u16,
    /// Number of the object in the scene, from 1; 0 is the static scene.
    pub(super) part: u16,
}

/// Hits of a beam, nearest first.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hits {
    hits: [Hit; MAX_HITS],
    len: usize,
    /// Share of light that passes all hits.
    left: f32,
    /// Maximum range of further hits. [m]
    pub(super) reach_m: f32,
}

/// Maximum hits of a beam. About ten splats overlap on a painted surface. If there are more, for
/// example under a wide footprint, the two closest hits are merged.
const MAX_HITS: usize = 64;
/// Remaining light below which a beam ends; the hit at that point absorbs all of it. Up to a fifth
/// of the light would pass between the splats of an opaque surface (Gaussians that cover their
/// surface 1.8 times leave exp(-1.8)), and create a false wall behind it.
const END: f32 = 0.25;

impl Hits {
    /// Returns an empty list, to be reused for one beam after the other.
    pub(super) fn new() -> Self {
        Self { hits: [Hit::default(); MAX_HITS], len: 0, left: 1.0, reach_m: 0.0 }
    }

    fn begin(&mut self, max_m: f32) {
        self.len = 0;
        self.left = 1.0;
        self.reach_m = max_m;
    }

    /// Inserts a splat in order of range. `weight` is its alpha.
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

    /// Drops hits behind the end of the beam.
    #[inline(always)]
    pub(super) fn shorten(&mut self) {
        // The tolerance covers rounding, because `left` was multiplied in another order.
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

    /// Merges the two hits that are closest to each other.
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

    /// Returns the hits, weighted by the share of the beam's light that ends at each, nearest
    /// first.
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

/// Echo: hits within the resolution of the receiver.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Echo {
    /// Range that divides the power of the echo into halves. [m]
    pub(super) range_m: f32,
    /// Reflected light, relative to the light sent to a white plane across the beam at that range.
    pub(super) power: f32,
    /// Mean cosine of incidence.
    pub(super) cosine: f32,
    /// Share of the beam that ends at the echo.
    pub(super) weight: f32,
    /// Part of the scene.
    pub(super) tag: Tag,
}

/// Calls `f` with each echo of weighted hits, nearest first. A hit that is more than `resolution_m`
/// behind the first hit of an echo starts a new echo.
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
