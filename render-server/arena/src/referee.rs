//! Referee: all rules for one vehicle as one sans-IO state machine. Measurements and time in, events out. The
//! server calls it for every pose, at 200 Hz; a call takes a few microseconds.
//!
//! ```text
//! measurement -> pose filter -> on the floor -> no check
//!                            -> in the air   -> collision, fence, course, time -> events
//! ```
//! A flight begins when the body's centre rises 0.3 m above the start. The referee reports the first event that
//! ends the flight, and then nothing until [`Referee::restart`]. If the flight is ended from outside
//! ([`Referee::handle_event`]), course and time stop, and only a collision or a breach during the descent is
//! still reported. [`vizflyt_protocol::flight_end`] defines the end of a flight.

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::flight_end::{Collision, EndReason, FenceBreach, Obstacle};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::{Event, EventKind, FlightPhase, PoseSample, bounded};
use vizflyt_protocol::time::ServerTime;

use crate::body::BodyShape;
use crate::config::ArenaConfig;
use crate::course::{Course, Progress};
use crate::distance::ObstacleSlice;
use crate::fence::{Boundaries, FenceVerdict};
use crate::neighbours::{Neighbour, Passage};
use crate::obstacles::{Obstacles, TimedPose, Touched};
use crate::pose::{ImuReading, Measured, Motion, PoseChange, PoseFilter, PoseQuality, Rejected};

/// Rise that counts as take-off; a vehicle that rocks on its legs stays below it. [m]
pub(crate) const AIRBORNE_M: f64 = 0.3;
/// A descent faster than this onto the floor is a crash; ArduCopter lands with 0.5 m/s. [m/s]
const CRASH_MPS: f64 = 1.5;

/// Maximum distance of a contact's voxel from the body's surface.
const NEAREST_VOXELS: f64 = 2.0;

/// Obstacle that a body met, with an index if there are several of its kind.
#[derive(Clone, Copy, Debug)]
enum Met {
    Still,
    Unseen,
    Floor,
    Object(usize),
    Vehicle(usize),
}

/// Referee of one vehicle.
#[derive(Debug)]
pub struct Referee {
    config: ArenaConfig,
    body: BodyShape,
    boundaries: Boundaries,
    obstacles: Obstacles,
    /// Time 0 of the objects' motions.
    epoch: ServerTime,
    /// Other vehicles by their number; `None` at the number of this vehicle.
    neighbours: Vec<Option<Neighbour>>,
    filter: PoseFilter,
    /// Number of pose resets that have been processed.
    resets: u8,
    course: Course,
    last: Option<(ServerTime, Pose<World, Body>)>,
    took_off: Option<ServerTime>,
    /// Last phase that the runtime reported.
    phase: Option<FlightPhase>,
    /// Whether the newest pose is higher than [`AIRBORNE_M`] above the start.
    is_up: bool,
    /// The end was reported, or the vehicle has landed: nothing is checked.
    over: bool,
    /// The flight was ended from outside: course and time are not checked.
    ended: bool,
    near_fence: bool,
    least_clearance_m: f64,
    events: VecDeque<Event>,
}

impl Referee {
    /// Returns a referee for an arena with its baked obstacles, which referees of several vehicles share. No
    /// flight has begun. The motions of objects count from time 0 of the clock, see [`Self::counting_from`].
    pub fn new(config: &ArenaConfig, obstacles: impl Into<Obstacles>) -> Self {
        Self {
            body: BodyShape::of(config),
            boundaries: Boundaries::of(config),
            obstacles: obstacles.into(),
            epoch: ServerTime::ZERO,
            neighbours: Vec::new(),
            filter: PoseFilter::new(&config.pose),
            resets: 0,
            course: Course::new(config),
            last: None,
            took_off: None,
            phase: None,
            is_up: false,
            over: false,
            ended: false,
            near_fence: false,
            least_clearance_m: f64::INFINITY,
            events: VecDeque::new(),
            config: config.clone(),
        }
    }

    /// Counts the motions of objects from `epoch`, as the renderers do.
    #[must_use]
    pub fn counting_from(mut self, epoch: ServerTime) -> Self {
        self.epoch = epoch;
        self
    }

    /// Sets the position of another vehicle by its number; `None` removes it.
    pub fn handle_neighbour(&mut self, number: usize, neighbour: Option<Neighbour>) {
        if self.neighbours.len() <= number {
            self.neighbours.resize(number + 1, None);
        }
        self.neighbours[number] = neighbour;
    }

    /// Clears the flight: the next rise from the floor begins a new one.
    pub fn restart(&mut self) {
        self.course = Course::new(&self.config);
        self.took_off = None;
        self.is_up = false;
        self.over = false;
        self.ended = false;
        self.near_fence = false;
        self.least_clearance_m = f64::INFINITY;
    }

    /// Processes a measurement of the vehicle; returns the pose if it is accepted.
    pub fn handle_measurement(&mut self, measured: &Measured) -> Result<PoseSample, Rejected> {
        self.filter.set_in_flight(self.is_in_flight());
        let known = self.filter.newest().map(|newest| newest.stamp);
        let sample = self.filter.handle_pose(measured)?;
        self.report_change(sample.stamp);
        if known.is_some_and(|known| sample.stamp <= known) && sample.resets == self.resets {
            // A measurement of the past: the poses after it have been checked already.
            return Ok(sample);
        }
        let to = sample.world_from_body;
        // After a reset, the vehicle has not flown the line between the poses.
        let jumped = std::mem::replace(&mut self.resets, sample.resets) != sample.resets;
        let here = (sample.stamp, to);
        let from = self.last.replace(here).filter(|_| !jumped).unwrap_or(here);
        self.judge(&sample, from);
        Ok(sample)
    }

    /// Processes a reading of the autopilot's IMU.
    pub fn handle_imu(&mut self, reading: &ImuReading) {
        self.filter.handle_imu(reading);
    }

    /// Processes an event of the runtime or of a person.
    pub fn handle_event(&mut self, event: &Event) {
        if let EventKind::Phase(phase) = event.kind {
            self.phase = Some(phase);
        }
        match event.kind {
            // Earlier motion by hand was not a flight.
            EventKind::Phase(FlightPhase::TakingOff) => self.restart(),
            EventKind::Phase(FlightPhase::Landed) => self.over = true,
            _ => self.ended |= event.kind.end_reason().is_some(),
        }
    }

    /// Returns the motion by all measurements.
    pub fn motion(&mut self) -> Option<Motion> {
        self.filter.motion()
    }

    /// Returns the quality of the localization at `now`.
    pub fn quality(&self, now: ServerTime) -> PoseQuality {
        self.filter.quality(now)
    }

    /// Checks for silence and the time limit. Call at [`Self::poll_timeout`].
    pub fn handle_timeout(&mut self, now: ServerTime) {
        self.filter.handle_timeout(now);
        self.report_change(now);
        self.judge_silence(now);
        self.judge_time(now);
    }

    /// Returns the time of the next call of [`Self::handle_timeout`].
    pub fn poll_timeout(&self) -> Option<ServerTime> {
        let dues = [self.filter.poll_timeout(), self.silence_limit(), self.time_limit()];
        dues.into_iter().flatten().min()
    }

    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Whether a flight is in progress and undecided.
    pub fn is_judging(&self) -> bool {
        self.took_off.is_some() && !self.over
    }

    /// Returns the newest accepted pose.
    pub fn newest(&self) -> Option<&PoseSample> {
        self.filter.newest()
    }

    /// Returns the distance from the surface of the body at a point to the nearest obstacle, at the time of the
    /// newest pose. [m, world]
    pub fn clearance_m(&self, p_world_m: DVec3) -> f64 {
        let at = self.newest().map_or(self.epoch, |newest| newest.stamp);
        let distance_m = self.obstacles.distance_m(self.since_epoch_ns(at), p_world_m);
        distance_m - self.config.body_radius_m
    }

    /// Returns the minimum clearance of this flight; infinite before a flight. [m]
    pub fn least_clearance_m(&self) -> f64 {
        self.least_clearance_m
    }

    /// Returns the obstacles at a height, for the page's top view. [m, world]
    pub fn obstacle_slice(&self, z_m: f64) -> ObstacleSlice {
        self.obstacles.still.obstacle_slice(z_m)
    }

    /// Whether the vehicle is in the air. While it takes off or lands, and without a runtime, its height counts.
    fn is_in_flight(&self) -> bool {
        use FlightPhase::{
            Connecting, Flying, Holding, Landed, Landing, Preparing, TakingOff, Waiting,
        };
        match self.phase {
            Some(Flying | Holding) => true,
            Some(Connecting | Preparing | Waiting | Landed) => false,
            Some(TakingOff | Landing) | None => self.is_up,
        }
    }

    fn voxel_m(&self) -> f64 {
        self.obstacles.still.grid().voxel_m
    }

    fn since_epoch_ns(&self, at: ServerTime) -> i64 {
        at.as_ns().wrapping_sub(self.epoch.as_ns()).cast_signed()
    }

    fn judge(&mut self, sample: &PoseSample, (since, from): (ServerTime, Pose<World, Body>)) {
        let to = &sample.world_from_body;
        let (from_m, to_m) = (from.translation_m, to.translation_m);
        let risen_m = to_m.z - self.config.spawn.position_m.z;
        self.is_up = risen_m > AIRBORNE_M;
        if self.took_off.is_none() && self.is_up {
            self.took_off = Some(sample.stamp);
        }
        if !self.is_judging() {
            return;
        }
        self.judge_collision(sample, since, &from);
        self.judge_fence(sample, from_m, to_m);
        self.judge_course(sample, from_m, to_m);
        self.judge_time(sample.stamp);
    }

    fn judge_collision(
        &mut self,
        sample: &PoseSample,
        since: ServerTime,
        from: &Pose<World, Body>,
    ) {
        let to = &sample.world_from_body;
        let timed_pose = |at: ServerTime, pose: &Pose<World, Body>| TimedPose {
            since_epoch_ns: self.since_epoch_ns(at),
            world_from_body: *pose,
        };
        let (mut found, touched) = self.obstacles.sweep(
            &self.body,
            &timed_pose(since, from),
            &timed_pose(sample.stamp, to),
        );
        let mut met = match touched {
            Touched::Still => Met::Still,
            Touched::Object(index) => Met::Object(index),
        };
        let passage =
            |stamp, pose: &Pose<World, Body>| Passage { stamp, p_world_m: pose.translation_m };
        let path = (passage(since, from), passage(sample.stamp, to));
        for (number, neighbour) in self.neighbours.iter().enumerate() {
            let Some(neighbour) = neighbour else { continue };
            let other = neighbour.sweep(path.0, path.1, self.body.radius_m());
            found.clearance_m = found.clearance_m.min(other.clearance_m);
            let first = found.contact.map_or(f64::INFINITY, |contact| contact.fraction);
            if let Some(contact) = other.contact.filter(|contact| contact.fraction < first) {
                found.contact = Some(contact);
                met = Met::Vehicle(number);
            }
        }
        self.least_clearance_m = self.least_clearance_m.min(found.clearance_m);
        let to_m = to.translation_m;
        let floor_z_m = self.obstacles.still.floor_z_m();
        let floor_m = self.body.clearance_m(to, f64::INFINITY, |p_m| p_m.z - floor_z_m);
        let descent_mps = -sample.twist.linear_mps.z;
        let contact = match found.contact {
            Some(touch) => {
                let reach_m = self.body.radius_m() + NEAREST_VOXELS * self.voxel_m();
                let still = &self.obstacles.still;
                if matches!(met, Met::Still) && still.is_unseen_nearest(touch.p_world_m, reach_m) {
                    met = Met::Unseen;
                }
                Some((touch.p_world_m, touch.clearance_m, met))
            }
            None if floor_m <= 0.0 && descent_mps > CRASH_MPS => Some((to_m, floor_m, Met::Floor)),
            None => None,
        };
        if let Some((p_world_m, clearance_m, met)) = contact {
            let speed_mps = sample.twist.linear_mps.length();
            let collision =
                Collision { p_world_m, clearance_m, with: self.obstacle(met), speed_mps };
            self.end(sample.stamp, EventKind::Collision(collision));
        }
    }

    fn obstacle(&self, met: Met) -> Obstacle {
        match met {
            Met::Still => Obstacle::Scene,
            Met::Unseen => Obstacle::Unseen,
            Met::Floor => Obstacle::Floor,
            Met::Object(index) => {
                let name = self.obstacles.objects.names().nth(index);
                Obstacle::Object(bounded(name.unwrap_or_default()))
            }
            Met::Vehicle(number) => {
                let neighbour = self.neighbours.get(number).and_then(Option::as_ref);
                Obstacle::Vehicle(neighbour.map(|it| it.name.clone()).unwrap_or_default())
            }
        }
    }

    fn judge_fence(&mut self, sample: &PoseSample, from_m: DVec3, p_world_m: DVec3) {
        let v_mps = sample.twist.linear_mps;
        let found = self.boundaries.check(from_m, p_world_m, v_mps);
        let (boundary, margin_m) = (found.boundary.clone(), found.margin_m);
        let overshoot_m = -found.margin_at_rest_m;
        match found.verdict {
            FenceVerdict::Inside => self.near_fence = false,
            FenceVerdict::Near => {
                if !std::mem::replace(&mut self.near_fence, true) {
                    let text = format!("close to {boundary}: {margin_m:.2} m left");
                    self.report(sample.stamp, EventKind::Note, &text);
                }
            }
            FenceVerdict::Breach => {
                let speed_mps = v_mps.length();
                let breach = FenceBreach { p_world_m, margin_m, boundary, speed_mps, overshoot_m };
                self.end(sample.stamp, EventKind::Geofence(breach));
            }
        }
    }

    fn judge_course(&mut self, sample: &PoseSample, from_m: DVec3, to_m: DVec3) {
        if self.ended {
            return;
        }
        let seconds = self.seconds(sample.stamp);
        while let Some(progress) = self.course.advance(from_m, to_m) {
            match progress {
                Progress::Stage(index) => {
                    let name = self.config.stages[index].name.clone();
                    let kind = EventKind::Stage { index: index as u8, name: bounded(&name) };
                    self.report(sample.stamp, kind, &format!("passed {name} after {seconds:.1} s"));
                }
                Progress::Finished => self.end(sample.stamp, EventKind::Finished { seconds }),
                Progress::GoalTooEarly(index) => {
                    let name = &self.config.stages[index].name;
                    let text = format!("at the goal, but {name} is not passed yet");
                    self.report(sample.stamp, EventKind::Note, &text);
                }
            }
        }
    }

    fn judge_time(&mut self, now: ServerTime) {
        if self.time_limit().is_some_and(|limit| now >= limit) {
            self.end(now, EventKind::TimeLimit { limit_s: self.config.time_limit_s });
        }
    }

    /// A vehicle without a pose is landed by its guard: the flight is over.
    fn judge_silence(&mut self, now: ServerTime) {
        if let Some(limit) = self.silence_limit()
            && now >= limit
        {
            let age_s = self.newest().map_or(0.0, |newest| now.seconds_since(newest.stamp));
            self.end(now, EventKind::Ended(EndReason::PoseLost { age_s }));
        }
    }

    fn silence_limit(&self) -> Option<ServerTime> {
        let newest = self.newest().filter(|_| self.is_judging() && !self.ended)?;
        // A nanosecond later: the sum is rounded.
        Some(newest.stamp.plus_seconds(self.config.pose.land_after_s).plus_ns(1))
    }

    fn time_limit(&self) -> Option<ServerTime> {
        let limit_s = self.config.time_limit_s;
        let took_off = self.took_off.filter(|_| !self.over && !self.ended && limit_s > 0.0)?;
        Some(took_off.plus_seconds(limit_s))
    }

    fn seconds(&self, now: ServerTime) -> f64 {
        self.took_off.map_or(0.0, |at| now.seconds_since(at))
    }

    fn report_change(&mut self, now: ServerTime) {
        while let Some(change) = self.filter.poll_change() {
            match change {
                PoseChange::Lost(age_s, why) => {
                    let why = why.map_or_else(String::new, |why| format!(": {why}"));
                    let text = format!("no pose for {:.0} ms{why}", age_s * 1e3);
                    self.report(now, EventKind::PoseLost { age_s }, &text);
                }
                PoseChange::Regained => {
                    self.report(now, EventKind::PoseRegained, "poses are back");
                }
                PoseChange::Jumped(distance_m, angle_rad) => {
                    let text = format!(
                        "the pose jumped by {distance_m:.2} m and {:.0} degrees and stayed there; it \
                         is accepted, as a reset: was the origin moved, or are markers swapped?",
                        angle_rad.to_degrees()
                    );
                    self.report(now, EventKind::Note, &text);
                }
                PoseChange::ImuLeftOut => {
                    let text = "the autopilot's IMU contradicts the poses and is left out: is the \
                                object's frame turned against the autopilot, or does the vehicle \
                                shake?";
                    self.report(now, EventKind::Note, text);
                }
            }
        }
    }

    /// Reports the end of the flight; only the first end counts.
    fn end(&mut self, stamp: ServerTime, kind: EventKind) {
        if !std::mem::replace(&mut self.over, true) {
            self.events.push_back(Event::ending(stamp, kind));
        }
    }

    fn report(&mut self, stamp: ServerTime, kind: EventKind, text: &str) {
        // Bounded: each kind of end is reported once per flight, and the server drains after every call.
        self.events.push_back(Event { stamp, kind, text: bounded(text) });
    }
}

#[cfg(test)]
pub(crate) mod tests;
