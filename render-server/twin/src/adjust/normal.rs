//! Normal equations of all unknowns except the points, which are eliminated (Triggs et al. 2000, "Bundle adjustment: a
//! modern synthesis", section 6.1).
//!
//! The elimination uses orthonormal bases of the points' Jacobians. Inverting a point's own equations would let a point
//! very close to a camera, or far from all, spoil the others by rounding (Demmel et al. 2021, "Square root bundle
//! adjustment").

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::capture::Capture;
use super::matrix::{Symmetric, orthonormal};
use super::project::{LENS, Projected};
use super::robust::{INSET_PX, weight};
use super::rolling::{READOUT_S, Slopes};
use super::solve::Problem;
use super::state::{State, TagPlace, inwards};

/// Matrix and gradient of the normal equations.
pub(super) struct Normal {
    pub(super) matrix: Symmetric,
    pub(super) gradient: Vec<f64>,
}

/// Number of unknowns common to all images: the lens's parameters and the readout time.
pub(super) const SHARED: usize = LENS + 1;

/// Indices of the unknowns.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// Unknowns per camera: position, rotation, and, with a rolling shutter, the bend.
    pub(super) camera: usize,
    /// Index of the common unknowns; `None` if all are given.
    pub(super) shared: Option<usize>,
    /// For each common unknown, whether it is estimated.
    free: [bool; SHARED],
    /// Index of the inset; `None` without tags.
    pub(super) inset: Option<usize>,
    /// Index of each tag's pose; `None` if it is not estimated.
    pub(super) tags: Vec<Option<usize>>,
    pub(super) size: usize,
}

impl Layout {
    pub(super) fn new(state: &State, refine_lens: bool, rolling: bool) -> Self {
        let camera = if rolling { ROLLING } else { STILL };
        let mut size = camera * state.cameras.len();
        let free = std::array::from_fn(|i| if i < LENS { refine_lens } else { rolling });
        let shared = (refine_lens || rolling).then_some(size);
        size += if shared.is_some() { SHARED } else { 0 };
        let has_tags = state.tags.iter().any(|tag| !matches!(tag, TagPlace::Nowhere));
        let inset = has_tags.then_some(size);
        size += usize::from(has_tags);
        let tags = state.tags.iter().map(|tag| {
            matches!(tag, TagPlace::Found(..)).then(|| {
                size += 6;
                size - 6
            })
        });
        let tags = tags.collect();
        Self { camera, shared, free, inset, tags, size }
    }

    /// Returns the index of the readout time, if estimated.
    pub(super) fn readout(&self) -> Option<usize> {
        self.shared.filter(|_| self.free[LENS]).map(|at| at + LENS)
    }

    /// Returns the indices of the principal point, if estimated.
    pub(super) fn middle(&self) -> Vec<usize> {
        let at = self.shared.filter(|_| self.free[LENS - 1]);
        at.map_or(Vec::new(), |at| vec![at + LENS - 2, at + LENS - 1])
    }

    /// Returns derivatives by the common unknowns; zero for those that are given.
    fn by_shared(&self, by_lens: [DVec2; LENS], by_readout: DVec2) -> [DVec2; SHARED] {
        let mut by = std::array::from_fn(|i| if i < LENS { by_lens[i] } else { by_readout });
        by.iter_mut().zip(self.free).filter(|(_, free)| !free).for_each(|(d, _)| *d = DVec2::ZERO);
        by
    }

    /// Removes the unknowns of some tags.
    pub(super) fn without(mut self, tags: &[usize]) -> Self {
        for &tag in tags {
            if let Some(gone) = self.tags[tag].take() {
                self.size -= 6;
                self.tags.iter_mut().flatten().filter(|at| **at > gone).for_each(|at| *at -= 6);
            }
        }
        self
    }
}

impl Normal {
    fn zero(size: usize) -> Self {
        Self { matrix: Symmetric::zero(size), gradient: vec![0.0; size] }
    }

    /// Adds one residual with its derivatives by some blocks of unknowns, in ascending order.
    fn add(&mut self, blocks: &[(usize, &[f64])], residual: f64, weight: f64) {
        for (index, &(row, by_row)) in blocks.iter().enumerate() {
            for (i, a) in by_row.iter().enumerate() {
                self.gradient[row + i] += weight * a * residual;
                for &(column, by_column) in &blocks[..index] {
                    for (j, b) in by_column.iter().enumerate() {
                        self.matrix.add(row + i, column + j, weight * a * b);
                    }
                }
                for (j, b) in by_row[..=i].iter().enumerate() {
                    self.matrix.add(row + i, row + j, weight * a * b);
                }
            }
        }
    }

    /// Penalises steps along a direction of the unknowns.
    pub(super) fn hold(&mut self, direction: &[f64], weight: f64) {
        for (row, a) in direction.iter().enumerate().filter(|(_, a)| **a != 0.0) {
            for (column, b) in direction[..=row].iter().enumerate() {
                self.matrix.add(row, column, weight * a * b);
            }
        }
    }
}

/// One sighting of a point, with derivatives multiplied by the square root of its weight.
struct Seen<const N: usize> {
    camera: usize,
    by_camera: [DVec2; N],
    by_shared: [DVec2; SHARED],
    /// Rows of the basis of the point's Jacobian that belong to this sighting.
    basis: [DVec2; 3],
    residual: DVec2,
}

/// Part of the equations that belongs to one point.
struct PointPart<const N: usize> {
    /// Transforms moves of the point to the basis.
    basis_from_move: DMat3,
    /// Residuals projected onto the basis.
    residual: DVec3,
    seen: Vec<Seen<N>>,
}

/// Returns the part of a point; `None` if its sightings do not determine its position: fewer than two, or the point is
/// at a camera.
fn part<const N: usize>(
    problem: &Problem,
    state: &State,
    point: usize,
    damping: f64,
) -> Option<PointPart<N>> {
    let sightings = problem.sightings(point);
    let mut seen = Vec::with_capacity(sightings.len());
    let mut columns = [const { Vec::new() }; 3];
    // Minimum and maximum change of the images with the point. [px^2/m^2]
    let (mut least, mut greatest) = (f64::MAX, 0.0f64);
    for &(camera, pixel) in sightings {
        let Some((projected, in_row)) = state.see(camera, state.points[point], pixel) else {
            continue;
        };
        let residual = projected.pixel - pixel;
        let root = problem.noise.point_weight(residual).sqrt();
        let Projected { by_point, by_lens, .. } = projected;
        let Slopes { by_camera, by_point, by_readout } =
            in_row.slopes(&state.cameras[camera], &by_point);
        let slope2 = by_point.iter().map(|d| d.length_squared()).sum();
        (least, greatest) = (least.min(slope2), greatest.max(slope2));
        let by_shared = problem.layout.by_shared(by_lens, by_readout);
        columns.iter_mut().zip(by_point).for_each(|(column, d)| column.push(d * root));
        seen.push(Seen {
            camera,
            by_camera: std::array::from_fn(|i| by_camera[i] * root),
            by_shared: by_shared.map(|d| d * root),
            basis: [DVec2::ZERO; 3],
            residual: residual * root,
        });
    }
    if seen.len() < 2 || greatest > BEFORE_THE_NOSE.powi(2) * least {
        return None;
    }
    // Damping acts as if each coordinate of the point had been measured at its present value.
    let by_itself = columns.each_ref().map(|column| {
        let length2: f64 = column.iter().map(|d| d.length_squared()).sum();
        (damping * length2).sqrt()
    });
    for (k, (column, by)) in columns.iter_mut().zip(by_itself).enumerate() {
        let row = DVec3::AXES[k] * by;
        column.extend([row.truncate(), DVec2::new(row.z, 0.0)]);
    }
    let basis_from_move = orthonormal(&mut columns)?;
    let mut residual = DVec3::ZERO;
    for (row, one) in seen.iter_mut().enumerate() {
        one.basis = columns.each_ref().map(|column| column[row]);
        residual += along(one.residual, &one.basis);
    }
    Some(PointPart { basis_from_move, residual, seen })
}

/// Returns the component of an image change that a move of the point could also cause.
fn along(change: DVec2, basis: &[DVec2; 3]) -> DVec3 {
    DVec3::from_array(basis.map(|row| change.dot(row)))
}

fn products<const R: usize, const C: usize>(a: &[DVec3; R], b: &[DVec3; C]) -> [[f64; C]; R] {
    std::array::from_fn(|i| std::array::from_fn(|j| -a[i].dot(b[j])))
}

fn outer<const R: usize, const C: usize>(a: &[DVec2; R], b: &[DVec2; C]) -> [[f64; C]; R] {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i].dot(b[j])))
}

/// Returns the normal equations at a state, with points eliminated. `damping` applies to the points.
pub(super) fn normal(problem: &Problem, state: &State, damping: f64) -> Normal {
    let layout = &problem.layout;
    let add = if layout.camera == STILL { add_point::<STILL> } else { add_point::<ROLLING> };
    // The number of parts does not depend on the number of threads, so sums are the same on any machine.
    let parts = (PARTS_BYTES / (4 * layout.size * layout.size).max(1)).clamp(1, PARTS);
    let size = state.points.len().div_ceil(parts).max(1);
    let parts: Vec<Normal> = (0..parts)
        .into_par_iter()
        .map(|part| {
            let mut sum = Normal::zero(layout.size);
            let end = ((part + 1) * size).min(state.points.len());
            for point in (part * size).min(end)..end {
                add(&mut sum, problem, state, point, damping);
            }
            sum
        })
        .collect();
    let matrices: Vec<&Symmetric> = parts.iter().map(|part| &part.matrix).collect();
    let mut sum =
        Normal { matrix: Symmetric::sum(layout.size, &matrices), gradient: vec![0.0; layout.size] };
    for part in &parts {
        sum.gradient.iter_mut().zip(&part.gradient).for_each(|(sum, g)| *sum += g);
    }
    add_tags(&mut sum, problem, state);
    add_priors(&mut sum, problem.capture, problem, state);
    sum
}

fn add_point<const N: usize>(
    sum: &mut Normal,
    problem: &Problem,
    state: &State,
    point: usize,
    damping: f64,
) {
    let Some(part) = part::<N>(problem, state, point, damping) else { return };
    let shared = problem.layout.shared;
    let mut shared_along = [DVec3::ZERO; SHARED];
    let all_along: Vec<[DVec3; N]> =
        part.seen.iter().map(|seen| seen.by_camera.map(|by| along(by, &seen.basis))).collect();
    for (one, one_along) in part.seen.iter().zip(&all_along) {
        let row = N * one.camera;
        for i in 0..N {
            sum.gradient[row + i] +=
                one.by_camera[i].dot(one.residual) - one_along[i].dot(part.residual);
        }
        sum.matrix.add_block(row, row, &outer(&one.by_camera, &one.by_camera));
        for (other, other_along) in part.seen.iter().zip(&all_along) {
            // Only the lower triangle.
            if other.camera <= one.camera {
                sum.matrix.add_block(row, N * other.camera, &products(one_along, other_along));
            }
        }
        if let Some(shared) = shared {
            sum.matrix.add_block(shared, row, &outer(&one.by_shared, &one.by_camera));
            sum.matrix.add_block(shared, shared, &outer(&one.by_shared, &one.by_shared));
            for i in 0..SHARED {
                sum.gradient[shared + i] += one.by_shared[i].dot(one.residual);
                shared_along[i] += along(one.by_shared[i], &one.basis);
            }
        }
    }
    if let Some(shared) = shared {
        for i in 0..SHARED {
            sum.gradient[shared + i] -= shared_along[i].dot(part.residual);
        }
        sum.matrix.add_block(shared, shared, &products(&shared_along, &shared_along));
        for (one, one_along) in part.seen.iter().zip(&all_along) {
            sum.matrix.add_block(shared, N * one.camera, &products(&shared_along, one_along));
        }
    }
}

fn add_tags(sum: &mut Normal, problem: &Problem, state: &State) {
    for &(camera, seen) in &problem.tags {
        let Some(corners_m) = state.corners_m(problem.capture, seen.tag) else { continue };
        let off_px = state.tag_off_px(camera, &corners_m, seen);
        let weight = problem.noise.tag_weight(off_px.unwrap_or(f64::MAX));
        for (k, (&corner_m, &pixel)) in corners_m.iter().zip(&seen.corners_px).enumerate() {
            let inwards = inwards(seen)[k];
            let Some((projected, in_row)) = state.see(camera, corner_m, pixel) else { continue };
            let residual = projected.pixel + inwards * state.inset_px - pixel;
            let by = in_row.slopes(&state.cameras[camera], &projected.by_point);
            let by_shared = problem.layout.by_shared(projected.by_lens, by.by_readout);
            let by_tag = match state.tags[seen.tag] {
                TagPlace::Found(_, q) => {
                    let corner = problem.capture.square_m(seen.tag)[k];
                    let through = |v: DVec3| {
                        by.by_point[0] * v.x + by.by_point[1] * v.y + by.by_point[2] * v.z
                    };
                    let turn = DVec3::AXES.map(|axis| through(q * axis.cross(corner)));
                    let [x, y, z] = by.by_point;
                    Some([x, y, z, turn[0], turn[1], turn[2]])
                }
                _ => None,
            };
            for axis in 0..2 {
                let by_camera = by.by_camera.map(|d| d[axis]);
                let by_shared = by_shared.map(|d| d[axis]);
                let by_tag = by_tag.map(|by| by.map(|d| d[axis]));
                let mut blocks: Vec<(usize, &[f64])> =
                    vec![(problem.layout.camera * camera, &by_camera[..problem.layout.camera])];
                if let Some(shared) = problem.layout.shared {
                    blocks.push((shared, &by_shared));
                }
                let by_inset = [inwards[axis]];
                if let Some(inset) = problem.layout.inset {
                    blocks.push((inset, &by_inset));
                }
                if let (Some(at), Some(by_tag)) = (problem.layout.tags[seen.tag], &by_tag) {
                    blocks.push((at, by_tag));
                }
                sum.add(&blocks, residual[axis], weight);
            }
        }
    }
}

fn add_priors(sum: &mut Normal, capture: &Capture, problem: &Problem, state: &State) {
    if let Some(inset) = problem.layout.inset {
        sum.add(&[(inset, &[1.0])], state.inset_px, INSET_PX.powi(-2));
    }
    for (i, free) in problem.layout.free.iter().enumerate() {
        if let Some(shared) = problem.layout.shared.filter(|_| !free) {
            // Given values stay constant.
            sum.matrix.add(shared + i, shared + i, 1.0);
        }
    }
    for (at, off_px) in problem.layout.middle().into_iter().zip(state.off_middle_px().to_array()) {
        let sigma_px = state.middle_sigma_px();
        sum.add(&[(at, &[1.0])], off_px, sigma_px.powi(-2));
    }
    if let Some(readout) = problem.layout.readout() {
        sum.add(&[(readout, &[1.0])], state.rolling.readout_s, READOUT_S.powi(-2));
        for (camera, bend_rad) in state.rolling.bends_rad.iter().enumerate() {
            for axis in 0..3 {
                let at = problem.layout.camera * camera + STILL + axis;
                sum.add(&[(at, &[1.0])], bend_rad[axis], problem.noise.bend_rad.powi(-2));
            }
        }
    }
    let stride = problem.layout.camera;
    for (camera, (image, pose)) in capture.images.iter().zip(&state.cameras).enumerate() {
        if let Some(place) = image.place {
            let lever = capture.tracked_in_cam_m;
            let residual_m = pose.transform_point(lever) - place.position_m;
            let weight = problem.noise.place_weight(residual_m.length(), place.sigma_m);
            let turn = DVec3::AXES.map(|axis| pose.rotation * axis.cross(lever));
            for axis in 0..3 {
                let mut by = [0.0; 6];
                by[axis] = 1.0;
                (0..3).for_each(|k| by[3 + k] = turn[k][axis]);
                sum.add(&[(stride * camera, &by)], residual_m[axis], weight);
            }
        }
        if let Some(up) = image.up {
            let residual = pose.rotation * up.direction;
            let weight = weight(residual.truncate().length(), up.sigma_rad);
            let turn = DVec3::AXES.map(|axis| pose.rotation * axis.cross(up.direction));
            for axis in 0..2 {
                let mut by = [0.0; 6];
                (0..3).for_each(|k| by[3 + k] = turn[k][axis]);
                sum.add(&[(stride * camera, &by)], residual[axis], weight);
            }
        }
    }
}

/// Returns the moves of the points, given the change of all other unknowns.
pub(super) fn points_step(
    problem: &Problem,
    state: &State,
    change: &[f64],
    damping: f64,
) -> Vec<DVec3> {
    let step =
        if problem.layout.camera == STILL { point_step::<STILL> } else { point_step::<ROLLING> };
    (0..state.points.len())
        .into_par_iter()
        .map(|point| step(problem, state, point, change, damping))
        .collect()
}

fn point_step<const N: usize>(
    problem: &Problem,
    state: &State,
    point: usize,
    change: &[f64],
    damping: f64,
) -> DVec3 {
    let Some(part) = part::<N>(problem, state, point, damping) else { return DVec3::ZERO };
    let mut right = part.residual;
    for seen in &part.seen {
        let mut off = DVec2::ZERO;
        for (d, by) in seen.by_camera.iter().zip(&change[N * seen.camera..]) {
            off += *d * *by;
        }
        if let Some(shared) = problem.layout.shared {
            for (d, by) in seen.by_shared.iter().zip(&change[shared..]) {
                off += *d * *by;
            }
        }
        right += along(off, &seen.basis);
    }
    -(part.basis_from_move.inverse() * right)
}

/// Unknowns per camera: position and rotation.
const STILL: usize = 6;
/// Unknowns per camera with a rolling shutter: also the bend.
const ROLLING: usize = 9;

/// Maximum ratio of a point's distances to its cameras. Beyond it the point is a mismatch, dominated by rounding.
const BEFORE_THE_NOSE: f64 = 1e4;
/// Maximum number of parts, more than the threads of most lab machines. Each part has a matrix of size^2 / 2 numbers.
const PARTS: usize = 16;
/// Maximum memory of all matrices: 300 images need 30 MB each. [bytes]
const PARTS_BYTES: usize = 1 << 29;
