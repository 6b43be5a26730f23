//! Bundle adjustment: estimates lenses, poses of tags and cameras, and poses of single views together, by
//! Levenberg-Marquardt over the reprojection errors of corners.
//!
//! A corner is projected as `lens(left * right * point)`. Each problem defines which factors are fixed, shared by many
//! views, or belong to one view:
//!
//! | | lens | left | right | point |
//! |---|---|---|---|---|
//! | calibrate | free | `cam_from_board`, of one view | fixed | corner of the board |
//! | survey a mat | fixed | `cam_from_world`, of one view | `world_from_tag`, shared | corner of the tag |
//! | survey cameras | fixed | `cam_from_world`, shared | `world_from_body`, of one view | corner of the cube |
//!
//! Poses of views are eliminated (Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6.1): each is
//! connected to few of the others, which leaves a dense system of lenses and shared poses. A Cauchy loss reduces the
//! weight of misread tags. A hundred tags in three hundred views take some seconds.

mod lens;
pub(crate) mod matrix;
mod normal;

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Frame, Intrinsics, Pose};

pub(crate) use lens::LENS;
use lens::project;
use matrix::Symmetric;
use normal::{Normal, ViewNormal};

/// A pose without frames, which depend on the problem.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rigid {
    pub(crate) t_m: DVec3,
    pub(crate) q: DQuat,
}

impl Rigid {
    pub(crate) const IDENTITY: Self = Self { t_m: DVec3::ZERO, q: DQuat::IDENTITY };

    pub(crate) fn apply(&self, p_m: DVec3) -> DVec3 {
        self.q * p_m + self.t_m
    }

    /// Returns the pose, moved along the outer frame's axes and rotated about its own axes.
    fn moved(&self, change: &[f64]) -> Self {
        let turn = DVec3::new(change[3], change[4], change[5]);
        Self {
            t_m: self.t_m + DVec3::new(change[0], change[1], change[2]),
            q: (self.q * DQuat::from_scaled_axis(turn)).normalize(),
        }
    }
}

impl<A: Frame, B: Frame> From<Pose<A, B>> for Rigid {
    fn from(pose: Pose<A, B>) -> Self {
        Self { t_m: pose.translation_m, q: pose.rotation }
    }
}

impl<A: Frame, B: Frame> From<Rigid> for Pose<A, B> {
    fn from(rigid: Rigid) -> Self {
        Self::new(rigid.t_m, rigid.q)
    }
}

/// Role of a pose in the problem.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Parameter {
    /// A constant pose.
    Fixed,
    /// One pose shared by many views: a tag of a mat, a camera in the room.
    Shared,
    /// The pose of one view. A corner depends on at most one of these.
    View,
}

/// Detection of a corner in an image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CornerObservation {
    pub(crate) lens: usize,
    pub(crate) left: usize,
    pub(crate) right: usize,
    pub(crate) point_m: DVec3,
    pub(crate) pixel: DVec2,
}

/// The problem, and after [`Bundle::solve`] the solution.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bundle {
    /// Lenses, and whether each is estimated.
    pub(crate) lenses: Vec<(Intrinsics, bool)>,
    pub(crate) poses: Vec<(Rigid, Parameter)>,
    pub(crate) seen: Vec<CornerObservation>,
    /// Distance at which a corner has half the weight. [px]
    pub(crate) loss_px: f64,
}

/// Accuracy of a solution.
#[derive(Clone, Debug)]
pub(crate) struct Solution {
    /// Root mean square residual of corners with at least half the weight. [px]
    pub(crate) rms_px: f64,
    /// Root mean square residual of all corners. [px]
    pub(crate) all_rms_px: f64,
    /// Share of corners with less than half the weight: misread tags, or a wrong model.
    pub(crate) outliers: f64,
    /// Covariance of the shared parameters: lenses, then shared poses, in the bundle's order.
    covariance: Symmetric,
    /// Offset of each pose in the covariance.
    place: Vec<UnknownBlock>,
}

impl Solution {
    /// Returns the standard deviation of each parameter of a lens: fx, fy, cx, cy [px], then distortion coefficients.
    pub(crate) fn lens_sigma(&self, free_lens: usize) -> [f64; LENS] {
        std::array::from_fn(|i| {
            self.covariance.at(free_lens * LENS + i, free_lens * LENS + i).sqrt()
        })
    }

    /// Returns the standard deviation of a shared pose's position, along the axes of its outer frame; zero for a fixed
    /// one. [m]
    pub(crate) fn position_sigma_m(&self, pose: usize) -> DVec3 {
        match self.place[pose] {
            UnknownBlock::Shared(at) => {
                let sigma = |i: usize| self.covariance.at(at + i, at + i).max(0.0).sqrt();
                DVec3::new(sigma(0), sigma(1), sigma(2))
            }
            UnknownBlock::Fixed | UnknownBlock::View(_) => DVec3::ZERO,
        }
    }
}

/// Position of a pose's six parameters in the normal equations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum UnknownBlock {
    Fixed,
    Shared(usize),
    View(usize),
}

impl Bundle {
    /// Adds a pose and returns its index.
    pub(crate) fn pose(&mut self, pose: impl Into<Rigid>, role: Parameter) -> usize {
        self.poses.push((pose.into(), role));
        self.poses.len() - 1
    }

    /// Returns the residual of a corner: projected minus detected position. `None` behind the camera.
    pub(crate) fn residual(&self, seen: &CornerObservation) -> Option<DVec2> {
        let (left, right) = (&self.poses[seen.left].0, &self.poses[seen.right].0);
        let p_cam = left.apply(right.apply(seen.point_m));
        Some(project(&self.lenses[seen.lens].0, p_cam)?.pixel - seen.pixel)
    }

    /// Returns the depth of a corner. [m, cam]
    pub(crate) fn depth_m(&self, seen: &CornerObservation) -> f64 {
        self.poses[seen.left].0.apply(self.poses[seen.right].0.apply(seen.point_m)).z
    }

    /// Computes the nearest minimum; `None` if the corners do not determine one.
    pub(crate) fn solve(&mut self) -> Option<Solution> {
        let places = self.places();
        let mut normal = self.normal(&places);
        let mut damping = 1e-3;
        for _ in 0..MAX_ROUNDS {
            let Some((shared, views)) = normal.step(damping) else {
                damping *= 10.0;
                if damping > GIVE_UP {
                    return None;
                }
                continue;
            };
            let moved = self.moved(&places, &shared, &views);
            let cost = moved.cost();
            if cost <= normal.cost {
                let gained = normal.cost - cost;
                let settled = gained <= 1e-9 * cost;
                self.lenses = moved.lenses;
                self.poses = moved.poses;
                normal = self.normal(&places);
                damping = (damping * 0.2).max(1e-12);
                if settled {
                    break;
                }
            } else {
                damping *= 8.0;
                if damping > GIVE_UP {
                    break;
                }
            }
        }
        let mut reduced = normal.reduced(0.0)?.0;
        let covariance = reduced.invert().then_some(reduced)?;
        let (mut sum, mut count, mut all) = (0.0, 0, 0.0);
        for seen in &self.seen {
            let off_px = self.residual(seen).map_or(BEHIND_PX, DVec2::length);
            all += off_px * off_px;
            if off_px <= self.loss_px {
                sum += off_px * off_px;
                count += 1;
            }
        }
        if count == 0 {
            return None;
        }
        let unknowns = normal.shared + 6 * normal.views.len();
        let freedom = (2 * count as usize).saturating_sub(unknowns).max(1);
        // Variance along one axis of the image.
        let variance_px2 = sum / freedom as f64;
        let rms_px = (sum / f64::from(count)).sqrt();
        let total = self.seen.len() as f64;
        Some(Solution {
            rms_px,
            all_rms_px: (all / total).sqrt(),
            outliers: 1.0 - f64::from(count) / total,
            covariance: covariance.scaled(variance_px2),
            place: places.place,
        })
    }

    fn places(&self) -> Places {
        let mut shared = LENS * self.lenses.iter().filter(|(_, free)| *free).count();
        let mut views = 0;
        let place = self
            .poses
            .iter()
            .map(|(_, role)| match role {
                Parameter::Fixed => UnknownBlock::Fixed,
                Parameter::Shared => {
                    shared += 6;
                    UnknownBlock::Shared(shared - 6)
                }
                Parameter::View => {
                    views += 1;
                    UnknownBlock::View(views - 1)
                }
            })
            .collect();
        let mut free = 0;
        let lens = self
            .lenses
            .iter()
            .map(|(_, is_free)| {
                is_free.then(|| {
                    free += LENS;
                    free - LENS
                })
            })
            .collect();
        Places { lens, place, shared, views }
    }

    /// Returns the cost of all corners: Cauchy loss. [px^2]
    pub(crate) fn cost(&self) -> f64 {
        self.seen.iter().map(|seen| self.loss(self.residual(seen))).sum()
    }

    /// Returns the cost of a corner: Cauchy loss. A corner behind the camera counts as far off.
    fn loss(&self, residual: Option<DVec2>) -> f64 {
        let c2 = self.loss_px * self.loss_px;
        let r2 = residual.map_or(BEHIND_PX * BEHIND_PX, DVec2::length_squared);
        c2 * (r2 / c2).ln_1p()
    }

    fn moved(&self, places: &Places, shared: &[f64], views: &[[f64; 6]]) -> Self {
        let mut moved = self.clone();
        for ((lens, _), place) in moved.lenses.iter_mut().zip(&places.lens) {
            if let Some(at) = *place {
                *lens = lens::moved(lens, &shared[at..at + LENS]);
            }
        }
        for ((pose, _), place) in moved.poses.iter_mut().zip(&places.place) {
            match *place {
                UnknownBlock::Fixed => {}
                UnknownBlock::Shared(at) => *pose = pose.moved(&shared[at..at + 6]),
                UnknownBlock::View(view) => *pose = pose.moved(&views[view]),
            }
        }
        moved
    }

    /// Returns the normal equations at the present poses.
    fn normal(&self, places: &Places) -> Normal {
        let mut normal = Normal {
            shared: places.shared,
            matrix: Symmetric::zero(places.shared),
            gradient: vec![0.0; places.shared],
            views: vec![ViewNormal::default(); places.views],
            cost: 0.0,
        };
        let c2 = self.loss_px * self.loss_px;
        for seen in &self.seen {
            let (left, right) = (&self.poses[seen.left].0, &self.poses[seen.right].0);
            let inner_m = right.apply(seen.point_m);
            let Some(projected) = project(&self.lenses[seen.lens].0, left.apply(inner_m)) else {
                normal.cost += self.loss(None);
                continue;
            };
            let residual = projected.pixel - seen.pixel;
            normal.cost += self.loss(Some(residual));
            let weight = 1.0 / (1.0 + residual.length_squared() / c2);
            let left_axes = DMat3::from_quat(left.q);
            let by_left =
                columns(&projected.by_point, DMat3::IDENTITY, left_axes * cross(inner_m) * -1.0);
            let right_axes = left_axes * DMat3::from_quat(right.q);
            let by_right =
                columns(&projected.by_point, left_axes, right_axes * cross(seen.point_m) * -1.0);
            // (offset, derivatives) of the shared parameters, and of the view.
            let mut shared: [(usize, &[DVec2]); 3] = [(0, &[]); 3];
            let mut view: Option<(usize, &[DVec2; 6])> = None;
            if let Some(at) = places.lens[seen.lens] {
                shared[0] = (at, &projected.by_lens);
            }
            for (i, (pose, derivatives)) in
                [(seen.left, &by_left), (seen.right, &by_right)].into_iter().enumerate()
            {
                match places.place[pose] {
                    UnknownBlock::Fixed => {}
                    UnknownBlock::Shared(at) => shared[i + 1] = (at, derivatives),
                    UnknownBlock::View(number) => view = Some((number, derivatives)),
                }
            }
            normal.add(&shared, view, residual, weight);
        }
        normal
    }
}

struct Places {
    lens: Vec<Option<usize>>,
    place: Vec<UnknownBlock>,
    shared: usize,
    views: usize,
}

/// Returns the matrix that maps `v` to `p x v`.
fn cross(p: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, p.z, -p.y),
        DVec3::new(-p.z, 0.0, p.x),
        DVec3::new(p.y, -p.x, 0.0),
    )
}

/// Returns the derivatives of the pixel by a pose's position and rotation, from those by the point.
fn columns(by_point: &[DVec2; 3], by_position: DMat3, by_turn: DMat3) -> [DVec2; 6] {
    let through = |v: DVec3| by_point[0] * v.x + by_point[1] * v.y + by_point[2] * v.z;
    std::array::from_fn(|i| through(if i < 3 { by_position.col(i) } else { by_turn.col(i - 3) }))
}

/// Maximum number of iterations, far more than a converging problem needs.
const MAX_ROUNDS: usize = 100;
/// Damping at which the solver gives up.
const GIVE_UP: f64 = 1e9;
/// Residual of a corner behind its camera. [px]
const BEHIND_PX: f64 = 1e4;

#[cfg(test)]
mod tests;
