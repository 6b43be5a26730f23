//! The normal equations of everything but the points, which are eliminated as they come (Triggs et al. 2000, "Bundle
//! adjustment: a modern synthesis", section 6.1).

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::capture::Capture;
use super::matrix::{Symmetric, inverse};
use super::project::{LENS, Projected};
use super::solve::{INSET_PX, Problem, weight};
use super::state::{Slopes, State, TagPlace, inwards, slopes};

/// Matrix and gradient, and what it all costs.
pub(super) struct Normal {
    pub(super) matrix: Symmetric,
    pub(super) gradient: Vec<f64>,
}

/// Where the unknowns stand.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// `None` if the lens is given.
    pub(super) lens: Option<usize>,
    /// `None` if there are no tags.
    pub(super) inset: Option<usize>,
    /// Of each tag; `None` of one that is not to be found.
    pub(super) tags: Vec<Option<usize>>,
    pub(super) size: usize,
}

impl Layout {
    pub(super) fn new(state: &State, refine_lens: bool) -> Self {
        let mut size = 6 * state.cameras.len();
        let lens = refine_lens.then_some(size);
        size += if refine_lens { LENS } else { 0 };
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
        Self { lens, inset, tags, size }
    }

    /// Returns it without the unknowns of some tags.
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

    /// Adds one residual whose derivatives by a few blocks of unknowns, ascending, are given.
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

    /// Makes steps along a direction of all unknowns cost something.
    pub(super) fn hold(&mut self, direction: &[f64], weight: f64) {
        for (row, a) in direction.iter().enumerate().filter(|(_, a)| **a != 0.0) {
            for (column, b) in direction[..=row].iter().enumerate() {
                self.matrix.add(row, column, weight * a * b);
            }
        }
    }
}

/// One sighting of a point, with its derivatives times the root of its weight.
struct Seen {
    camera: usize,
    by_camera: [DVec2; 6],
    by_lens: [DVec2; LENS],
    by_point: [DVec2; 3],
    residual: DVec2,
}

/// A point's own part of the equations.
struct PointPart {
    inverse: DMat3,
    gradient: DVec3,
    seen: Vec<Seen>,
}

/// Returns it; `None` where its sightings do not place it, or it is seen by fewer than two.
fn part(problem: &Problem, state: &State, point: usize, damping: f64) -> Option<PointPart> {
    let sightings = problem.sightings(point);
    let mut seen = Vec::with_capacity(sightings.len());
    let (mut matrix, mut gradient) = (DMat3::ZERO, DVec3::ZERO);
    for &(camera, pixel) in sightings {
        let Some((projected, p_cam)) = state.see(camera, state.points[point]) else { continue };
        let residual = projected.pixel - pixel;
        let root = problem.noise.point_weight(residual).sqrt();
        let Projected { by_point, by_lens, .. } = projected;
        let Slopes { by_camera, by_point } = slopes(&state.cameras[camera], &by_point, p_cam);
        let one = Seen {
            camera,
            by_camera: by_camera.map(|d| d * root),
            by_lens: by_lens.map(|d| d * root),
            by_point: by_point.map(|d| d * root),
            residual: residual * root,
        };
        let [x, y, z] = one.by_point;
        let row = |a: DVec2| DVec3::new(a.dot(x), a.dot(y), a.dot(z));
        matrix += DMat3::from_cols(row(x), row(y), row(z));
        gradient += row(one.residual);
        seen.push(one);
    }
    if seen.len() < 2 {
        return None;
    }
    for k in 0..3 {
        matrix.col_mut(k)[k] *= 1.0 + damping;
    }
    Some(PointPart { inverse: inverse(&matrix)?, gradient, seen })
}

/// Returns how each of the numbers changes with the point.
fn across<const N: usize>(by: &[DVec2; N], by_point: &[DVec2; 3]) -> [DVec3; N] {
    let [x, y, z] = *by_point;
    by.map(|d| DVec3::new(d.dot(x), d.dot(y), d.dot(z)))
}

fn products<const R: usize, const C: usize>(a: &[DVec3; R], b: &[DVec3; C]) -> [[f64; C]; R] {
    std::array::from_fn(|i| std::array::from_fn(|j| -a[i].dot(b[j])))
}

fn outer<const R: usize, const C: usize>(a: &[DVec2; R], b: &[DVec2; C]) -> [[f64; C]; R] {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i].dot(b[j])))
}

/// Returns the normal equations at a state, points eliminated with this damping of their own.
pub(super) fn normal(problem: &Problem, state: &State, damping: f64) -> Normal {
    let layout = &problem.layout;
    // Parts whose number does not depend on threads: sums are the same on any machine.
    let size = state.points.len().div_ceil(PARTS).max(1);
    let parts: Vec<Normal> = (0..PARTS)
        .into_par_iter()
        .map(|part| {
            let mut sum = Normal::zero(layout.size);
            let end = ((part + 1) * size).min(state.points.len());
            for point in (part * size).min(end)..end {
                add_point(&mut sum, problem, state, point, damping);
            }
            sum
        })
        .collect();
    let mut sum = Normal::zero(layout.size);
    for part in &parts {
        sum.matrix.add_all(&part.matrix);
        sum.gradient.iter_mut().zip(&part.gradient).for_each(|(sum, g)| *sum += g);
    }
    add_tags(&mut sum, problem, state);
    add_priors(&mut sum, problem.capture, problem, state);
    sum
}

fn add_point(sum: &mut Normal, problem: &Problem, state: &State, point: usize, damping: f64) {
    let Some(part) = part(problem, state, point, damping) else { return };
    let lens = problem.layout.lens;
    let mut lens_across = [DVec3::ZERO; LENS];
    let crossed: Vec<([DVec3; 6], [DVec3; 6])> = part
        .seen
        .iter()
        .map(|seen| {
            let across = across(&seen.by_camera, &seen.by_point);
            (across, across.map(|row| part.inverse * row))
        })
        .collect();
    for (one, (_, solved)) in part.seen.iter().zip(&crossed) {
        let row = 6 * one.camera;
        for i in 0..6 {
            sum.gradient[row + i] +=
                one.by_camera[i].dot(one.residual) - solved[i].dot(part.gradient);
        }
        sum.matrix.add_block(row, row, &outer(&one.by_camera, &one.by_camera));
        for (other, (across_b, _)) in part.seen.iter().zip(&crossed) {
            // The lower triangle of the matrix.
            if other.camera <= one.camera {
                sum.matrix.add_block(row, 6 * other.camera, &products(solved, across_b));
            }
        }
        if let Some(lens) = lens {
            sum.matrix.add_block(lens, row, &outer(&one.by_lens, &one.by_camera));
            sum.matrix.add_block(lens, lens, &outer(&one.by_lens, &one.by_lens));
            for i in 0..LENS {
                sum.gradient[lens + i] += one.by_lens[i].dot(one.residual);
            }
            let across = across(&one.by_lens, &one.by_point);
            lens_across.iter_mut().zip(across).for_each(|(sum, row)| *sum += row);
        }
    }
    if let Some(lens) = lens {
        let solved = lens_across.map(|row| part.inverse * row);
        for i in 0..LENS {
            sum.gradient[lens + i] -= solved[i].dot(part.gradient);
        }
        sum.matrix.add_block(lens, lens, &products(&solved, &lens_across));
        for (one, (across, _)) in part.seen.iter().zip(&crossed) {
            sum.matrix.add_block(lens, 6 * one.camera, &products(&solved, across));
        }
    }
}

fn add_tags(sum: &mut Normal, problem: &Problem, state: &State) {
    for &(camera, seen) in &problem.tags {
        let Some(corners_m) = state.corners_m(problem.capture, seen.tag) else { continue };
        let off_px = state.tag_off_px(camera, &corners_m, seen);
        let weight = problem.noise.tag_weight(off_px.unwrap_or(f64::MAX));
        for (k, (&corner_m, &pixel)) in corners_m.iter().zip(&seen.corners_px).enumerate() {
            let Some((projected, p_cam)) = state.see(camera, corner_m) else { continue };
            let inwards = inwards(seen)[k];
            let residual = projected.pixel + inwards * state.inset_px - pixel;
            let by = slopes(&state.cameras[camera], &projected.by_point, p_cam);
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
                let by_lens = projected.by_lens.map(|d| d[axis]);
                let by_tag = by_tag.map(|by| by.map(|d| d[axis]));
                let mut blocks: Vec<(usize, &[f64])> = vec![(6 * camera, &by_camera)];
                if let Some(lens) = problem.layout.lens {
                    blocks.push((lens, &by_lens));
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
                sum.add(&[(6 * camera, &by)], residual_m[axis], weight);
            }
        }
        if let Some(up) = image.up {
            let residual = pose.rotation * up.direction;
            let weight = weight(residual.truncate().length(), up.sigma_rad);
            let turn = DVec3::AXES.map(|axis| pose.rotation * axis.cross(up.direction));
            for axis in 0..2 {
                let mut by = [0.0; 6];
                (0..3).for_each(|k| by[3 + k] = turn[k][axis]);
                sum.add(&[(6 * camera, &by)], residual[axis], weight);
            }
        }
    }
}

/// Returns how points move, given the change of everything else.
pub(super) fn points_step(
    problem: &Problem,
    state: &State,
    change: &[f64],
    damping: f64,
) -> Vec<DVec3> {
    let step = |point: usize| {
        let Some(part) = part(problem, state, point, damping) else { return DVec3::ZERO };
        let mut right = part.gradient;
        for seen in &part.seen {
            let mut off = DVec2::ZERO;
            for (d, by) in seen.by_camera.iter().zip(&change[6 * seen.camera..]) {
                off += *d * *by;
            }
            if let Some(lens) = problem.layout.lens {
                for (d, by) in seen.by_lens.iter().zip(&change[lens..]) {
                    off += *d * *by;
                }
            }
            let [x, y, z] = seen.by_point;
            right += DVec3::new(x.dot(off), y.dot(off), z.dot(off));
        }
        -(part.inverse * right)
    };
    (0..state.points.len()).into_par_iter().map(step).collect()
}

/// More threads than any machine of a lab, less memory than the images took: each has a matrix.
const PARTS: usize = 16;
