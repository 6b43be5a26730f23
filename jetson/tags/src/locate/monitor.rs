//! What is wrong with the lab, estimated while the vehicle flies. Sans-IO.
//!
//! What enters: for each set of images, how far corners are from where the pose puts them, and how that changes with
//! the pose and with what may be wrong. What leaves: corrections, what they leave open of the pose, and findings
//! for people. Called once per set; judged ten times a second.
//!
//! The pose of each set is eliminated, as views are in [`crate::bundle`]; what is left are normal equations in what
//! lasts: of each camera its clock, its readout, its place and direction; the scale of the tags. Each has a prior
//! about "nothing is wrong", as narrow as things are when they are right, and widened to what is found until the
//! corners are explained (MacKay 1992, "Bayesian interpolation", section 4: the evidence chooses the prior). What
//! images cannot tell stays open, and the pose's covariance says so: of two cameras that disagree either may have
//! been moved, unless one sees tags of the room.
//!
//! Of clocks only differences can be known. A stamp is written after the exposure, never before: the camera that is
//! least late is taken to be right.

mod finding;
mod normal;

pub use finding::Finding;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Frame, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::bundle::matrix::Symmetric;
use crate::solve::{CornerRow, Sighting, VehicleTwist, corner_rows};
use normal::{Normal, eliminate, times, unknowns};

/// What is known to be wrong with a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Correction {
    /// How much later than the exposure its images are stamped. [s]
    pub(super) late_s: f64,
    /// From its first row's exposure to its last one's. [s]
    pub(super) readout_s: f64,
    /// How far it is from where its file has it. [m, world or body]
    pub(super) moved_m: DVec3,
    /// How far it is turned, about its own axes. [rad, cam]
    pub(super) turned_rad: DVec3,
}

impl Correction {
    /// Returns where a camera is whose file has it elsewhere.
    pub(super) fn apply<A: Frame, B: Frame>(&self, pose: &Pose<A, B>) -> Pose<A, B> {
        let turn = DQuat::from_scaled_axis(self.turned_rad);
        Pose::new(pose.translation_m + self.moved_m, (pose.rotation * turn).normalize())
    }
}

/// Corners of a set of images at its pose.
pub(super) struct Linear {
    rows: Vec<(usize, f64, CornerRow)>,
}

impl Linear {
    /// Returns how corners change with everything; `None` behind a camera. `cameras` are those of the sightings.
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

/// Estimates what is wrong.
#[derive(Debug)]
pub(super) struct Monitor {
    cameras: usize,
    /// Of the last seconds of motion, and of the last moment.
    long: Normal,
    short: Normal,
    /// When sets were learnt from, and when they were judged.
    learnt: Option<HostTime>,
    judged: Option<HostTime>,
    /// What is wrong, as it is applied.
    wrong: Vec<f64>,
    /// How sure that is; the prior before anything was judged.
    covariance: Symmetric,
    /// Variance of each unknown's prior, and what it is at least.
    prior: Vec<f64>,
    floors: Vec<f64>,
    /// The camera whose clock is right.
    on_time: usize,
}

impl Monitor {
    /// Makes a monitor of cameras whose places are known as well as this, one standard deviation an axis [m] and about one
    /// [rad]; of tags that are as large as they say, or not.
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

    /// Returns what is known to be wrong with a camera.
    pub(super) fn correction(&self, camera: usize) -> Correction {
        let own = &self.wrong[EACH * camera..][..EACH];
        Correction {
            late_s: own[LATE],
            readout_s: own[READOUT],
            moved_m: DVec3::new(own[PLACE], own[PLACE + 1], own[PLACE + 2]),
            turned_rad: DVec3::new(own[TURN], own[TURN + 1], own[TURN + 2]),
        }
    }

    /// Returns the tags' size in units of their layout's.
    pub(super) fn scale(&self) -> f64 {
        1.0 + self.wrong[EACH * self.cameras]
    }

    /// Learns from a set at its pose.
    pub(super) fn learn(&mut self, stamp: HostTime, set: &Linear, motion: &VehicleTwist) {
        let dt_s = self.learnt.map_or(0.0, |learnt| stamp.seconds_since(learnt).clamp(0.0, 1.0));
        self.learnt = self.learnt.max(Some(stamp));
        // While it stands nothing is learnt of clocks and scale, and nothing forgotten.
        let moves = (motion.v_world_mps.length() / MOVES_MPS).min(1.0);
        self.long.keep((-dt_s * moves / LONG_S).exp());
        self.short.keep((-dt_s / SHORT_S).exp());
        let mut added = Normal::empty(self.wrong.len());
        if added.add_set(set, &self.wrong) {
            self.long.add(&added);
            self.short.add(&added);
        }
    }

    /// Learns from tags of the room in the image of a camera in the room.
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

    /// Works out what is wrong, if it is time again.
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
                // What was learnt before does not explain what is seen now: something happened.
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
                // Its differences to the others stay.
                let by_s = late[first];
                for camera in 0..self.cameras {
                    self.wrong[EACH * camera + LATE] -= by_s;
                    let variance = &mut self.prior[EACH * camera + LATE];
                    *variance = variance.max(self.wrong[EACH * camera + LATE].powi(2));
                }
            }
        }
    }

    /// Widens priors to what was found, and narrows them where nothing was.
    fn widen(&mut self, wrong: &[f64], covariance: &Symmetric) {
        let size = wrong.len();
        let mut i = 0;
        while i < size {
            // What turns a camera moves it, too.
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

    /// Returns what the open questions add to the covariance of a set's pose. [m, world; rad, body]
    pub(super) fn spread(&self, set: &Linear) -> [[f64; 6]; 6] {
        let zero = [[0.0; 6]; 6];
        let Some((inverse, across)) =
            eliminate(set, self.wrong.len(), |sigma_px, _| sigma_px.powi(-2))
        else {
            return zero;
        };
        // How the pose changes with what is wrong.
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

    /// Returns what people should know. `centres` are where the cameras are, `axes` what turns their axes into the
    /// outer ones.
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

    /// Returns the two cameras that disagree most, if neither alone is known to have moved.
    fn moved_against_another(&self, places: &[glam::DAffine3]) -> Option<Finding> {
        let mut most: Option<(f64, Finding)> = None;
        for a in 0..self.cameras {
            for b in 0..a {
                let both = [a, b].map(|camera| EACH * camera + PLACE..EACH * camera + TURN + 3);
                let surprise = self.surprise(&both.into_iter().flatten().collect::<Vec<_>>());
                let (one, other) = (self.correction(a), self.correction(b));
                // If the other stands right, the world moved by this.
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

    /// Returns how far unknowns are from zero, squared, in units of how sure they are.
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

/// Returns what an unknown is: one of a camera's, or [`EACH`] for the scale.
fn kind(i: usize, size: usize) -> usize {
    match i % EACH {
        _ if i + 1 == size => EACH,
        k if k >= TURN => TURN,
        k if k >= PLACE => PLACE,
        k => k,
    }
}

/// Unknowns of a camera, and where each begins.
const EACH: usize = 8;
const LATE: usize = 0;
const READOUT: usize = 1;
const PLACE: usize = 2;
const TURN: usize = 5;
/// How far each is off where nothing is wrong, by its kind: stamps and shutters by a fraction of a millisecond, the
/// ruler's reading by hundredths of a millimetre. Cameras: by what their survey left.
const FLOORS: [f64; EACH + 1] = [2e-4, 5e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-4];
/// And how far before anything was seen.
const FIRST: [f64; EACH + 1] = [1e-2, 1e-2, 2e-3, 0.0, 0.0, 7e-4, 0.0, 0.0, 7e-3];
/// And how far at most: clocks by half a second, a readout by an image's interval, a camera by what still sees.
const CEILINGS: [f64; EACH + 1] = [0.5, 0.05, 0.5, 0.0, 0.0, 0.2, 0.0, 0.0, 0.2];
/// Tags of the room are seen 3 times a second over [`LONG_S`], always with the same error of survey and lens: all
/// together count as one.
const ANCHOR_SIGMAS: f64 = 8.0;
/// What is learnt lasts for so long of motion, [s]
const LONG_S: f64 = 8.0;
/// at this speed or faster. [m/s]
const MOVES_MPS: f64 = 0.3;
/// The last moment. [s]
const SHORT_S: f64 = 0.5;
/// So many numbers of it are needed to see that something happened.
const LEAST_ROWS: f64 = 20.0;
/// It happened if what was known leaves so many times the squares.
const CHANGED: f64 = 4.0;
/// How often it is judged, [s]
const JUDGE_S: f64 = 0.1;
/// and priors are widened each time.
const ROUNDS: usize = 4;
/// Findings are told from these on. [s]
const LATE_S: f64 = 3e-3;
/// [s]
const READOUT_S: f64 = 4e-3;
/// [m]
const MOVED_M: f64 = 0.008;
/// [rad]
const TURNED_RAD: f64 = 0.003;
/// Share of the size.
const SCALE: f64 = 0.007;
/// And if they are so many of their sigmas from zero.
const SURE_SIGMAS: f64 = 4.0;
/// Likewise, of six numbers, squared.
const MOVED_SURPRISE: f64 = 40.0;
