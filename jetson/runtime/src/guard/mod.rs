//! Checks and limits every setpoint before it is sent. Pure: state, `now` and the vehicle's motion in; one
//! command out.
//!
//! Called at 50 to 200 Hz by [`flight`](crate::flight) while the plugin flies. In this order:
//! 1. a landing, once begun, is never taken back;
//! 2. deadlines: a pose older than the arena's `hold_after_s`, no setpoint for 0.5 s, or a setpoint by images older
//!    than 0.7 s, holds; a pose older than `land_after_s`, no setpoint for 2 s, or 2 s of such images, lands;
//! 3. the plugin's setpoint becomes a velocity in world axes (positions by a braking profile,
//!    accelerations by integration, attitude rates by the acceleration that the attitude means,
//!    trajectories by a moving point); numbers that are not finite were refused at [`Guard::handle_setpoint`];
//! 4. speed limit, which falls with the age of what the plugin sees and with the lag of the vehicle, acceleration limit
//!    (which also bounds tilt), then the geofence, the ceiling, the floor and the no-fly boxes: never faster towards a face
//!    than the vehicle can stop before it, by how it is seen to answer.
//!
//! Everything leaves as a velocity, so that one slew limit and one fence rule bound all motion.

mod fence;
mod limits;
mod response;
mod slip;
#[cfg(test)]
mod tests;
mod velocity;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    ArenaInfo, InvalidSetpoint, PoseAges, PoseSample, Setpoint, SetpointKind, SetpointKinds,
    YawTarget,
};
use vizflyt_protocol::time::HostTime;

use fence::{Fence, MARGIN_M, Momentum};
use limits::FENCE_EXCESS;
pub use limits::check_arena;
use response::Answers;
pub use response::Response;
use slip::Slip;
use velocity::Resolved;

/// The motion of the vehicle at one instant, as localization gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VehicleMotion {
    /// When this was true. [host]
    pub stamp: HostTime,
    /// Position of the body's centre. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Attitude: body to world.
    pub rotation: DQuat,
    /// How far the position may be off, one standard deviation along the worst axis; 0 is not known. [m]
    pub sigma_m: f64,
    /// How much older it may grow than [`PoseAges`] say. [s]
    pub allowance_s: f64,
}

impl VehicleMotion {
    /// Returns the motion of a localized pose whose stamp is `stamp` on this computer's clock.
    pub fn of(sample: &PoseSample, stamp: HostTime) -> Self {
        Self {
            stamp,
            p_world_m: sample.world_from_body.translation_m,
            v_world_mps: sample.twist.linear_mps,
            rotation: sample.world_from_body.rotation,
            sigma_m: f64::from(sample.position_sigma_m.max_element()),
            allowance_s: f64::from(sample.allowance_s),
        }
    }

    /// Returns the age of the pose. [s]
    pub fn age_s(&self, now: HostTime) -> f64 {
        now.seconds_since(self.stamp)
    }

    /// Returns what [`PoseAges`] bound: its age beyond what its source always delays and leaves out. [s]
    pub fn overdue_s(&self, now: HostTime) -> f64 {
        self.age_s(now) - self.allowance_s
    }

    /// Returns the heading from world x, counter-clockwise. [rad]
    pub fn yaw_rad(&self) -> f64 {
        yaw_of(self.rotation)
    }

    /// Returns how far the position may be off: [`UNSURE_SIGMAS`] along the worst axis. [m]
    pub fn off_m(&self) -> f64 {
        UNSURE_SIGMAS * self.sigma_m
    }

    /// Whether every number is finite and the rotation is one.
    pub fn is_valid(&self) -> bool {
        self.p_world_m.is_finite()
            && self.v_world_mps.is_finite()
            && self.rotation.is_finite()
            && self.rotation.length_squared() > 0.5
    }
}

/// The output of the guard for one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GuardOutput {
    /// Fly this setpoint.
    Guided(GuidedSetpoint),
    /// Land now.
    Land,
}

/// Why the vehicle is held in place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HoldReason {
    /// The plugin requested it.
    Requested,
    /// No setpoint has come for [`SETPOINT_HOLD_S`].
    NoSetpoint,
    /// The newest pose is overdue by more than [`PoseAges::hold_after_s`].
    PoseStale,
    /// The pose may be off by more than the guard keeps from the fence: [`UNSURE_SIGMAS`].
    PoseUnsure,
    /// What the plugin has answered last is older than [`SIGHT_HOLD_S`].
    ImagesOld,
    /// The plugin is being started again.
    Restarting,
    /// The flight is over; it brakes before it lands.
    Ending,
}

/// Why the guard lands by itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LandReason {
    /// The plugin requested it.
    Requested,
    /// No setpoint has come for so long. [s]
    NoSetpoint(f64),
    /// A plugin that was to be started again has not answered within [`RESTART_WITHIN_S`].
    NoPlugin,
    /// The newest pose is so old. [s]
    PoseLost(f64),
    /// The pose has been too unsure for as long as it may be away; how far it may be off. [m]
    PoseUnsure(f64),
    /// What the plugin has answered last has been too old for [`SIGHT_LAND_S`]; now it is so old. [s]
    ImagesOld(f64),
    /// The body is outside the fence by so much. [m]
    OutsideFence(f64),
    /// The body reaches into a no-fly box by so much. [m]
    InNoFly(f64),
    /// The caller of [`Guard::land`] or [`Guard::brake_and_land`] has its own reason.
    Ordered,
}

/// The mode of the guard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GuardMode {
    /// Follows the plugin's setpoints, within the limits.
    Following,
    /// Stops and stays.
    Holding(HoldReason),
    /// Lands; final.
    Landing(LandReason),
}

/// So many standard deviations of the pose must fit into what the guard keeps from the fence: hold; for `land_after_s`: land.
pub const UNSURE_SIGMAS: f64 = 3.0;
/// No setpoint for this long: hold. A plugin at 10 Hz may miss four images. [s]
pub const SETPOINT_HOLD_S: f64 = 0.5;
/// No setpoint for this long: land. [s]
pub const SETPOINT_LAND_S: f64 = 2.0;
/// A plugin that is started again may take so long until its first setpoint: an interpreter that
/// loads numpy and a small model. [s]
pub const RESTART_WITHIN_S: f64 = 10.0;

/// What the plugin sees may be so old at full speed: four images of a 30 Hz camera. Beyond, the speed limit falls as
/// the age rises, so that in this age no more way is flown. [s]
pub const SIGHT_FRESH_S: f64 = 0.15;
/// What the plugin has answered last is older than this: hold. More than [`SETPOINT_HOLD_S`], so that a silent plugin
/// is named as one. [s]
pub const SIGHT_HOLD_S: f64 = 0.7;
/// And for this long: land. [s]
pub const SIGHT_LAND_S: f64 = 2.0;

/// Up to this lag a vehicle is flown at the full speed limit; beyond, the limit falls as the lag rises. [s]
pub const LAG_USUAL_S: f64 = 0.5;

/// A plugin's commands may change by so much for any vehicle. [m/s^2]
const LEAST_FOLLOWED_MPS2: f64 = 1.0;
/// A share of the speed limit that is reported when images bring it down to less.
const SLOWED_NOTICE: f64 = 0.8;
/// Maximum time over which a pose is extrapolated by its velocity. [s]
const MAX_EXTRAPOLATION_S: f64 = 0.5;
/// A speed below which the vehicle counts as stopped. [m/s]
const STOPPED_MPS: f64 = 0.3;
/// Maximum time of braking before an orderly landing. [s]
const MAX_BRAKING_S: f64 = 2.0;
/// Minimum reduction of speed by the fence that is reported. [m/s]
const FENCE_NOTICE_MPS: f64 = 0.1;
/// Maximum time between two ticks that counts; after a stall the slew limit must not open. [s]
const MAX_TICK_S: f64 = 0.1;

/// The vehicle flies slower than the plugin asks, because of old images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slowed {
    /// Age of what the plugin has answered last. [s]
    pub age_s: f64,
    /// What is left of the speed limit, 0 to 1.
    pub share: f64,
}

/// The vehicle flies slower than the plugin may, because it answers late.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lagging {
    /// How it answers.
    pub response: Response,
    /// Seen in this flight; else it is what the autopilot's parameters say, or nothing is known.
    pub measured: bool,
    /// What is left of the speed limit, 0 to 1.
    pub share: f64,
}

/// The guard of one flight.
#[derive(Clone, Debug)]
pub struct Guard {
    rules: Rules,
    sight: Sight,
    request: Request,
    command: Command,
    end: End,
}

/// What holds for the whole flight.
#[derive(Clone, Debug)]
struct Rules {
    fence: Fence,
    max_speed_mps: f64,
    /// Bounds acceleration, and by it the tilt.
    max_acceleration_mps2: f64,
    /// Height of the vehicle when the plugin took over. [m, world]
    take_off_z_m: f64,
    /// Kinds of setpoint that the course permits.
    allowed: SetpointKinds,
    pose_ages: PoseAges,
}

/// How well the plugin sees, and how well the vehicle answers.
#[derive(Clone, Debug)]
struct Sight {
    /// The speed limit that the age of the plugin's images leaves.
    speed_limit_mps: f64,
    /// When the pose behind the image that the plugin has answered last was measured; `None` if unknown.
    seen_at: Option<HostTime>,
    /// Since when that image has been too old.
    blind_since: Option<HostTime>,
    /// Since when the pose has been too uncertain.
    unsure_since: Option<HostTime>,
    slowed: Option<Slowed>,
    /// The vehicle's response to commands.
    answers: Answers,
}

/// The plugin's newest setpoint.
#[derive(Clone, Debug)]
struct Request {
    setpoint: Option<Setpoint>,
    /// `setpoint` in the world, once the vehicle's position was known.
    resolved: Resolved,
    /// The drift added to positions where the course withholds the pose.
    slip: Option<Slip>,
    /// When the setpoint came, or the plugin took over.
    at: HostTime,
}

/// The newest command to the autopilot.
#[derive(Clone, Debug)]
struct Command {
    /// The slew limit counts from it. [m/s, world]
    v_world_mps: DVec3,
    /// Heading to send: an angle or a rate.
    yaw: YawTarget,
    /// The heading that [`YawTarget::Keep`] keeps, from when it was first requested. [rad]
    kept_yaw_rad: Option<f64>,
    hold_point_m: Option<DVec3>,
    /// When it was made.
    at: HostTime,
    /// Whether the fence limited it.
    fence_stops: bool,
}

/// How the flight ends, once it does.
#[derive(Clone, Debug, Default)]
struct End {
    /// Set when the flight is to end in order: when braking ends.
    ending_until: Option<HostTime>,
    /// Set while the plugin is started again: when the wait ends.
    restarting_until: Option<HostTime>,
    landing: Option<LandReason>,
}

impl Guard {
    /// Makes the guard of a flight in `arena` that takes over the vehicle at `now`, which answers as `response` says, by its
    /// parameters, if they are known. Of `slip_seed` depends where places slip that a plugin gives without knowing the pose.
    pub fn new(
        arena: &ArenaInfo,
        vehicle: &VehicleMotion,
        response: Option<Response>,
        now: HostTime,
        slip_seed: u64,
    ) -> Self {
        let max_acceleration_mps2 = limits::acceleration_within_tilt_mps2(&arena.limits);
        Self {
            rules: Rules {
                fence: Fence::new(arena, max_acceleration_mps2),
                max_speed_mps: arena.limits.max_speed_mps,
                max_acceleration_mps2,
                take_off_z_m: vehicle.p_world_m.z,
                allowed: arena.setpoints,
                pose_ages: arena.pose_ages,
            },
            sight: Sight {
                speed_limit_mps: arena.limits.max_speed_mps,
                seen_at: None,
                blind_since: None,
                unsure_since: None,
                slowed: None,
                answers: Answers::new(response, vehicle.v_world_mps, max_acceleration_mps2),
            },
            request: Request {
                setpoint: None,
                resolved: Resolved::Nothing,
                slip: (!arena.ground_truth).then(|| Slip::new(slip_seed)),
                at: now,
            },
            command: Command {
                v_world_mps: vehicle.v_world_mps.clamp_length_max(arena.limits.max_speed_mps),
                yaw: YawTarget::Angle(vehicle.yaw_rad()),
                kept_yaw_rad: Some(vehicle.yaw_rad()),
                hold_point_m: None,
                at: now,
                fence_stops: false,
            },
            end: End::default(),
        }
    }

    /// Takes a setpoint of the plugin at `now`.
    ///
    /// # Errors
    /// Why it is refused, as for a number that is not finite; it then does not count against the
    /// deadline.
    pub fn handle_setpoint(
        &mut self,
        now: HostTime,
        setpoint: Setpoint,
    ) -> Result<(), InvalidSetpoint> {
        setpoint.check()?;
        let setpoint = limits::bound_components(setpoint);
        let allowed = self.rules.allowed;
        if let Some(asked) = SetpointKind::of(&setpoint).filter(|&kind| !allowed.contains(kind)) {
            return Err(InvalidSetpoint::NotAllowed { asked, allowed });
        }
        if self.request.slip.is_some() && setpoint.is_in_world_axes() {
            return Err(InvalidSetpoint::WorldAxes);
        }
        let goes_on = match (&setpoint, &self.request.resolved, &self.request.setpoint) {
            (Setpoint::Trajectory(new), Resolved::Path(follower), _) => {
                *new == *follower.trajectory()
            }
            (Setpoint::AttitudeRate { .. }, Resolved::Attitude(_), _)
            | (Setpoint::TakeOff, _, Some(Setpoint::TakeOff)) => true,
            _ => false,
        };
        if !goes_on {
            self.request.resolved = Resolved::Nothing;
            self.request.slip.iter_mut().for_each(Slip::restart);
        }
        self.request.setpoint = Some(setpoint);
        self.request.at = now;
        self.end.restarting_until = None;
        Ok(())
    }

    /// Takes note that the plugin replied to an image at `now` without a setpoint: a trajectory that
    /// is not over stays in force.
    pub fn handle_empty_reply(&mut self, now: HostTime) {
        let is_under_way = match (&self.request.setpoint, &self.request.resolved) {
            (Some(Setpoint::Trajectory(_)), Resolved::Path(follower)) => !follower.is_over(),
            (Some(Setpoint::Trajectory(_)), _) => true,
            _ => false,
        };
        if is_under_way {
            self.request.at = now;
        }
    }

    /// Lands now. Final.
    pub fn land(&mut self) {
        self.end.landing.get_or_insert(LandReason::Ordered);
    }

    /// Holds until the plugin, being started again, sends a setpoint; lands if it does not within
    /// [`RESTART_WITHIN_S`].
    pub fn wait_for_plugin(&mut self, now: HostTime) {
        (self.request.setpoint, self.request.at) = (None, now);
        self.request.resolved = Resolved::Nothing;
        self.end.restarting_until = Some(now.plus_seconds(RESTART_WITHIN_S));
    }

    /// Brakes, then lands. Final; [`Self::land`] still cuts the braking short.
    pub fn brake_and_land(&mut self, now: HostTime) {
        self.end.ending_until.get_or_insert(now.plus_seconds(MAX_BRAKING_S));
    }

    /// Takes when the pose was measured behind what the plugin has answered last: speed falls with its age. `None`
    /// leaves it as it is.
    pub fn see(&mut self, seen_at: Option<HostTime>) {
        self.sight.seen_at = seen_at.or(self.sight.seen_at);
    }

    /// Returns how old images slow down the plugin's setpoint, if much.
    pub fn slowed(&self) -> Option<Slowed> {
        self.sight.slowed
    }

    /// Returns how the vehicle answers, if that lowers the speed limit.
    pub fn lagging(&self) -> Option<Lagging> {
        let (response, measured) =
            (self.sight.answers.response(), self.sight.answers.is_measured());
        let share = share_of_lag(response);
        (share < 1.0).then_some(Lagging { response, measured, share })
    }

    /// Whether the fence limits the plugin's setpoint.
    pub fn fence_stops(&self) -> bool {
        self.command.fence_stops
    }

    /// Returns what to send at `now`, from the newest motion of the vehicle, and the mode.
    pub fn tick(&mut self, now: HostTime, vehicle: &VehicleMotion) -> (GuardOutput, GuardMode) {
        let dt_s = now.seconds_since(self.command.at).clamp(0.0, MAX_TICK_S);
        self.command.at = now;
        self.request.slip.iter_mut().for_each(|slip| slip.advance(vehicle.p_world_m));
        let sight_age_s = self.sight.seen_at.map_or(0.0, |at| now.seconds_since(at));
        let share = if sight_age_s > SIGHT_FRESH_S { SIGHT_FRESH_S / sight_age_s } else { 1.0 };
        self.sight.answers.watch(self.command.v_world_mps, vehicle.v_world_mps, dt_s);
        let response = self.sight.answers.response();
        self.sight.speed_limit_mps = self.rules.max_speed_mps * share * share_of_lag(response);
        let is_unsure = vehicle.off_m() > MARGIN_M;
        self.sight.unsure_since = is_unsure.then(|| self.sight.unsure_since.unwrap_or(now));
        self.sight.blind_since =
            (sight_age_s > SIGHT_HOLD_S).then(|| self.sight.blind_since.unwrap_or(now));
        let mode = self.mode(now, vehicle);
        let v_target = match mode {
            GuardMode::Landing(reason) => {
                self.end.landing = Some(reason);
                return (GuardOutput::Land, mode);
            }
            GuardMode::Holding(reason) => {
                if let Resolved::Attitude(_) = self.request.resolved {
                    // The vehicle's attitude changes while it is held.
                    self.request.resolved = Resolved::Nothing;
                }
                self.hold_velocity(vehicle, reason)
            }
            GuardMode::Following => {
                self.command.hold_point_m = None;
                self.setpoint_velocity(vehicle, dt_s)
            }
        };
        let slew_mps = self.rules.max_acceleration_mps2 * dt_s;
        let is_slowed = mode == GuardMode::Following
            && share < SLOWED_NOTICE
            && v_target.length() > self.sight.speed_limit_mps;
        self.sight.slowed = is_slowed.then_some(Slowed { age_s: sight_age_s, share });
        let v_target = v_target.clamp_length_max(self.sight.speed_limit_mps);
        // A turn waits for a vehicle that cannot follow it: what it has to change along a face is missing for stopping
        // before it. To slow down, all that is allowed is asked for.
        let followed_mps2 = response.acceleration_mps2.max(LEAST_FOLLOWED_MPS2);
        let slows = v_target.length() < self.command.v_world_mps.length();
        let asked_mps = if slows { slew_mps } else { slew_mps.min(followed_mps2 * dt_s) };
        let change = (v_target - self.command.v_world_mps).clamp_length_max(asked_mps);
        let v_slewed = self.command.v_world_mps + change;
        // Where the vehicle is now, not when the pose was measured.
        let age_s = vehicle.age_s(now).clamp(0.0, MAX_EXTRAPOLATION_S);
        let p_now = vehicle.p_world_m + vehicle.v_world_mps * age_s;
        // The fence comes last: where it and the slew limit disagree, it wins, at flat faces within bounds.
        let (v_mps, a_mps2) = (vehicle.v_world_mps, self.sight.answers.a_mps2());
        let momentum = Momentum { v_mps, a_mps2, response };
        let v_inside = self.within_bounds(p_now, v_slewed, &momentum, slew_mps);
        self.command.fence_stops = mode == GuardMode::Following
            && v_inside != v_slewed
            && (v_target - v_inside).length() > FENCE_NOTICE_MPS;
        self.command.v_world_mps = v_inside.clamp_length_max(self.rules.max_speed_mps);
        let motion = GuidedMotion::Velocity(self.command.v_world_mps);
        (GuardOutput::Guided(GuidedSetpoint { motion, yaw: self.command.yaw }), mode)
    }

    /// Returns what the fence leaves of `v_slewed` [m/s, world]. At flat faces it takes back speed by [`FENCE_EXCESS`] of
    /// the slew limit at most, and what it takes back goes before what the plugin wants.
    fn within_bounds(
        &self,
        p_m: DVec3,
        v_slewed: DVec3,
        momentum: &Momentum,
        slew_mps: f64,
    ) -> DVec3 {
        let v_inside = self.rules.fence.limit(p_m, v_slewed, momentum);
        let (change, most) = (v_inside - self.command.v_world_mps, FENCE_EXCESS * slew_mps);
        if change.length() <= most || !self.rules.fence.is_flat() {
            return v_inside;
        }
        let v_braked = self.rules.fence.limit(p_m, self.command.v_world_mps, momentum);
        let braking = (v_braked - self.command.v_world_mps).clamp_length_max(most);
        let rest = (change - braking).clamp_length_max((most - braking.length()).max(0.0));
        self.command.v_world_mps + braking + rest
    }

    fn mode(&self, now: HostTime, vehicle: &VehicleMotion) -> GuardMode {
        if let Some(reason) = self.end.landing {
            return GuardMode::Landing(reason);
        }
        let overdue_s = vehicle.overdue_s(now);
        if overdue_s > self.rules.pose_ages.land_after_s {
            return GuardMode::Landing(LandReason::PoseLost(vehicle.age_s(now)));
        }
        if let Some(since) = self.sight.unsure_since
            && now.seconds_since(since) > self.rules.pose_ages.land_after_s
        {
            return GuardMode::Landing(LandReason::PoseUnsure(vehicle.off_m()));
        }
        let outside_m = self.rules.fence.outside_m(vehicle.p_world_m);
        if outside_m > 0.0 {
            return GuardMode::Landing(LandReason::OutsideFence(outside_m));
        }
        let inside_m = self.rules.fence.inside_no_fly_m(vehicle.p_world_m);
        if inside_m > 0.0 {
            return GuardMode::Landing(LandReason::InNoFly(inside_m));
        }
        if let Some(until) = self.end.ending_until {
            if now >= until || vehicle.v_world_mps.length() < STOPPED_MPS {
                return GuardMode::Landing(LandReason::Ordered);
            }
            return GuardMode::Holding(HoldReason::Ending);
        }
        if let Some(until) = self.end.restarting_until {
            return match overdue_s > self.rules.pose_ages.hold_after_s {
                _ if now >= until => GuardMode::Landing(LandReason::NoPlugin),
                true => GuardMode::Holding(HoldReason::PoseStale),
                false => GuardMode::Holding(HoldReason::Restarting),
            };
        }
        let silent_s = now.seconds_since(self.request.at);
        if silent_s > SETPOINT_LAND_S {
            return GuardMode::Landing(LandReason::NoSetpoint(silent_s));
        }
        if overdue_s > self.rules.pose_ages.hold_after_s {
            return GuardMode::Holding(HoldReason::PoseStale);
        }
        if self.sight.unsure_since.is_some() {
            return GuardMode::Holding(HoldReason::PoseUnsure);
        }
        if silent_s > SETPOINT_HOLD_S {
            return GuardMode::Holding(HoldReason::NoSetpoint);
        }
        if let (Some(since), Some(seen_at)) = (self.sight.blind_since, self.sight.seen_at) {
            if now.seconds_since(since) > SIGHT_LAND_S {
                return GuardMode::Landing(LandReason::ImagesOld(now.seconds_since(seen_at)));
            }
            return GuardMode::Holding(HoldReason::ImagesOld);
        }
        match self.request.setpoint {
            None | Some(Setpoint::Hold) => GuardMode::Holding(HoldReason::Requested),
            Some(Setpoint::Land) => GuardMode::Landing(LandReason::Requested),
            Some(_) => GuardMode::Following,
        }
    }
}

/// Returns what is left of the speed limit for a vehicle that answers so, 0 to 1.
fn share_of_lag(response: Response) -> f64 {
    (LAG_USUAL_S / response.lag_s).min(1.0)
}
