//! Levenberg-Marquardt iteration, and weights of the sightings.

use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;
use vizflyt_protocol::geometry::Pose;

use super::capture::{Capture, TagSighting};
use super::matrix::Factor;
use super::normal::{Layout, Normal, normal, points_step};
use super::project::{LENS, moved};
use super::robust::{INSET_PX, loss, median, weight};
use super::rolling::{MOST_READOUT_S, READOUT_S};
use super::state::{State, TagPlace};
use super::{AdjustError, Known, Options};

/// The minimised problem.
pub(super) struct Problem<'a> {
    pub(super) capture: &'a Capture,
    pub(super) layout: Layout,
    pub(super) noise: Noise,
    /// Sightings of points as (camera, pixel), grouped by point.
    seen: Vec<(usize, DVec2)>,
    /// Start of each point's sightings in `seen`.
    starts: Vec<usize>,
    /// Sightings of tags that are used.
    pub(super) tags: Vec<(usize, &'a TagSighting)>,
}

/// Estimated standard deviations of sightings along an axis. The loss is Cauchy's, so errors above three sigmas have
/// little influence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Noise {
    pub(super) point_px: f64,
    pub(super) tag_px: f64,
    /// Ratio of the measured positions' actual to their claimed error; at least 1.
    pub(super) place_factor: f64,
    /// Rotation of a camera from the first row to the last, in addition to that from its velocity. [rad]
    pub(super) bend_rad: f64,
}

/// Result of the solver.
pub(super) struct Solved {
    pub(super) noise: Noise,
    pub(super) rounds: usize,
    pub(super) layout: Layout,
    /// Factor of the final normal equations; undetermined directions are held.
    pub(super) factor: Factor,
}

impl Noise {
    fn start(state: &State) -> Self {
        let bend_rad = state.rolling.bend_sigma_rad();
        Self { point_px: 1.0, tag_px: 0.5, place_factor: 1.0, bend_rad }
    }

    /// Limits the decrease of the sigmas since the last estimate.
    fn no_sharper_than(self, last: Self) -> Self {
        Self {
            point_px: self.point_px.max(SHARPER * last.point_px),
            tag_px: self.tag_px.max(SHARPER * last.tag_px),
            place_factor: self.place_factor.max(SHARPER * last.place_factor),
            bend_rad: self.bend_rad,
        }
    }

    fn is_like(self, last: Self) -> bool {
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 0.1;
        near(self.point_px, last.point_px)
            && near(self.tag_px, last.tag_px)
            && near(self.place_factor, last.place_factor)
            && near(self.bend_rad, last.bend_rad)
    }

    /// Returns 1 / sigma^2, reduced for outliers. [1/px^2]
    pub(super) fn point_weight(&self, off_px: DVec2) -> f64 {
        weight(off_px.length(), self.point_px)
    }

    pub(super) fn tag_weight(&self, rms_px: f64) -> f64 {
        weight(rms_px, self.tag_px)
    }

    pub(super) fn place_weight(&self, off_m: f64, sigma_m: f64) -> f64 {
        weight(off_m, sigma_m * self.place_factor)
    }
}

impl<'a> Problem<'a> {
    /// Creates a problem; sightings of the tags in `without` are ignored.
    pub(super) fn new(
        capture: &'a Capture,
        state: &State,
        refine_lens: bool,
        rolling: bool,
        without: &[usize],
    ) -> Self {
        let mut starts = vec![0usize; state.points.len() + 1];
        for seen in capture.images.iter().flat_map(|image| &image.seen) {
            starts[seen.point + 1] += 1;
        }
        for point in 0..state.points.len() {
            starts[point + 1] += starts[point];
        }
        let mut next = starts.clone();
        let mut seen = vec![(0, DVec2::ZERO); starts[state.points.len()]];
        let mut tags = Vec::new();
        for (camera, image) in capture.images.iter().enumerate() {
            for one in &image.seen {
                seen[next[one.point]] = (camera, one.pixel);
                next[one.point] += 1;
            }
            let counts = |seen: &&TagSighting| {
                !without.contains(&seen.tag) && !matches!(state.tags[seen.tag], TagPlace::Nowhere)
            };
            tags.extend(image.tags.iter().filter(counts).map(|seen| (camera, seen)));
        }
        // Tags without sightings have no unknowns.
        let layout = Layout::new(state, refine_lens, rolling).without(without);
        Self { capture, layout, noise: Noise::start(state), seen, starts, tags }
    }

    pub(super) fn sightings(&self, point: usize) -> &[(usize, DVec2)] {
        &self.seen[self.starts[point]..self.starts[point + 1]]
    }

    fn point_cost(&self, state: &State, point: usize) -> f64 {
        let sightings = self.sightings(point);
        let one = |&(camera, pixel): &(usize, DVec2)| {
            let off = state.off_px(camera, state.points[point], pixel);
            loss(off.map_or(BEHIND_PX, DVec2::length), self.noise.point_px)
        };
        if sightings.len() < 2 { 0.0 } else { sightings.iter().map(one).sum() }
    }

    /// Returns the cost of a state.
    pub(super) fn cost(&self, state: &State) -> f64 {
        let points: Vec<f64> = (0..state.points.len())
            .into_par_iter()
            .map(|point| self.point_cost(state, point))
            .collect();
        let mut sum: f64 = points.iter().sum();
        sum += (state.inset_px / INSET_PX).powi(2);
        if !self.layout.middle().is_empty() {
            sum += (state.off_middle_px() / state.middle_sigma_px()).length_squared();
        }
        if self.layout.readout().is_some() {
            sum += (state.rolling.readout_s / READOUT_S).powi(2);
            let bends = state.rolling.bends_rad.iter();
            sum += bends.map(|rad| (*rad / self.noise.bend_rad).length_squared()).sum::<f64>();
        }
        for &(camera, seen) in &self.tags {
            let corners = state.corners_m(self.capture, seen.tag);
            let off = corners.and_then(|corners| state.tag_off_px(camera, &corners, seen));
            // Four corners.
            sum += 4.0 * loss(off.unwrap_or(BEHIND_PX), self.noise.tag_px);
        }
        for (image, pose) in self.capture.images.iter().zip(&state.cameras) {
            if let Some(place) = image.place {
                let at_m = pose.transform_point(self.capture.tracked_in_cam_m);
                let sigma_m = place.sigma_m * self.noise.place_factor;
                sum += loss(at_m.distance(place.position_m), sigma_m);
            }
            if let Some(up) = image.up {
                let off = (pose.rotation * up.direction).truncate().length();
                sum += loss(off, up.sigma_rad);
            }
        }
        sum
    }

    /// Estimates the noise by medians, which a few outliers do not move.
    fn noise_of(&self, state: &State) -> Noise {
        let points = (0..state.points.len()).flat_map(|point| {
            let sightings = self.sightings(point);
            let many = if sightings.len() < 3 { &[] } else { sightings };
            // Three parameters of the point were fitted to its own sightings.
            let numbers = 2.0 * sightings.len() as f64;
            let went_in = (numbers / (numbers - 3.0)).sqrt();
            many.iter().filter_map(move |&(camera, pixel)| {
                Some(went_in * state.off_px(camera, state.points[point], pixel)?.length())
            })
        });
        let tags = self.tags.iter().filter_map(|&(camera, seen)| {
            state.tag_off_px(camera, &state.corners_m(self.capture, seen.tag)?, seen)
        });
        let places = self.capture.images.iter().zip(&state.cameras).filter_map(|(image, pose)| {
            let place = image.place?;
            let at_m = pose.transform_point(self.capture.tracked_in_cam_m);
            Some(at_m.distance(place.position_m) / place.sigma_m)
        });
        Noise {
            // Median length in sigmas: 1.18 for two normal numbers, 1.54 for three, 1.35 for the RMS of four corners.
            point_px: median(points).map_or(1.0, |px| (px / 1.18).max(LEAST_PX)),
            tag_px: median(tags).map_or(0.5, |px| (px / 1.35).max(LEAST_PX)),
            place_factor: median(places).map_or(1.0, |share| (share / 1.54).max(1.0)),
            bend_rad: state.rolling.bend_sigma_rad(),
        }
    }
}

/// Finds the nearest minimum, and stores it in the state.
pub(super) fn solve(
    capture: &Capture,
    state: &mut State,
    options: Options,
    known: Known,
) -> Result<Solved, AdjustError> {
    let mut problem = Problem::new(capture, state, options.refine_lens, options.rolling, &[]);
    let mut rounds = 0;
    // The noise is known only after a fit. Limit its decrease: weights that sharpen at once would reject sightings that
    // do not fit yet.
    for _ in 0..MAX_NOISES {
        state.rolling.follow(capture, &state.cameras);
        rounds += iterate(&problem, state, known, 1e-5)?;
        let last = problem.noise;
        problem.noise = problem.noise_of(state).no_sharper_than(last);
        if problem.noise.is_like(last) {
            break;
        }
    }
    rounds += iterate(&problem, state, known, 1e-8)?;
    let Normal { mut matrix, .. } =
        held(normal(&problem, state, ALMOST_NONE), state, &problem.layout, known);
    matrix.damp(ALMOST_NONE);
    let factor = matrix.factor().ok_or(AdjustError::Undetermined)?;
    Ok(Solved { noise: problem.noise, rounds, layout: problem.layout, factor })
}

/// Continues from a solution without the sightings of some tags.
pub(super) fn settle(
    capture: &Capture,
    state: &mut State,
    options: Options,
    known: Known,
    noise: Noise,
    without: &[usize],
) -> Result<usize, AdjustError> {
    let problem = Problem {
        noise,
        ..Problem::new(capture, state, options.refine_lens, options.rolling, without)
    };
    iterate(&problem, state, known, 1e-6)
}

/// Iterates until a round reduces the cost by less than a fraction; returns the number of rounds.
fn iterate(
    problem: &Problem,
    state: &mut State,
    known: Known,
    settle: f64,
) -> Result<usize, AdjustError> {
    let mut cost = problem.cost(state);
    let mut damping = 1e-4;
    for round in 1..=MAX_ROUNDS {
        let Normal { matrix, gradient } =
            held(normal(problem, state, damping), state, &problem.layout, known);
        let mut damped = matrix;
        damped.damp(damping);
        let tried = damped.factor().map(|factor| {
            let change = factor.solve(gradient.iter().map(|g| -g).collect());
            let points = points_step(problem, state, &change, damping);
            let next = stepped(state, &problem.layout, &change, &points);
            let cost = problem.cost(&next);
            (next, cost)
        });
        match tried {
            Some((next, less)) if less <= cost => {
                let settled = cost - less <= settle * less;
                *state = next;
                cost = less;
                damping = (damping * 0.2).max(1e-9);
                if settled {
                    return Ok(round);
                }
            }
            _ => {
                damping *= 8.0;
                if damping > GIVE_UP {
                    // If no step helps, this is a minimum, unless no step could be computed.
                    return if tried.is_some() {
                        Ok(round)
                    } else {
                        Err(AdjustError::Undetermined)
                    };
                }
            }
        }
    }
    Ok(MAX_ROUNDS)
}

/// Holds undetermined directions (shift, rotation and scale of everything) at their present value.
fn held(mut normal: Normal, state: &State, layout: &Layout, known: Known) -> Normal {
    if known.place {
        return normal;
    }
    // Mean over positions and rotations; other unknowns may have much larger weights.
    let cameras = (0..state.cameras.len()).map(|camera| layout.camera * camera);
    let mean: f64 = cameras.flat_map(|at| at..at + 6).map(|i| normal.matrix.diagonal(i)).sum();
    for direction in free_directions(state, layout, known) {
        let length2: f64 = direction.iter().map(|x| x * x).sum();
        normal.hold(&direction, mean / length2 / (6 * state.cameras.len()) as f64);
    }
    normal
}

/// Returns changes of all unknowns that leave the images unchanged.
fn free_directions(state: &State, layout: &Layout, known: Known) -> Vec<Vec<f64>> {
    let middle = middle_m(state);
    let make = |shift: &dyn Fn(DVec3) -> DVec3, turn: DVec3| {
        let mut direction = vec![0.0; layout.size];
        for (pose, block) in state.cameras.iter().zip(direction.chunks_mut(layout.camera)) {
            let by = shift(pose.translation_m - middle);
            let turned = pose.rotation.conjugate() * turn;
            block[..6].copy_from_slice(&[by.x, by.y, by.z, turned.x, turned.y, turned.z]);
        }
        direction
    };
    let mut all: Vec<Vec<f64>> =
        DVec3::AXES.into_iter().map(|axis| make(&|_| axis, DVec3::ZERO)).collect();
    let axes: &[DVec3] = if known.up { &[DVec3::Z] } else { &DVec3::AXES };
    all.extend(axes.iter().map(|&axis| make(&|arm| axis.cross(arm), axis)));
    if !known.scale {
        all.push(make(&|arm| arm, DVec3::ZERO));
    }
    all
}

/// Returns the centroid of all cameras. [m, world]
pub(super) fn middle_m(state: &State) -> DVec3 {
    let sum: DVec3 = state.cameras.iter().map(|pose| pose.translation_m).sum();
    sum / state.cameras.len() as f64
}

pub(super) fn stepped(state: &State, layout: &Layout, change: &[f64], points: &[DVec3]) -> State {
    let turned =
        |q: DQuat, by: &[f64]| (q * DQuat::from_scaled_axis(DVec3::from_slice(by))).normalize();
    let cameras = state.cameras.iter().zip(change.chunks(layout.camera)).map(|(pose, by)| {
        Pose::new(pose.translation_m + DVec3::from_slice(by), turned(pose.rotation, &by[3..6]))
    });
    let tags = state.tags.iter().zip(&layout.tags).map(|(tag, at)| match (*tag, *at) {
        (TagPlace::Found(t, q), Some(at)) => TagPlace::Found(
            t + DVec3::from_slice(&change[at..]),
            turned(q, &change[at + 3..at + 6]),
        ),
        (tag, _) => tag,
    });
    let mut rolling = state.rolling.clone();
    if let Some(at) = layout.readout() {
        let next_s = rolling.readout_s + change[at];
        rolling.readout_s = next_s.clamp(-MOST_READOUT_S, MOST_READOUT_S);
        for (bend, by) in rolling.bends_rad.iter_mut().zip(change.chunks(layout.camera)) {
            *bend += DVec3::from_slice(&by[6..]);
        }
    }
    let lens = layout.shared.map_or(state.lens, |at| {
        let by: [f64; LENS] = std::array::from_fn(|i| change[at + i]);
        moved(&state.lens, &by)
    });
    State {
        lens,
        cameras: cameras.collect(),
        rolling,
        points: state.points.iter().zip(points).map(|(p, by)| *p + *by).collect(),
        tags: tags.collect(),
        inset_px: state.inset_px + layout.inset.map_or(0.0, |at| change[at]),
        middle_px: state.middle_px,
        reach: state.reach,
    }
}

/// Maximum number of noise estimates: enough from one pixel to the minimum sigma.
const MAX_NOISES: usize = 8;
const SHARPER: f64 = 0.4;
/// Maximum number of rounds, far more than a converging problem takes.
const MAX_ROUNDS: usize = 60;
/// Damping above which no step will help.
const GIVE_UP: f64 = 1e8;
/// Damping that bounds undetermined unknowns, for example of an image with few points; determined ones are not
/// affected.
const ALMOST_NONE: f64 = 1e-8;
/// Error of a point behind its camera. [px]
const BEHIND_PX: f64 = 1e4;
/// Minimum sigma of sightings. [px]
const LEAST_PX: f64 = 0.02;
