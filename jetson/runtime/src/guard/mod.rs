//! The last word on every setpoint. Pure: state, `now` and what is known in; one command out.
//!
//! Called at 50 to 200 Hz by [`flight`](crate::flight) while the plugin flies. In this order:
//! 1. a landing, once begun, is never taken back;
//! 2. deadlines: a pose older than the arena's `hold_after_s`, or no setpoint for 0.5 s, holds; a pose older
//!    than `land_after_s`, or no setpoint for 2 s, lands;
//! 3. what the plugin asks becomes a velocity in world axes (positions by a braking profile,
//!    accelerations by integration, attitude rates by the acceleration that the attitude means,
//!    trajectories by a moving point); numbers that are not finite were refused at [`Guard::ask`];
//! 4. speed limit, acceleration limit (which also bounds tilt), then the geofence, the ceiling, the
//!    floor and the no-fly boxes: never faster towards a face than the vehicle can stop before it.
//!
//! Everything leaves as a velocity, so that one slew limit and one fence rule bound all motion.

mod fence;
#[cfg(test)]
mod tests;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Volume, wrap_pi, yaw_of};
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    ArenaInfo, Axes, InvalidSetpoint, Limits, Path, PoseAges, PoseSample, Setpoint, SetpointKind,
    SetpointKinds, YawTarget,
};
use vizflyt_protocol::time::HostTime;

use crate::trajectory::{Follower, Start};

use fence::Fence;

/// Where the vehicle is, as the guard needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fix {
    /// When this was true. [host]
    pub stamp: HostTime,
    /// Position of the body's centre. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Attitude: body to world.
    pub rotation: DQuat,
}

/// What the guard sends on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Passed {
    /// To be flown.
    Guided(GuidedSetpoint),
    /// Come down, now.
    Land,
}

/// Why the vehicle is held in place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HoldReason {
    /// The plugin asked for it.
    Asked,
    /// No setpoint has come for [`SETPOINT_HOLD_S`].
    NoSetpoint,
    /// The newest pose is older than [`PoseAges::hold_after_s`].
    PoseStale,
    /// The plugin is being started again.
    Restarting,
    /// The flight is over; it brakes before it lands.
    Ending,
}

/// Why the guard lands by itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LandReason {
    /// The plugin asked for it.
    Asked,
    /// No setpoint has come for so long. [s]
    NoSetpoint(f64),
    /// A plugin that was to be started again has not answered within [`RESTART_WITHIN_S`].
    NoPlugin,
    /// The newest pose is so old. [s]
    PoseLost(f64),
    /// The body is outside the fence by so much. [m]
    OutsideFence(f64),
    /// The body reaches into a no-fly box by so much. [m]
    InNoFly(f64),
    /// Whoever called [`Guard::land`] knows why.
    Ordered,
}

/// What the guard is doing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stance {
    /// Flies what the plugin asks, within the limits.
    Passing,
    /// Stops and stays.
    Holding(HoldReason),
    /// Comes down; final.
    Landing(LandReason),
}

/// No setpoint for this long: hold. A plugin at 10 Hz may miss four images. [s]
pub const SETPOINT_HOLD_S: f64 = 0.5;
/// No setpoint for this long: land. [s]
pub const SETPOINT_LAND_S: f64 = 2.0;
/// A plugin that is started again may take so long until its first setpoint: an interpreter that
/// loads numpy and a small model. [s]
pub const RESTART_WITHIN_S: f64 = 10.0;

/// A pose is moved on by its velocity for so long at most. [s]
const EXTRAPOLATED_S: f64 = 0.5;
/// A speed below which the vehicle counts as stopped. [m/s]
const STOPPED_MPS: f64 = 0.3;
/// Braking before an orderly landing takes this long at most. [s]
const BRAKE_AT_MOST_S: f64 = 2.0;
/// Fastest turn passed on. A racing turn of 180 degrees a second; ArduCopter's default limit is
/// 202 (`ATC_RATE_Y_MAX`, `ATC_SLEW_YAW`). [rad/s]
const MAX_YAW_RATE_RADPS: f64 = std::f64::consts::PI;
/// Gain from distance to speed when flying to a point. Slower than ArduCopter's own position
/// loop (`PSC_NE_POS_P` = 1), so that the two do not fight. [1/s]
const POSITION_GAIN_PER_S: f64 = 0.8;
/// Speed at which a held vehicle returns to its point. [m/s]
const RETURN_MPS: f64 = 0.5;
/// Fastest rotation that attitude rates are taken at: two turns a second. [rad/s]
const MAX_RATE_RADPS: f64 = 4.0 * std::f64::consts::PI;
/// Greatest tilt that attitude rates lead to: a little past it the thrust that carries the vehicle
/// is twice its weight. [rad]
const MOST_TILT_RAD: f64 = 1.0;
/// Thrust over weight that is taken at most; small quadrotors have 2 to 5.
const MOST_THRUST: f64 = 4.0;
/// Where slew limit and fence disagree at a flat face, the command changes faster than the
/// acceleration limit by at most this factor (measured over 10^5 random flights).
const FENCE_EXCESS: f64 = 1.2;
/// Standard gravity, ISO 80000-3. [m/s^2]
const GRAVITY_MPS2: f64 = 9.80665;
/// Speed towards the fence that is taken away before it is worth a word. [m/s]
const FENCE_STOPS_MPS: f64 = 0.1;
/// Longest time between two ticks that counts; after a stall the slew limit must not open. [s]
const LONGEST_TICK_S: f64 = 0.1;

/// A setpoint that counts from where the vehicle was when it was taken, or from the one before.
#[derive(Clone, Debug, Default)]
enum Resolved {
    /// Not yet, or nothing to resolve.
    #[default]
    Nothing,
    /// A place to go to. [m, world]
    Point(DVec3),
    /// A path being followed.
    Path(Box<Follower>),
    /// The attitude that rates have led to: body to world.
    Attitude(DQuat),
}

/// The guard of one flight.
#[derive(Clone, Debug)]
pub struct Guard {
    fence: Fence,
    max_speed_mps: f64,
    /// What keeps the limits of acceleration and of tilt.
    max_acceleration_mps2: f64,
    /// What was commanded last; the slew limit counts from it. [m/s, world]
    v_command_mps: DVec3,
    /// Heading to send: an angle or a rate.
    yaw: YawTarget,
    /// The heading that [`YawTarget::Keep`] keeps, from when it was first asked for. [rad]
    kept_yaw_rad: Option<f64>,
    hold_point_m: Option<DVec3>,
    asked: Option<Setpoint>,
    /// What `asked` became once the vehicle's place was known.
    resolved: Resolved,
    /// Where the vehicle was when the plugin took over. [m, world]
    take_off_z_m: f64,
    allowed: SetpointKinds,
    pose_ages: PoseAges,
    /// When the newest setpoint came, or the plugin took over.
    asked_at: HostTime,
    ticked_at: HostTime,
    /// Set when the flight shall end in order: brake first, until then.
    ending_until: Option<HostTime>,
    /// Set while the plugin is started again: until when it is waited for.
    restarting_until: Option<HostTime>,
    /// The fence kept the vehicle from what the plugin asked for, in the last tick.
    fence_stops: bool,
    landing: Option<LandReason>,
}

impl Guard {
    /// Makes the guard of a flight in `arena` that takes over from `fix` at `now`.
    pub fn new(arena: &ArenaInfo, fix: &Fix, now: HostTime) -> Self {
        let max_acceleration_mps2 = acceleration_within_tilt_mps2(&arena.limits);
        Self {
            fence: Fence::new(arena, max_acceleration_mps2),
            max_speed_mps: arena.limits.max_speed_mps,
            max_acceleration_mps2,
            v_command_mps: fix.v_world_mps.clamp_length_max(arena.limits.max_speed_mps),
            yaw: YawTarget::Angle(fix.yaw_rad()),
            kept_yaw_rad: Some(fix.yaw_rad()),
            hold_point_m: None,
            asked: None,
            resolved: Resolved::Nothing,
            take_off_z_m: fix.p_world_m.z,
            allowed: arena.setpoints,
            pose_ages: arena.pose_ages,
            asked_at: now,
            ticked_at: now,
            ending_until: None,
            restarting_until: None,
            fence_stops: false,
            landing: None,
        }
    }

    /// Takes what the plugin asks for at `now`.
    ///
    /// # Errors
    /// Why it is refused, as for a number that is not finite; it then does not count against the
    /// deadline.
    pub fn ask(&mut self, now: HostTime, setpoint: Setpoint) -> Result<(), InvalidSetpoint> {
        setpoint.check()?;
        let setpoint = bounded(setpoint);
        let allowed = self.allowed;
        if let Some(asked) = SetpointKind::of(&setpoint).filter(|&kind| !allowed.contains(kind)) {
            return Err(InvalidSetpoint::NotAllowed { asked, allowed });
        }
        let goes_on = match (&setpoint, &self.resolved, &self.asked) {
            (Setpoint::Trajectory(new), Resolved::Path(follower), _) => {
                *new == *follower.trajectory()
            }
            (Setpoint::AttitudeRate { .. }, Resolved::Attitude(_), _)
            | (Setpoint::TakeOff, _, Some(Setpoint::TakeOff)) => true,
            _ => false,
        };
        if !goes_on {
            self.resolved = Resolved::Nothing;
        }
        self.asked = Some(setpoint);
        self.asked_at = now;
        self.restarting_until = None;
        Ok(())
    }

    /// Takes note that the plugin answered an image at `now` without a setpoint: a trajectory that
    /// is not over stays in force.
    pub fn answered(&mut self, now: HostTime) {
        let is_under_way = match (&self.asked, &self.resolved) {
            (Some(Setpoint::Trajectory(_)), Resolved::Path(follower)) => !follower.is_over(),
            (Some(Setpoint::Trajectory(_)), _) => true,
            _ => false,
        };
        if is_under_way {
            self.asked_at = now;
        }
    }

    /// Lands now. Final.
    pub fn land(&mut self) {
        self.landing.get_or_insert(LandReason::Ordered);
    }

    /// Holds until the plugin, being started again, asks for something; lands if it does not within
    /// [`RESTART_WITHIN_S`].
    pub fn wait_for_plugin(&mut self, now: HostTime) {
        (self.asked, self.asked_at) = (None, now);
        self.resolved = Resolved::Nothing;
        self.restarting_until = Some(now.plus_seconds(RESTART_WITHIN_S));
    }

    /// Brakes, then lands. Final; [`Self::land`] still cuts the braking short.
    pub fn brake_and_land(&mut self, now: HostTime) {
        self.ending_until.get_or_insert(now.plus_seconds(BRAKE_AT_MOST_S));
    }

    /// Whether the fence keeps the vehicle from what the plugin asks for.
    pub fn fence_stops(&self) -> bool {
        self.fence_stops
    }

    /// Decides what to send at `now`, with the newest `fix`.
    pub fn tick(&mut self, now: HostTime, fix: &Fix) -> (Passed, Stance) {
        let dt_s = now.seconds_since(self.ticked_at).clamp(0.0, LONGEST_TICK_S);
        self.ticked_at = now;
        let stance = self.stance(now, fix);
        let v_target = match stance {
            Stance::Landing(reason) => {
                self.landing = Some(reason);
                return (Passed::Land, stance);
            }
            Stance::Holding(reason) => {
                if let Resolved::Attitude(_) = self.resolved {
                    // It went its own way meanwhile.
                    self.resolved = Resolved::Nothing;
                }
                self.hold(fix, reason)
            }
            Stance::Passing => {
                self.hold_point_m = None;
                self.wanted(fix, dt_s)
            }
        };
        let slew_mps = self.max_acceleration_mps2 * dt_s;
        let v_target = v_target.clamp_length_max(self.max_speed_mps);
        let change = (v_target - self.v_command_mps).clamp_length_max(slew_mps);
        let v_slewed = self.v_command_mps + change;
        // Where the vehicle is now, not when the pose was measured.
        let age_s = now.seconds_since(fix.stamp).clamp(0.0, EXTRAPOLATED_S);
        let p_now = fix.p_world_m + fix.v_world_mps * age_s;
        // The fence comes last: where it and the slew limit disagree, it wins.
        let v_inside = self.fence.limit(p_now, v_slewed);
        self.fence_stops =
            stance == Stance::Passing && (v_inside - v_slewed).length() > FENCE_STOPS_MPS;
        self.v_command_mps = v_inside.clamp_length_max(self.max_speed_mps);
        let motion = GuidedMotion::Velocity(self.v_command_mps);
        (Passed::Guided(GuidedSetpoint { motion, yaw: self.yaw }), stance)
    }

    fn stance(&self, now: HostTime, fix: &Fix) -> Stance {
        if let Some(reason) = self.landing {
            return Stance::Landing(reason);
        }
        let pose_age_s = now.seconds_since(fix.stamp);
        if pose_age_s > self.pose_ages.land_after_s {
            return Stance::Landing(LandReason::PoseLost(pose_age_s));
        }
        let outside_m = self.fence.outside_m(fix.p_world_m);
        if outside_m > 0.0 {
            return Stance::Landing(LandReason::OutsideFence(outside_m));
        }
        let inside_m = self.fence.inside_no_fly_m(fix.p_world_m);
        if inside_m > 0.0 {
            return Stance::Landing(LandReason::InNoFly(inside_m));
        }
        if let Some(until) = self.ending_until {
            if now >= until || fix.v_world_mps.length() < STOPPED_MPS {
                return Stance::Landing(LandReason::Ordered);
            }
            return Stance::Holding(HoldReason::Ending);
        }
        if let Some(until) = self.restarting_until {
            return match pose_age_s > self.pose_ages.hold_after_s {
                _ if now >= until => Stance::Landing(LandReason::NoPlugin),
                true => Stance::Holding(HoldReason::PoseStale),
                false => Stance::Holding(HoldReason::Restarting),
            };
        }
        let silent_s = now.seconds_since(self.asked_at);
        if silent_s > SETPOINT_LAND_S {
            return Stance::Landing(LandReason::NoSetpoint(silent_s));
        }
        if pose_age_s > self.pose_ages.hold_after_s {
            return Stance::Holding(HoldReason::PoseStale);
        }
        if silent_s > SETPOINT_HOLD_S {
            return Stance::Holding(HoldReason::NoSetpoint);
        }
        match self.asked {
            None | Some(Setpoint::Hold) => Stance::Holding(HoldReason::Asked),
            Some(Setpoint::Land) => Stance::Landing(LandReason::Asked),
            Some(_) => Stance::Passing,
        }
    }

    /// Returns the velocity that stops the vehicle and keeps it where it stopped. [m/s, world]
    fn hold(&mut self, fix: &Fix, reason: HoldReason) -> DVec3 {
        self.turn(fix, YawTarget::Keep);
        if reason == HoldReason::PoseStale {
            // Blind: zero velocity is held by the autopilot's own estimate.
            self.hold_point_m = None;
            return DVec3::ZERO;
        }
        let stopped =
            self.v_command_mps.length() < STOPPED_MPS && fix.v_world_mps.length() < STOPPED_MPS;
        if self.hold_point_m.is_none() && stopped {
            self.hold_point_m = Some(fix.p_world_m);
        }
        match self.hold_point_m {
            Some(p_m) => (POSITION_GAIN_PER_S * (p_m - fix.p_world_m)).clamp_length_max(RETURN_MPS),
            None => DVec3::ZERO,
        }
    }

    /// Returns the velocity that the plugin's setpoint amounts to, before the limits, and sets
    /// the heading. [m/s, world]
    fn wanted(&mut self, fix: &Fix, dt_s: f64) -> DVec3 {
        let in_world = |v: DVec3, axes: Axes| match axes {
            Axes::World => v,
            Axes::Heading => DQuat::from_rotation_z(fix.yaw_rad()) * v,
            Axes::Body => fix.rotation * v,
        };
        let (v_target, yaw) = match self.asked.as_ref() {
            None | Some(Setpoint::Hold | Setpoint::Land) => (DVec3::ZERO, YawTarget::Keep),
            Some(&Setpoint::Velocity { v_mps, axes, yaw }) => (in_world(v_mps, axes), yaw),
            Some(&Setpoint::Position { p_world_m, yaw }) => (self.towards(fix, p_world_m), yaw),
            Some(&Setpoint::Acceleration { a_mps2, axes, yaw }) => {
                (self.accelerated(in_world(a_mps2, axes), dt_s), yaw)
            }
            Some(&Setpoint::Offset { d_m, axes, yaw }) => {
                let p_m = self.point_or(fix.p_world_m + in_world(d_m, axes));
                (self.towards(fix, p_m), yaw)
            }
            Some(&Setpoint::TakeOff) => {
                let p_m = self.point_or(fix.p_world_m.with_z(self.take_off_z_m));
                (self.towards(fix, p_m), YawTarget::Keep)
            }
            Some(&Setpoint::AttitudeRate { omega_body_radps, thrust }) => {
                self.rotated(fix, omega_body_radps, thrust, dt_s)
            }
            Some(Setpoint::Trajectory(trajectory)) => {
                if !matches!(self.resolved, Resolved::Path(_)) {
                    let start = Start { p_world_m: fix.p_world_m, rotation: fix.rotation };
                    let follower = Follower::new(trajectory.clone(), &start);
                    self.resolved = Resolved::Path(Box::new(follower));
                }
                self.follow(fix, dt_s)
            }
        };
        self.turn(fix, yaw);
        v_target
    }

    /// Returns the point that the setpoint in force was resolved to; `p_m` if this is its first
    /// tick. [m, world]
    fn point_or(&mut self, p_m: DVec3) -> DVec3 {
        if let Resolved::Point(resolved_m) = self.resolved {
            return resolved_m;
        }
        self.resolved = Resolved::Point(p_m);
        p_m
    }

    /// Returns the velocity that an acceleration of `a_mps2` leads to. [m/s, world]
    fn accelerated(&self, a_mps2: DVec3, dt_s: f64) -> DVec3 {
        self.v_command_mps + a_mps2.clamp_length_max(self.max_acceleration_mps2) * dt_s
    }

    /// Turns the attitude kept for it by the rates, at most [`MOST_TILT_RAD`] from level; returns
    /// the velocity that it and the thrust lead to, and its heading. [m/s, world]
    fn rotated(
        &mut self,
        fix: &Fix,
        omega_body_radps: DVec3,
        thrust: f64,
        dt_s: f64,
    ) -> (DVec3, YawTarget) {
        let attitude = match self.resolved {
            Resolved::Attitude(attitude) => attitude,
            _ => fix.rotation,
        };
        let turn = omega_body_radps.clamp_length_max(MAX_RATE_RADPS) * dt_s;
        let turned = (attitude * DQuat::from_scaled_axis(turn)).normalize();
        let up = turned * DVec3::Z;
        let excess_rad = up.angle_between(DVec3::Z) - MOST_TILT_RAD;
        let back = up.cross(DVec3::Z).try_normalize();
        let attitude = match back {
            Some(axis) if excess_rad > 0.0 => DQuat::from_axis_angle(axis, excess_rad) * turned,
            _ => turned,
        };
        self.resolved = Resolved::Attitude(attitude);
        let lift_mps2 = thrust.clamp(0.0, MOST_THRUST) * GRAVITY_MPS2;
        let a_mps2 = attitude * DVec3::Z * lift_mps2 - DVec3::Z * GRAVITY_MPS2;
        (self.accelerated(a_mps2, dt_s), YawTarget::Angle(yaw_of(attitude)))
    }

    /// Returns the velocity that follows the path, and the heading on it. [m/s, world]
    fn follow(&mut self, fix: &Fix, dt_s: f64) -> (DVec3, YawTarget) {
        let limits = (self.max_speed_mps, self.max_acceleration_mps2);
        let (reference, is_over) = match &mut self.resolved {
            Resolved::Path(follower) => {
                (follower.advance(fix.p_world_m, limits, dt_s), follower.is_over())
            }
            _ => return (DVec3::ZERO, YawTarget::Keep),
        };
        let v_mps = reference.v_world_mps + self.towards(fix, reference.p_world_m);
        (v_mps, if is_over { YawTarget::Keep } else { reference.yaw })
    }

    /// Sets the heading to send; it is never left open, as ArduCopter would then turn the nose
    /// into the direction of travel.
    fn turn(&mut self, fix: &Fix, yaw: YawTarget) {
        let kept_yaw_rad = self.kept_yaw_rad.take();
        self.yaw = match yaw {
            YawTarget::Angle(yaw_rad) => YawTarget::Angle(wrap_pi(yaw_rad)),
            YawTarget::Rate(rate_radps) => {
                YawTarget::Rate(rate_radps.clamp(-MAX_YAW_RATE_RADPS, MAX_YAW_RATE_RADPS))
            }
            YawTarget::Keep => {
                let yaw_rad = kept_yaw_rad.unwrap_or(fix.yaw_rad());
                self.kept_yaw_rad = Some(yaw_rad);
                YawTarget::Angle(yaw_rad)
            }
        };
    }

    /// Returns the velocity towards a point, slow enough to stop there with half the
    /// acceleration. [m/s, world]
    fn towards(&self, fix: &Fix, p_world_m: DVec3) -> DVec3 {
        let way_m = p_world_m - fix.p_world_m;
        let distance_m = way_m.length();
        if !(distance_m > 1e-6) {
            return DVec3::ZERO;
        }
        let braking_mps = (self.max_acceleration_mps2 * distance_m).sqrt();
        way_m / distance_m * braking_mps.min(POSITION_GAIN_PER_S * distance_m)
    }
}

impl Fix {
    /// Returns the fix of a localized pose whose stamp is `stamp` on this computer's clock.
    pub fn of(sample: &PoseSample, stamp: HostTime) -> Self {
        Self {
            stamp,
            p_world_m: sample.world_from_body.translation_m,
            v_world_mps: sample.twist.linear_mps,
            rotation: sample.world_from_body.rotation,
        }
    }

    /// Returns the heading from world x, counter-clockwise. [rad]
    pub fn yaw_rad(&self) -> f64 {
        yaw_of(self.rotation)
    }

    /// Whether every number in it is one to work with.
    pub fn is_valid(&self) -> bool {
        self.p_world_m.is_finite()
            && self.v_world_mps.is_finite()
            && self.rotation.is_finite()
            && self.rotation.length_squared() > 0.5
    }
}

/// Returns the acceleration that keeps both limits, of acceleration and of tilt: thrust that makes
/// up for gravity and accelerates by `a` in the worst direction leans by asin(a / g). [m/s^2]
fn acceleration_within_tilt_mps2(limits: &Limits) -> f64 {
    let by_tilt = |tilt_deg: f64| GRAVITY_MPS2 * tilt_deg.to_radians().sin() / FENCE_EXCESS;
    let by_tilt_mps2 = limits.max_tilt_deg.map_or(f64::INFINITY, by_tilt);
    limits.max_acceleration_mps2.min(by_tilt_mps2)
}

/// Bounds every component, so that no product of two overflows to infinity. A million metres is
/// beyond any fence, a million metres a second beyond any limit.
fn bounded(setpoint: Setpoint) -> Setpoint {
    let bound = |v: DVec3| v.clamp(DVec3::splat(-1e6), DVec3::splat(1e6));
    match setpoint {
        Setpoint::Hold | Setpoint::Land | Setpoint::TakeOff => setpoint,
        Setpoint::AttitudeRate { omega_body_radps, thrust } => {
            Setpoint::AttitudeRate { omega_body_radps: bound(omega_body_radps), thrust }
        }
        Setpoint::Offset { d_m, axes, yaw } => Setpoint::Offset { d_m: bound(d_m), axes, yaw },
        Setpoint::Trajectory(mut trajectory) => {
            match &mut trajectory.path {
                Path::Waypoints(points) => {
                    for point in points {
                        point.p_m = bound(point.p_m);
                        point.speed_mps = point.speed_mps.min(1e6);
                    }
                }
                Path::Polynomial(pieces) => {
                    for piece in pieces {
                        piece.seconds = piece.seconds.min(1e6);
                        piece.coefficients = piece.coefficients.map(bound);
                    }
                }
            }
            Setpoint::Trajectory(trajectory)
        }
        Setpoint::Position { p_world_m, yaw } => {
            Setpoint::Position { p_world_m: bound(p_world_m), yaw }
        }
        Setpoint::Velocity { v_mps, axes, yaw } => {
            Setpoint::Velocity { v_mps: bound(v_mps), axes, yaw }
        }
        Setpoint::Acceleration { a_mps2, axes, yaw } => {
            Setpoint::Acceleration { a_mps2: bound(a_mps2), axes, yaw }
        }
    }
}

/// Checks that limits and fence are such that the guard can keep them.
///
/// # Errors
/// One sentence that names the setting.
pub fn check_arena(arena: &ArenaInfo) -> Result<(), String> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    if !arena.geofence.is_valid() {
        return Err("arena: geofence is not a volume".into());
    }
    if !arena.no_fly.iter().all(Volume::is_valid) || !arena.floor_z_m.is_finite() {
        return Err("arena: no_fly must be volumes, and floor_z_m a number".into());
    }
    if !positive(arena.limits.max_speed_mps) || !positive(arena.limits.max_acceleration_mps2) {
        return Err("arena: limits must be positive numbers".into());
    }
    if arena.limits.max_tilt_deg.is_some_and(|tilt_deg| !(1.0..=90.0).contains(&tilt_deg)) {
        return Err("arena: limits.max_tilt_deg must be within 1 to 90 degrees".into());
    }
    if let Some(ceiling_m) = arena.limits.max_altitude_m
        && !(ceiling_m.is_finite() && ceiling_m > arena.takeoff_height_m)
    {
        return Err(format!(
            "limits.max_altitude_m = {ceiling_m}: the take-off alone rises to {} m; allow more",
            arena.takeoff_height_m
        ));
    }
    if !(arena.body_radius_m.is_finite() && arena.body_radius_m >= 0.0) {
        return Err("arena: body_radius_m must be a number, 0 or more".into());
    }
    if !positive(arena.takeoff_height_m) {
        return Err("arena: takeoff_height_m must be a positive number".into());
    }
    let PoseAges { hold_after_s, land_after_s } = arena.pose_ages;
    if !(positive(hold_after_s) && land_after_s.is_finite() && land_after_s > hold_after_s) {
        return Err("arena: pose.land_after_s must exceed pose.hold_after_s, both positive".into());
    }
    if let Volume::Cuboid { half_m, .. } = arena.geofence
        && half_m.min_element() <= arena.body_radius_m
    {
        return Err("arena: geofence is too small for the body".into());
    }
    Ok(())
}
