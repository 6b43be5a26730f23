//! Splats packed for rays: eight to a leaf, eight boxes to a node. Made once per part of a scene, in one pass over it.
//!
//! The tree is built from the top: a node's widest child is split by the surface area heuristic over bins (Wald 2007, "On fast
//! construction of SAH-based bounding volume hierarchies") until the node has eight.

use glam::{Mat3, Quat, Vec3};
use half::f16;

use crate::{Splats, harmonics};

/// Boxes of a node, splats of a leaf: the lanes of a vector.
pub(super) const WIDTH: usize = 8;
/// Marks a child that is a leaf.
pub(super) const LEAF: u32 = 1 << 31;
/// A child that is not there.
pub(super) const NONE: u32 = u32::MAX;
/// Thinner splats count as this thin: f32 cannot follow a ray of 100 m more exactly. [m]
const MIN_SCALE_M: f32 = 1e-4;
/// Larger ones count as this large: half precision ends there. [m]
const MAX_SCALE_M: f32 = 6e4;

/// A node: the boxes of its children, as middles and half sides.
#[derive(Clone, Debug)]
pub(super) struct Node {
    pub(super) center_m: [[f32; WIDTH]; 3],
    pub(super) half_m: [[f32; WIDTH]; 3],
    /// Index of a node, or with [`LEAF`] of a leaf; [`NONE`].
    pub(super) children: [u32; WIDTH],
}

/// Eight Gaussians, number by number, half of them in half precision: 240 bytes, for what a ray waits for is memory. Places that are
/// not filled have the level minus infinity.
#[derive(Clone, Debug)]
pub(super) struct Leaf {
    pub(super) mean_m: [[f32; WIDTH]; 3],
    /// Unit quaternion from the Gaussian's axes, of which the thinnest is the last; xyzw. [f16]
    pub(super) rotation: [[u16; WIDTH]; 4],
    /// Standard deviations along those axes. [m, f16]
    pub(super) scale_m: [[u16; WIDTH]; 3],
    /// log2 of the opacity. [f16]
    pub(super) level: [u16; WIDTH],
    /// Share of light that comes back, 0 to 255.
    pub(super) reflectivity: [u8; WIDTH],
    /// How much of a disc it is: 255 where it has a normal, 0 where its two thinnest axes are alike.
    pub(super) flatness: [u8; WIDTH],
}

/// The splats of one part of a scene.
#[derive(Clone, Debug, Default)]
pub(super) struct Tree {
    /// The root first; none where there is nothing to see.
    pub(super) nodes: Vec<Node>,
    pub(super) leaves: Vec<Leaf>,
}

/// One splat, and the box within which it counts.
struct Item {
    low_m: Vec3,
    high_m: Vec3,
    index: u32,
}

impl Tree {
    /// Packs splats; those that no image would show either are left out, as renderers do.
    pub(super) fn new(splats: &Splats) -> Self {
        let mut items: Vec<Item> = crate::blocks::order(splats)
            .into_iter()
            .map(|index| {
                let i = index as usize;
                let axes = rotated_scales(splats, i);
                let deviations = reach(splats.opacities[i]);
                // The box of an ellipsoid: the length of each row of its square root.
                let half_m = (axes.x_axis * axes.x_axis
                    + axes.y_axis * axes.y_axis
                    + axes.z_axis * axes.z_axis)
                    .map(f32::sqrt)
                    * deviations;
                let mean_m = splats.means_m[i];
                Item { low_m: mean_m - half_m, high_m: mean_m + half_m, index }
            })
            .collect();
        let mut tree = Self::default();
        if !items.is_empty() {
            tree.add_node(splats, &mut items);
        }
        tree
    }

    /// Adds the node over `items`, and returns its index.
    fn add_node(&mut self, splats: &Splats, items: &mut [Item]) -> u32 {
        let index = self.nodes.len();
        self.nodes.push(Node {
            center_m: [[0.0; WIDTH]; 3],
            half_m: [[0.0; WIDTH]; 3],
            children: [NONE; WIDTH],
        });
        let ranges = ranges(items);
        for (place, &Range { start, end, .. }) in ranges.iter().enumerate() {
            let (low, high) = bounds(&items[start..end]);
            // Halved before they are added: no sum overflows. Widened by their own rounding.
            let center = low * 0.5 + high * 0.5;
            let half = (high * 0.5 - low * 0.5) + center.abs() * 1e-6 + Vec3::splat(1e-6);
            for axis in 0..3 {
                self.nodes[index].center_m[axis][place] = center[axis];
                self.nodes[index].half_m[axis][place] = half[axis];
            }
            let within = &mut items[start..end];
            self.nodes[index].children[place] = if within.len() <= WIDTH {
                self.leaves.push(Leaf::new(splats, within));
                (self.leaves.len() - 1) as u32 | LEAF
            } else {
                self.add_node(splats, within)
            };
        }
        index as u32
    }
}

impl Leaf {
    fn new(splats: &Splats, items: &[Item]) -> Self {
        let half = |v: f32| f16::from_f32(v).to_bits();
        let byte = |share: f32| (share * 255.0).round() as u8;
        let mut leaf = Self {
            mean_m: [[0.0; WIDTH]; 3],
            rotation: [[half(0.5); WIDTH]; 4],
            scale_m: [[half(1.0); WIDTH]; 3],
            level: [half(f32::NEG_INFINITY); WIDTH],
            reflectivity: [0; WIDTH],
            flatness: [0; WIDTH],
        };
        let numbers = splats.sh_coefficients() * 3;
        for (lane, item) in items.iter().enumerate() {
            let i = item.index as usize;
            let axes = Mat3::from_quat(splats.rotations[i].normalize());
            let scales = clamped(splats.scales_m[i]).to_array();
            // The thinnest axis last; the first by the others, so that it stays a rotation.
            let mut order = [0, 1, 2];
            order.sort_by(|&a, &b| scales[b].total_cmp(&scales[a]));
            let [_, middle, thinnest] = order;
            let [across, normal] = [axes.col(middle), axes.col(thinnest)];
            let turned = Quat::from_mat3(&Mat3::from_cols(across.cross(normal), across, normal));
            for (numbers, v) in leaf.rotation.iter_mut().zip(turned.normalize().to_array()) {
                numbers[lane] = half(v);
            }
            for axis in 0..3 {
                leaf.scale_m[axis][lane] = half(scales[order[axis]]);
                leaf.mean_m[axis][lane] = splats.means_m[i][axis];
            }
            leaf.level[lane] = half(splats.opacities[i].log2());
            let constant = &splats.sh[i * numbers..i * numbers + 3];
            leaf.reflectivity[lane] = byte(reflectivity([constant[0], constant[1], constant[2]]));
            // A third as thick as wide is a disc.
            leaf.flatness[lane] = byte((1.5 * (1.0 - scales[thinnest] / scales[middle])).min(1.0));
        }
        leaf
    }
}

/// Where a splat hides less, a beam takes no notice of it. Images go down to 1/255, for what 8 bits show; a range does not change by
/// it, a surface of splats loses a twentieth of its opacity, and boxes have half the area.
pub(super) const LEAST_ALPHA: f32 = 0.05;

/// Returns the standard deviations at which an opacity falls below [`LEAST_ALPHA`].
fn reach(opacity: f32) -> f32 {
    (2.0 * (opacity / LEAST_ALPHA).ln().max(0.0)).sqrt()
}

pub(super) fn clamped(scales_m: Vec3) -> Vec3 {
    scales_m.clamp(Vec3::splat(MIN_SCALE_M), Vec3::splat(MAX_SCALE_M))
}

fn rotated_scales(splats: &Splats, i: usize) -> Mat3 {
    let rotation: Quat = splats.rotations[i].normalize();
    Mat3::from_quat(rotation) * Mat3::from_diagonal(clamped(splats.scales_m[i]))
}

/// Returns the share of light that comes back from a splat of this colour: its luminance (ITU-R BT.709) in linear light, of
/// what a camera sees, light and shadow included, at least that of soot. What near infrared would see is not known.
pub(super) fn reflectivity(constant: [f32; 3]) -> f32 {
    let linear = constant.map(|c| {
        let shown = (0.5 + harmonics::C0 as f32 * c).clamp(0.0, 1.0);
        // The inverse sRGB transfer (IEC 61966-2-1).
        if shown <= 0.04045 { shown / 12.92 } else { ((shown + 0.055) / 1.055).powf(2.4) }
    });
    (0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]).clamp(0.03, 1.0)
}

fn bounds(items: &[Item]) -> (Vec3, Vec3) {
    items.iter().fold((Vec3::MAX, Vec3::MIN), |(low, high), item| {
        (low.min(item.low_m), high.max(item.high_m))
    })
}

/// A range of a node's items that becomes a child, and half the surface of the box around it.
#[derive(Clone, Copy)]
struct Range {
    start: usize,
    end: usize,
    area: f32,
}

impl Range {
    /// Returns how many leaves it fills.
    fn leaves(&self) -> usize {
        (self.end - self.start).div_ceil(WIDTH)
    }
}

/// Sorts a node's items into at most eight ranges, one a child.
///
/// What a ray pays for is nodes and leaves, however empty. So ranges of more than a node of leaves are split first, the widest
/// before others; one that is less than that is split into its leaves if all of them find a place, else left whole.
fn ranges(items: &mut [Item]) -> Vec<Range> {
    let mut ranges = vec![Range { start: 0, end: items.len(), area: area(items) }];
    loop {
        let spare = WIDTH - ranges.len();
        let splits = |range: &Range| match range.leaves() {
            0 | 1 => false,
            leaves if leaves <= WIDTH => leaves - 1 <= spare,
            _ => spare > 0,
        };
        let widest = (0..ranges.len()).filter(|&i| splits(&ranges[i])).max_by(|&a, &b| {
            let (a, b) = (&ranges[a], &ranges[b]);
            let large = |range: &Range| range.leaves() > WIDTH;
            large(a).cmp(&large(b)).then(a.area.total_cmp(&b.area))
        });
        let Some(place) = widest else { return ranges };
        let Range { start, end, .. } = ranges[place];
        let middle = start + split(&mut items[start..end]);
        let range =
            |start, end, items: &[Item]| Range { start, end, area: area(&items[start..end]) };
        ranges[place] = range(start, middle, items);
        ranges.push(range(middle, end, items));
    }
}

/// Returns half the surface of the box around all; large scenes overflow to infinity, which compares.
fn area(items: &[Item]) -> f32 {
    let (low, high) = bounds(items);
    half_surface(high - low)
}

fn half_surface(side: Vec3) -> f32 {
    side.x * side.y + side.y * side.z + side.z * side.x
}

/// Sorts more items than a leaf's to both sides of the plane that costs least, and returns how many are before it; never none
/// nor all.
fn split(items: &mut [Item]) -> usize {
    const BINS: usize = 16;
    let middle = |item: &Item| item.low_m * 0.5 + item.high_m * 0.5;
    let (low, high) = items.iter().fold((Vec3::MAX, Vec3::MIN), |(low, high), item| {
        (low.min(middle(item)), high.max(middle(item)))
    });
    let mut best = (f32::INFINITY, 0, 0.0);
    for axis in 0..3 {
        let extent = high[axis] - low[axis];
        if !(extent > 0.0 && extent.is_finite()) {
            continue;
        }
        let scale = BINS as f32 / extent;
        let mut bins = [(0_usize, Vec3::MAX, Vec3::MIN); BINS];
        for item in items.iter() {
            let bin = (((middle(item)[axis] - low[axis]) * scale) as usize).min(BINS - 1);
            let (count, lowest, highest) = &mut bins[bin];
            *count += 1;
            *lowest = lowest.min(item.low_m);
            *highest = highest.max(item.high_m);
        }
        let sweep = |order: &mut dyn Iterator<Item = usize>| {
            let mut cost = [0.0; BINS];
            let (mut count, mut lowest, mut highest) = (0, Vec3::MAX, Vec3::MIN);
            for bin in order {
                count += bins[bin].0;
                lowest = lowest.min(bins[bin].1);
                highest = highest.max(bins[bin].2);
                cost[bin] =
                    if count == 0 { 0.0 } else { count as f32 * half_surface(highest - lowest) };
            }
            cost
        };
        let (before, after) = (sweep(&mut (0..BINS)), sweep(&mut (0..BINS).rev()));
        for plane in 1..BINS {
            let cost = before[plane - 1] + after[plane];
            if cost < best.0 {
                best = (cost, axis, low[axis] + plane as f32 / scale);
            }
        }
    }
    let (cost, axis, plane) = best;
    let mut count = 0;
    if cost.is_finite() {
        for i in 0..items.len() {
            if middle(&items[i])[axis] < plane {
                items.swap(i, count);
                count += 1;
            }
        }
    }
    let leaves = items.len().div_ceil(WIDTH);
    if leaves > WIDTH {
        // All in one place, or beyond f32: halves do.
        return if count == 0 || count == items.len() { items.len() / 2 } else { count };
    }
    // Leaves are full but for the last: the plane moves to the nearest place that keeps them so.
    let full = ((count + WIDTH / 2) / WIDTH).clamp(1, leaves - 1) * WIDTH;
    items.select_nth_unstable_by(full, |a, b| middle(a)[axis].total_cmp(&middle(b)[axis]));
    full
}
