//! Estimates errors of the lab's setup during flight. Sans-IO.
//!
//! Input: for each set of images, the reprojection errors of the corners and their derivatives by the pose and by
//! possible errors of the setup. Output: corrections, their contribution to the pose's covariance, and findings for the
//! operator. Called once per set; evaluated ten times per second.
//!
//! The pose of each set is eliminated, as in [`crate::bundle`]. This leaves normal equations of the lasting parameters:
//! clock, readout, position and direction of each camera, and the scale of the tags. Each parameter has a prior around
//! zero error. The prior is as narrow as a correct setup allows, and is widened to the estimate until it explains the
//! corners (MacKay 1992, "Bayesian interpolation", section 4: the evidence chooses the prior). Parameters that images
//! do not determine stay uncertain, which the pose's covariance includes. For example, if two cameras disagree, either
//! may have been moved, unless one sees tags of the room.
//!
//! Only differences between clocks are observable. A stamp is never earlier than its exposure, so the camera with the
//! least delay is the reference.

mod finding;
mod normal;

pub use finding::Finding;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Frame, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::bundle::matrix::Symmetric;
use crate::solve::{CornerRow, Sighting, VehicleTwist, corner_rows};
use normal::{Normal, eliminate, times, unknowns};

/// Estimated errors of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Correction {
    /// Delay of the image's stamp after the exposure. [s]
    pub(super) late_s: f64,
    /// Time from the exposure of the first row to that of the last row. [s]
    pub(super) readout_s: f64,
    /// Displacement from the position in the camera's file. [m, world or body]
    pub(super) moved_m: DVec3,
    /// Rotation from the orientation in the file, about the camera's axes. [rad, cam]
    pub(super) turned_rad: DVec3,
}

impl Correction {
    /// Returns the corrected pose of a camera, from the pose in its file.
    pub(super) fn apply<A: Frame, B: Frame>(&self, pose: &Pose<A, B>) -> Pose<A, B> {
        let turn = DQuat::from_scaled_axis(self.turned_rad);
        Pose::new(pose.translation_m + self.moved_m, (pose.rotation * turn).normalize())
    }
}

/// Linearized corners of a set of images at its pose.
pub(super) struct Linear {
    rows: Vec<(usize, f64, CornerRow)>,
}

impl Linear {
    /// Returns the derivatives of the corners by all parameters; `None` if a corner is behind its camera. `cameras` are
    /// the cameras of the sightings.
    pub(super) fn at(
        sightings: &[Sighting],
        cameras: &[usize],
        motion: &VehicleTwist,
        pose: &Pose<World, Body>,
        middle_m: DVec3,
    ) -> Option<Self> {
        let mut rows = Vec::with_capacity(4 * sightings.len());
        for (sighting, &camera) in sightings.iter().zip(cameras) {
            let corners = corner_rows(sighting, motion, pose, middle_m)?;
            rows.extend(corners.map(|row| (camera, sighting.sigma_px, row)));
        }
        Some(Self { rows })
    }
}

/// Estimator of setup errors.
#[derive(Debug)]
pub(super) struct Monitor {
    cameras: usize,
    /// Normal equations of the last seconds of motion (`long`) and of the last moment (`short`).
    long: Normal,
    short: Normal,
    /// Stamps of the last set and of the last evaluation.
    learnt: Option<HostTime>,
    judged: Option<HostTime>,
    /// Estimated errors, as applied.
    wrong: Vec<f64>,
    /// Covariance of `wrong`; the prior before the first evaluation.
    covariance: Symmetric,
    /// Variance of each parameter's prior, and its minimum.
    prior: Vec<f64>,
    floors: Vec<f64>,
    /// Camera with the reference clock.
    on_time: usize,
}

impl Monitor {
    /// Makes a monitor. `sigmas` are the position [m] and rotation [rad] sigma per axis of each camera's pose. With
    /// `is_measure` the tags define the scale, and their size is not estimated.
    pub(super) fn new(sigmas: &[(f64, f64)], is_measure: bool) -> Self {
        let cameras = sigmas.len();
        let size = EACH * cameras + 1;
        let floor = |i: usize| match (kind(i, size), sigmas.get(i / EACH)) {
            (PLACE, Some((sigma_m, _))) => *sigma_m,
            (TURN, Some((_, sigma_rad))) => *sigma_rad,
            (kind, _) => FLOORS[kind],
        };
        let first = |kind| if is_measure && kind == EACH { 0.0 } else { FIRST[kind] };
        let floors: Vec<f64> = (0..size).map(|i| floor(i).powi(2)).collect();
        let prior: Vec<f64> =
            (0..size).map(|i| floors[i].max(first(kind(i, size)).powi(2))).collect();
        let mut covariance = Symmetric::zero(size);
        for (i, variance) in prior.iter().enumerate() {
            covariance.add(i, i, *variance);
        }
        Self {
            cameras,
            long: Normal::empty(size),
            short: Normal::empty(size),
            learnt: None,
            judged: None,
            wrong: vec![0.0; size],
            covariance,
            prior,
            floors,
            on_time: 0,
        }
    }

    /// Returns the estimated errors of a camera.
    pub(super) fn correction(&self, camera: usize) -> Correction {
        let own = &self.wrong[EACH * camera..][..EACH];
        Correction {
            late_s: own[LATE],
            readout_s: own[READOUT],
            moved_m: DVec3::new(own[PLACE], own[PLACE + 1], own[PLACE + 2]),
            turned_rad: DVec3::new(own[TURN], own[TURN + 1], own[TURN + 2]),
        }
    }

    /// Returns the ratio of the tags' true size to the size in their layout.
    pub(super) fn scale(&self) -> f64 {
        1.0 + self.wrong[EACH * self.cameras]
    }

    /// Adds a set of images at its pose.
    pub(super) fn learn(&mut self, stamp: HostTime, set: &Linear, motion: &VehicleTwist) {
        let dt_s = self.learnt.map_or(0.0, |learnt| stamp.seconds_since(learnt).clamp(0.0, 1.0));
        self.learnt = self.learnt.max(Some(stamp));
        // A vehicle that stands still gives no information about clocks and scale, so earlier information does not
        // decay.
        let moves = (motion.v_world_mps.length() / MOVES_MPS).min(1.0);
        self.long.keep((-dt_s * moves / LONG_S).exp());
        self.short.keep((-dt_s / SHORT_S).exp());
        let mut added = Normal::empty(self.wrong.len());
        if added.add_set(set, &self.wrong) {
            self.long.add(&added);
            self.short.add(&added);
        }
    }

    /// Adds tags of the room in the image of a fixed camera.
    pub(super) fn anchor(&mut self, camera: usize, set: &Linear) {
        let sigma = ANCHOR_SIGMAS;
        for normal in [&mut self.long, &mut self.short] {
            for (_, sigma_px, row) in &set.rows {
                let unknowns = unknowns(camera, row, self.cameras);
                for axis in 0..2 {
                    let weight = (sigma * sigma_px).powi(-2);
                    let mut value = -row.off_px[axis];
                    let own = &unknowns[PLACE..TURN + 3];
                    for (at, by) in own {
                        value += by[axis] * self.wrong[*at];
                    }
                    for (i, (row, by_row)) in own.iter().enumerate() {
                        normal.right[*row] += weight * by_row[axis] * value;
                        for (column, by_column) in &own[..=i] {
                            normal.matrix.add(
                                *row,
                                *column,
                                weight * by_row[axis] * by_column[axis],
                            );
                        }
                    }
                    normal.square += weight * value * value;
                }
            }
        }
    }

    /// Updates the estimate, if the interval has elapsed.
    pub(super) fn judge(&mut self, stamp: HostTime) {
        if self.judged.is_some_and(|judged| stamp.seconds_since(judged).abs() < JUDGE_S) {
            return;
        }
        self.judged = Some(stamp);
        if self.short.count > LEAST_ROWS {
            let long = self.long.solve(&self.prior, self.on_time);
            let short = self.short.solve(&self.prior, self.on_time);
            if let (Some((long, _)), Some((short, _))) = (long, short) {
                let (old, new) = (self.short.cost(&long), self.short.cost(&short));
                // The earlier estimate does not explain the latest images: the setup changed.
                if old > CHANGED * new.max(0.1 * self.short.count) {
                    self.long = self.short.clone();
                }
            }
        }
        for _ in 0..ROUNDS {
            let Some((wrong, covariance)) = self.long.solve(&self.prior, self.on_time) else {
                return;
            };
            self.widen(&wrong, &covariance);
            (self.wrong, self.covariance) = (wrong, covariance);
            let late: Vec<f64> =
                (0..self.cameras).map(|camera| self.wrong[EACH * camera + LATE]).collect();
            if let Some(first) = (0..self.cameras).min_by(|&a, &b| late[a].total_cmp(&late[b]))
                && late[first]
                    < -(FLOORS[LATE] + 3.0 * self.covariance.at(EACH * first, EACH * first).sqrt())
            {
                self.on_time = first;
                // Clock differences to the other cameras stay the same.
                let by_s = late[first];
                for camera in 0..self.cameras {
                    self.wrong[EACH * camera + LATE] -= by_s;
                    let variance = &mut self.prior[EACH * camera + LATE];
                    *variance = variance.max(self.wrong[EACH * camera + LATE].powi(2));
                }
            }
        }
    }

    /// Sets the priors to the estimated errors, but not below their minimum.
    fn widen(&mut self, wrong: &[f64], covariance: &Symmetric) {
        let size = wrong.len();
        let mut i = 0;
        while i < size {
            // A rotated camera is also displaced: position and rotation share one factor.
            let together = if kind(i, size) == PLACE { EACH - PLACE } else { 1 };
            let found: f64 = (i..i + together)
                .map(|i| (wrong[i].powi(2) + covariance.at(i, i)) / self.floors[i])
                .sum::<f64>()
                / together as f64;
            for i in i..i + together {
                let ceiling = CEILINGS[kind(i, size)].powi(2);
                self.prior[i] = (found.max(1.0) * self.floors[i]).min(ceiling);
            }
            i += together;
        }
    }

    /// Returns the contribution of the uncertain parameters to the covariance of a set's pose. [m, world; rad, body]
    pub(super) fn spread(&self, set: &Linear) -> [[f64; 6]; 6] {
        let zero = [[0.0; 6]; 6];
        let Some((inverse, across)) =
            eliminate(set, self.wrong.len(), |sigma_px, _| sigma_px.powi(-2))
        else {
            return zero;
        };
        // Derivative of the pose by the parameters.
        let by: Vec<[f64; 6]> = across.iter().map(|column| times(&inverse, column)).collect();
        let mut spread = zero;
        for (i, by_i) in by.iter().enumerate() {
            for (j, by_j) in by.iter().enumerate() {
                let value = self.covariance.at(i.max(j), i.min(j));
                if value != 0.0 {
                    for a in 0..6 {
                        for b in 0..6 {
                            spread[a][b] += by_i[a] * value * by_j[b];
                        }
                    }
                }
            }
        }
        spread
    }

    /// Returns the findings for the operator. `places` transform from the cameras' axes to the outer ones.
    pub(super) fn findings(&self, places: &[glam::DAffine3]) -> Vec<Finding> {
        let mut found = Vec::new();
        let sure = |i: usize, least: f64| {
            let value = self.wrong[i].abs();
            value > least && value > SURE_SIGMAS * self.covariance.at(i, i).sqrt()
        };
        let mut moved = Vec::new();
        for camera in 0..self.cameras {
            let at = EACH * camera;
            let Correction { late_s, readout_s, moved_m, turned_rad } = self.correction(camera);
            if sure(at + LATE, LATE_S) {
                found.push(Finding::Late { camera, late_s });
            }
            if sure(at + READOUT, READOUT_S) {
                found.push(Finding::RollingShutter { camera, readout_s });
            }
            if self.surprise(&(at + PLACE..at + TURN + 3).collect::<Vec<_>>()) > MOVED_SURPRISE
                && (moved_m.length() > MOVED_M || turned_rad.length() > TURNED_RAD)
            {
                let (moved_m, turned_rad) = (moved_m.length(), turned_rad.length());
                moved.push(Finding::Moved { cameras: vec![camera], moved_m, turned_rad });
            }
        }
        if moved.is_empty() {
            moved.extend(self.moved_against_another(places));
        }
        found.extend(moved);
        if sure(EACH * self.cameras, SCALE) {
            found.push(Finding::Scale { scale: self.scale() });
        }
        found
    }

    /// Returns the pair of cameras that disagree most, if no single camera is known to have moved.
    fn moved_against_another(&self, places: &[glam::DAffine3]) -> Option<Finding> {
        let mut most: Option<(f64, Finding)> = None;
        for a in 0..self.cameras {
            for b in 0..a {
                let both = [a, b].map(|camera| EACH * camera + PLACE..EACH * camera + TURN + 3);
                let surprise = self.surprise(&both.into_iter().flatten().collect::<Vec<_>>());
                let (one, other) = (self.correction(a), self.correction(b));
                // If the other camera has not moved, this one moved by this.
                let turn = places[b].transform_vector3(other.turned_rad);
                let arm_m = places[a].translation - places[b].translation;
                let moved_m = (one.moved_m - other.moved_m - turn.cross(arm_m)).length();
                let turned = one.turned_rad - places[a].matrix3.transpose() * turn;
                let turned_rad = turned.length();
                if surprise > MOVED_SURPRISE
                    && (moved_m > MOVED_M || turned_rad > TURNED_RAD)
                    && most.as_ref().is_none_or(|(before, _)| surprise > *before)
                {
                    let cameras = vec![b, a];
                    most = Some((surprise, Finding::Moved { cameras, moved_m, turned_rad }));
                }
            }
        }
        most.map(|(_, finding)| finding)
    }

    /// Returns the squared distance of parameters from zero, in sigmas (Mahalanobis).
    fn surprise(&self, unknowns: &[usize]) -> f64 {
        let mut part = Symmetric::zero(unknowns.len());
        for (i, row) in unknowns.iter().enumerate() {
            for (j, column) in unknowns[..=i].iter().enumerate() {
                part.add(i, j, self.covariance.at(*row.max(column), *row.min(column)));
            }
        }
        let values: Vec<f64> = unknowns.iter().map(|&i| self.wrong[i]).collect();
        part.solve(&values).map_or(0.0, |x| x.iter().zip(&values).map(|(a, b)| a * b).sum())
    }
}

/// Returns the kind of a parameter: an offset within a camera's parameters, or [`EACH`] for the scale.
fn kind(i: usize, size: usize) -> usize {
    match i % EACH {
        _ if i + 1 == size => EACH,
        k if k >= TURN => TURN,
        k if k >= PLACE => PLACE,
        k => k,
    }
}

/// Number of parameters per camera, and offsets of each kind.
const EACH: usize = 8;
const LATE: usize = 0;
const READOUT: usize = 1;
const PLACE: usize = 2;
const TURN: usize = 5;
/// Minimum sigma of a parameter by kind, valid for a correct setup: stamps and shutters a fraction of a millisecond,
/// the ruler's reading hundredths of a millimetre. For cameras it comes from their survey.
const FLOORS: [f64; EACH + 1] = [2e-4, 5e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-4];
/// Initial sigma, before the first set.
const FIRST: [f64; EACH + 1] = [1e-2, 1e-2, 2e-3, 0.0, 0.0, 7e-4, 0.0, 0.0, 7e-3];
/// Maximum sigma: half a second for clocks, one image interval for the readout, a displacement that still allows
/// detection for cameras.
const CEILINGS: [f64; EACH + 1] = [0.5, 0.05, 0.5, 0.0, 0.0, 0.2, 0.0, 0.0, 0.2];
/// Factor on the sigma of the room's tags. They are measured 3 times per second over [`LONG_S`], always with the same
/// error of survey and lens, so all measurements together count as one.
const ANCHOR_SIGMAS: f64 = 8.0;
/// Time constant of the long memory, counting only motion at [`MOVES_MPS`] or faster. [s]
const LONG_S: f64 = 8.0;
/// Speed at which the long memory decays at its full rate. [m/s]
const MOVES_MPS: f64 = 0.3;
/// Time constant of the short memory. [s]
const SHORT_S: f64 = 0.5;
/// Minimum number of residuals in the short memory to detect a change.
const LEAST_ROWS: f64 = 20.0;
/// Factor between the squared residuals of the earlier estimate and the new one that means a change.
const CHANGED: f64 = 4.0;
/// Interval of evaluations. [s]
const JUDGE_S: f64 = 0.1;
/// Number of rounds that widen the priors in each evaluation.
const ROUNDS: usize = 4;
/// Minimum delay of stamps in a finding. [s]
const LATE_S: f64 = 3e-3;
/// Minimum readout time in a finding. [s]
const READOUT_S: f64 = 4e-3;
/// Minimum displacement of a camera in a finding. [m]
const MOVED_M: f64 = 0.008;
/// Minimum rotation of a camera in a finding. [rad]
const TURNED_RAD: f64 = 0.003;
/// Minimum deviation of the tags' size in a finding, as a share of the size.
const SCALE: f64 = 0.007;
/// Minimum ratio of a reported value to its sigma.
const SURE_SIGMAS: f64 = 4.0;
/// Minimum squared ratio of the six pose parameters of a camera.
const MOVED_SURPRISE: f64 = 40.0;
