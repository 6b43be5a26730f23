//! The whole of the rules for one vehicle as one sans-IO state machine: measurements and time in,
//! events out. The server calls it for every pose, 200 Hz; a call takes a few microseconds.
//!
//! ```text
//! measurement -> pose gate -> on the floor?  -> nothing is judged
//!                             in the air     -> collision, fence, course, time -> events
//! ```
//! A flight begins when the body's centre rises 0.3 m above the start. Each thing that ends a
//! flight is said once; after it nothing more is judged until [`Referee::restart`].

use std::collections::VecDeque;
use std::sync::Arc;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, Volume, World};
use vizflyt_protocol::messages::{Event, EventKind, Limits, PoseSample, bounded};
use vizflyt_protocol::time::ServerTime;

use crate::collision::sweep;
use crate::config::ArenaConfig;
use crate::course::{Course, Progress};
use crate::distance::{DistanceField, ObstacleSlice};
use crate::fence::{self, FenceVerdict};
use crate::pose::{PoseChange, PoseGate, Rejected};

/// Rise that counts as take-off; a vehicle that rocks on its legs does not reach it. [m]
const AIRBORNE_M: f64 = 0.3;
/// A descent faster than this onto the floor is a crash; ArduCopter lands with 0.5 m/s. [m/s]
const CRASH_MPS: f64 = 1.5;

/// Judges one vehicle.
#[derive(Debug)]
pub struct Referee {
    config: ArenaConfig,
    fence: Volume,
    limits: Limits,
    field: Arc<DistanceField>,
    gate: PoseGate,
    course: Course,
    last_m: Option<DVec3>,
    took_off: Option<ServerTime>,
    over: bool,
    near_fence: bool,
    least_clearance_m: f64,
    events: VecDeque<Event>,
}

impl Referee {
    /// Makes a referee for an arena with its baked obstacles, which the referees of several vehicles
    /// share; no flight has begun.
    pub fn new(config: &ArenaConfig, field: impl Into<Arc<DistanceField>>) -> Self {
        Self {
            fence: config.geofence(),
            limits: config.limits,
            field: field.into(),
            gate: PoseGate::default(),
            course: Course::new(config),
            last_m: None,
            took_off: None,
            over: false,
            near_fence: false,
            least_clearance_m: f64::INFINITY,
            events: VecDeque::new(),
            config: config.clone(),
        }
    }

    /// Forgets the flight: the next rise from the floor begins a new one.
    pub fn restart(&mut self) {
        self.course = Course::new(&self.config);
        self.took_off = None;
        self.over = false;
        self.near_fence = false;
        self.least_clearance_m = f64::INFINITY;
    }

    /// Takes a measurement of the vehicle; returns the pose if it is believed.
    pub fn handle_measurement(
        &mut self,
        stamp: ServerTime,
        world_from_body: Pose<World, Body>,
    ) -> Result<PoseSample, Rejected> {
        let sample = self.gate.handle_measurement(stamp, world_from_body)?;
        self.report_change(stamp);
        let to_m = world_from_body.translation_m;
        // After a reset the way between the poses was not flown.
        let from_m = self.last_m.replace(to_m).filter(|_| !is_jump(&sample)).unwrap_or(to_m);
        self.judge(&sample, from_m, to_m);
        Ok(sample)
    }

    /// Notices silence and the time limit. Call at [`Self::poll_timeout`].
    pub fn handle_timeout(&mut self, now: ServerTime) {
        self.gate.handle_timeout(now);
        self.report_change(now);
        self.judge_time(now);
    }

    /// Returns when [`Self::handle_timeout`] has something to do.
    pub fn poll_timeout(&self) -> Option<ServerTime> {
        match (self.gate.poll_timeout(), self.time_limit()) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }

    /// Returns the next event.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Whether a flight is under way and not yet decided.
    pub fn is_judging(&self) -> bool {
        self.took_off.is_some() && !self.over
    }

    /// Returns the newest believed pose.
    pub fn newest(&self) -> Option<&PoseSample> {
        self.gate.newest()
    }

    /// Returns the distance from the body's surface at a point to the nearest obstacle. [m, world]
    pub fn clearance_m(&self, p_world_m: DVec3) -> f64 {
        self.field.obstacle_distance_m(p_world_m) - self.config.body_radius_m
    }

    /// Returns the least clearance of this flight so far; infinite before it. [m]
    pub fn least_clearance_m(&self) -> f64 {
        self.least_clearance_m
    }

    /// Returns the obstacles at a height, for the page's top view. [m, world]
    pub fn obstacle_slice(&self, z_m: f64) -> ObstacleSlice {
        self.field.obstacle_slice(z_m)
    }

    fn judge(&mut self, sample: &PoseSample, from_m: DVec3, to_m: DVec3) {
        let risen_m = to_m.z - self.config.spawn.position_m.z;
        if self.took_off.is_none() && risen_m > AIRBORNE_M {
            self.took_off = Some(sample.stamp);
        }
        if !self.is_judging() {
            return;
        }
        self.judge_collision(sample, from_m, to_m);
        self.judge_fence(sample, to_m);
        self.judge_course(sample, from_m, to_m);
        self.judge_time(sample.stamp);
    }

    fn judge_collision(&mut self, sample: &PoseSample, from_m: DVec3, to_m: DVec3) {
        let radius_m = self.config.body_radius_m;
        let found = sweep(&self.field, from_m, to_m, radius_m);
        self.least_clearance_m = self.least_clearance_m.min(found.clearance_m);
        let floor_m = to_m.z - radius_m - self.field.floor_z_m();
        let descent_mps = -sample.twist.linear_mps.z;
        let contact = match found.contact {
            Some(touch) => Some((touch.p_world_m, touch.clearance_m, "an obstacle")),
            None if floor_m <= 0.0 && descent_mps > CRASH_MPS => Some((to_m, floor_m, "the floor")),
            None => None,
        };
        if let Some((p_world_m, clearance_m, what)) = contact {
            let p = p_world_m;
            let text = format!(
                "collision with {what} at ({:.2}, {:.2}, {:.2}) m, at {:.1} m/s",
                p.x,
                p.y,
                p.z,
                sample.twist.linear_mps.length()
            );
            self.end(sample.stamp, EventKind::Collision { p_world_m, clearance_m }, &text);
        }
    }

    fn judge_fence(&mut self, sample: &PoseSample, p_world_m: DVec3) {
        let v_mps = sample.twist.linear_mps;
        // The floor is part of the fence's box; landing toward it is not a breach.
        let v_mps = if v_mps.z < 0.0 { v_mps.with_z(0.0) } else { v_mps };
        let found =
            fence::check(&self.fence, &self.limits, self.config.body_radius_m, p_world_m, v_mps);
        let margin_m = found.margin_m;
        match found.verdict {
            FenceVerdict::Inside => self.near_fence = false,
            FenceVerdict::Near => {
                if !std::mem::replace(&mut self.near_fence, true) {
                    let text = format!("close to the geofence: {margin_m:.2} m left");
                    self.tell(sample.stamp, EventKind::Note, &text);
                }
            }
            FenceVerdict::Breach => {
                let text = if margin_m < 0.0 {
                    format!("left the geofence by {:.2} m", -margin_m)
                } else {
                    format!(
                        "cannot stop inside the geofence: {margin_m:.2} m left, and at {:.1} m/s \
                         it would come to rest {:.2} m outside",
                        v_mps.length(),
                        -found.margin_at_rest_m
                    )
                };
                self.end(sample.stamp, EventKind::Geofence { p_world_m, margin_m }, &text);
            }
        }
    }

    fn judge_course(&mut self, sample: &PoseSample, from_m: DVec3, to_m: DVec3) {
        let seconds = self.seconds(sample.stamp);
        let name = |index: usize| self.config.stages[index].name.clone();
        match self.course.advance(from_m, to_m) {
            Some(Progress::Stage(index)) => {
                let name = name(index);
                let kind = EventKind::Stage { index: index as u8, name: bounded(&name) };
                self.tell(sample.stamp, kind, &format!("passed {name} after {seconds:.1} s"));
            }
            Some(Progress::Finished) => {
                let text = format!("reached the goal after {seconds:.1} s");
                self.end(sample.stamp, EventKind::Finished { seconds }, &text);
            }
            Some(Progress::GoalTooEarly(index)) => {
                let text = format!("at the goal, but {} is not passed yet", name(index));
                self.tell(sample.stamp, EventKind::Note, &text);
            }
            None => {}
        }
    }

    fn judge_time(&mut self, now: ServerTime) {
        if self.is_judging() && self.time_limit().is_some_and(|limit| now >= limit) {
            let text = format!("the course's {} s are over", self.config.time_limit_s);
            self.end(now, EventKind::TimeLimit, &text);
        }
    }

    fn time_limit(&self) -> Option<ServerTime> {
        let limit_s = self.config.time_limit_s;
        let took_off = self.took_off.filter(|_| !self.over && limit_s > 0.0)?;
        Some(took_off.plus_seconds(limit_s))
    }

    fn seconds(&self, now: ServerTime) -> f64 {
        self.took_off.map_or(0.0, |at| now.seconds_since(at))
    }

    fn report_change(&mut self, now: ServerTime) {
        match self.gate.poll_change() {
            Some(PoseChange::Lost(age_s)) => {
                let text = format!("no pose for {:.0} ms", age_s * 1e3);
                self.tell(now, EventKind::PoseLost { age_s }, &text);
            }
            Some(PoseChange::Regained) => {
                self.tell(now, EventKind::PoseRegained, "poses are back");
            }
            None => {}
        }
    }

    /// Says what ends the flight; of several in one pose the first counts.
    fn end(&mut self, stamp: ServerTime, kind: EventKind, text: &str) {
        if !std::mem::replace(&mut self.over, true) {
            self.tell(stamp, kind, text);
        }
    }

    fn tell(&mut self, stamp: ServerTime, kind: EventKind, text: &str) {
        // Bounded: each kind of end is said once a flight, and the server drains after every call.
        self.events.push_back(Event { stamp, kind, text: bounded(text) });
    }
}

/// Whether the gate started afresh with this sample: a lone measurement has no twist.
fn is_jump(sample: &PoseSample) -> bool {
    sample.resets > 0 && sample.twist == vizflyt_protocol::geometry::Twist::default()
}

#[cfg(test)]
pub(crate) mod tests;
