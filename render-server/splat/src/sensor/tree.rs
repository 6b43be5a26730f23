//! Tree of splats for ray casting: eight splats per leaf, eight boxes per node. It is built once
//! per part of a scene, in one pass.
//!
//! The tree is built top-down: the widest child of a node is split by the surface area heuristic
//! over bins (Wald 2007, "On fast construction of SAH-based bounding volume hierarchies") until the
//! node has eight children.

use glam::{Mat3, Quat, Vec3};
use half::f16;

use crate::{Splats, harmonics};

/// Boxes per node and splats per leaf: the lanes of a vector.
pub(super) const WIDTH: usize = 8;
/// Flag of a child that is a leaf.
pub(super) const LEAF: u32 = 1 << 31;
/// Unused child.
pub(super) const NONE: u32 = u32::MAX;
/// Minimum thickness of a splat: at a range of 100 m, f32 does not resolve less. [m]
const MIN_SCALE_M: f32 = 1e-4;
/// Maximum size of a splat: the limit of half precision. [m]
const MAX_SCALE_M: f32 = 6e4;

/// Node: the boxes of its children, as centres and half sides.
#[derive(Clone, Debug)]
pub(super) struct Node {
    pub(super) center_m: [[f32; WIDTH]; 3],
    pub(super) half_m: [[f32; WIDTH]; 3],
    /// Index of a node, or of a leaf with [`LEAF`]; or [`NONE`].
    pub(super) children: [u32; WIDTH],
}

/// Eight Gaussians as a structure of arrays, partly in half precision: 240 bytes, because ray
/// casting is limited by memory. Unused places have the level minus infinity.
#[derive(Clone, Debug)]
pub(super) struct Leaf {
    pub(super) mean_m: [[f32; WIDTH]; 3],
    /// Unit quaternion from the axes of the Gaussian, of which the last is the thinnest; xyzw.
    /// [f16]
    pub(super) rotation: [[u16; WIDTH]; 4],
    /// Standard deviations along those axes. [m, f16]
    pub(super) scale_m: [[u16; WIDTH]; 3],
    /// log2 of the opacity. [f16]
    pub(super) level: [u16; WIDTH],
    /// Share of light that is reflected, 0 to 255.
    pub(super) reflectivity: [u8; WIDTH],
    /// Flatness: 255 for a disc with a normal, 0 if the two thinnest axes are equal.
    pub(super) flatness: [u8; WIDTH],
}

/// Tree of one part of a scene.
#[derive(Clone, Debug, Default)]
pub(super) struct Tree {
    /// Nodes, the root first; empty if there are no visible splats.
    pub(super) nodes: Vec<Node>,
    pub(super) leaves: Vec<Leaf>,
}

/// Splat, and the box within which it is relevant.
struct Item {
    low_m: Vec3,
    high_m: Vec3,
    index: u32,
}

impl Tree {
    /// Packs splats. Invisible splats are dropped, as in the renderers.
    pub(super) fn new(splats: &Splats) -> Self {
        let mut items: Vec<Item> = crate::blocks::order(splats)
            .into_iter()
            .map(|index| {
                let i = index as usize;
                let axes = rotated_scales(splats, i);
                let deviations = reach(splats.opacities[i]);
                // Bounding box of an ellipsoid: the length of each row of its square root.
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

    /// Adds a node for `items`, and returns its index.
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
            // Halved before addition, so that no sum overflows. Widened by the rounding error.
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
            // The thinnest axis is last; the first follows from the others, so that the matrix
            // stays a rotation.
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
            // A disc is at most a third as thick as wide.
            leaf.flatness[lane] = byte((1.5 * (1.0 - scales[thinnest] / scales[middle])).min(1.0));
        }
        leaf
    }
}

/// Minimum alpha of a splat that a beam detects. Images use 1/255, the step of 8 bits. For ranges,
/// this higher limit makes no difference; a surface of splats loses a twentieth of its opacity, and
/// boxes have half the area.
pub(super) const LEAST_ALPHA: f32 = 0.05;

/// Returns the number of standard deviations at which an opacity falls below [`LEAST_ALPHA`].
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

/// Returns the share of light that a splat of this colour reflects: its luminance (ITU-R BT.709) in
/// linear light as seen by a camera, including light and shadow, and at least that of soot. The
/// reflectivity in near infrared is unknown.
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

/// Range of a node's items that becomes a child, and half the surface of its bounding box.
#[derive(Clone, Copy)]
struct Range {
    start: usize,
    end: usize,
    area: f32,
}

impl Range {
    /// Returns the number of leaves that it fills.
    fn leaves(&self) -> usize {
        (self.end - self.start).div_ceil(WIDTH)
    }
}

/// Sorts the items of a node into at most eight ranges, one per child.
///
/// The cost of a ray is the number of nodes and leaves, even if they are nearly empty. Ranges with
/// more leaves than a node holds are therefore split first, the widest before others. A smaller
/// range is split into its leaves if all of them find a place; otherwise it is not split.
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

/// Returns half the surface of the bounding box. For very large scenes it overflows to infinity,
/// which can still be compared.
fn area(items: &[Item]) -> f32 {
    let (low, high) = bounds(items);
    half_surface(high - low)
}

fn half_surface(side: Vec3) -> f32 {
    side.x * side.y + side.y * side.z + side.z * side.x
}

/// Sorts the items, more than one leaf of them, to both sides of the plane with the lowest cost.
/// Returns the number of items before the plane, which is at least one and less than all.
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
        // All items are in one place, or beyond f32: split into halves.
        return if count == 0 || count == items.len() { items.len() / 2 } else { count };
    }
    // All leaves except the last are full: the plane moves to the nearest position that ensures
    // this.
    let full = ((count + WIDTH / 2) / WIDTH).clamp(1, leaves - 1) * WIDTH;
    items.select_nth_unstable_by(full, |a, b| middle(a)[axis].total_cmp(&middle(b)[axis]));
    full
}
