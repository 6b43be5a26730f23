//! Checks and limits each setpoint before it is sent. Sans-IO: state, `now` and the vehicle's motion in; one command
//! out.
//!
//! [`flight`](crate::flight) calls the guard at 50 to 200 Hz while the plugin flies. Order of the checks:
//! 1. A landing is final once it has begun.
//! 2. Deadlines. Hold: a pose older than the arena's `hold_after_s`, no setpoint for 0.5 s, or a setpoint computed from
//!    images older than 0.7 s. Land: a pose older than `land_after_s`, no setpoint for 2 s, or 2 s of such images.
//! 3. Convert the plugin's setpoint into a velocity in world axes: positions by a braking profile, accelerations by
//!    integration, attitude rates by the acceleration that the attitude causes, trajectories by a moving point.
//!    [`Guard::handle_setpoint`] has already rejected numbers that are not finite.
//! 4. Speed limit, which falls with the age of the plugin's images and with the lag of the vehicle. Acceleration limit,
//!    which also bounds the tilt. Then geofence, ceiling, floor and no-fly boxes: the speed towards a face is at most
//!    the speed from which the vehicle can stop before it, given its measured response.
//!
//! Every output is a velocity, so that one slew limit and one fence rule bound all motion.

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

/// Localized motion of the vehicle at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VehicleMotion {
    /// Time of the measurement. [host]
    pub stamp: HostTime,
    /// Position of the body's centre. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Attitude: body to world.
    pub rotation: DQuat,
    /// Uncertainty of the position: one standard deviation along the worst axis; 0 if unknown. [m]
    pub sigma_m: f64,
    /// Additional age that is allowed beyond [`PoseAges`]. [s]
    pub allowance_s: f64,
}

impl VehicleMotion {
    /// Returns the motion of a localized pose with the stamp `stamp` on this computer's clock.
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

    /// Returns the age that [`PoseAges`] bound: the pose's age minus the usual delay and gaps of its source. [s]
    pub fn overdue_s(&self, now: HostTime) -> f64 {
        self.age_s(now) - self.allowance_s
    }

    /// Returns the heading from world x, counter-clockwise. [rad]
    pub fn yaw_rad(&self) -> f64 {
        yaw_of(self.rotation)
    }

    /// Returns the possible position error: [`UNSURE_SIGMAS`] along the worst axis. [m]
    pub fn off_m(&self) -> f64 {
        UNSURE_SIGMAS * self.sigma_m
    }

    /// Whether all numbers are finite and the rotation is not degenerate.
    pub fn is_valid(&self) -> bool {
        self.p_world_m.is_finite()
            && self.v_world_mps.is_finite()
            && self.rotation.is_finite()
            && self.rotation.length_squared() > 0.5
    }
}

/// Output of the guard for one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GuardOutput {
    /// Fly this setpoint.
    Guided(GuidedSetpoint),
    /// Land now.
    Land,
}

/// Reason for holding the vehicle in place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HoldReason {
    /// The plugin requested it.
    Requested,
    /// No setpoint has arrived for [`SETPOINT_HOLD_S`].
    NoSetpoint,
    /// The newest pose is overdue by more than [`PoseAges::hold_after_s`].
    PoseStale,
    /// The possible position error exceeds the margin to the fence: [`UNSURE_SIGMAS`].
    PoseUnsure,
    /// The image of the plugin's last reply is older than [`SIGHT_HOLD_S`].
    ImagesOld,
    /// The plugin is restarting.
    Restarting,
    /// The flight is over; the vehicle brakes before it lands.
    Ending,
}

/// Reason for landing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LandReason {
    /// The plugin requested it.
    Requested,
    /// No setpoint has arrived for this long. [s]
    NoSetpoint(f64),
    /// A restarted plugin has not replied within [`RESTART_WITHIN_S`].
    NoPlugin,
    /// Age of the newest pose. [s]
    PoseLost(f64),
    /// The pose has been too uncertain for [`PoseAges::land_after_s`]; possible position error. [m]
    PoseUnsure(f64),
    /// The image of the plugin's last reply has been too old for [`SIGHT_LAND_S`]; its age. [s]
    ImagesOld(f64),
    /// Distance of the body outside the fence. [m]
    OutsideFence(f64),
    /// Depth of the body inside a no-fly box. [m]
    InNoFly(f64),
    /// Reason of the caller of [`Guard::land`] or [`Guard::brake_and_land`].
    Ordered,
}

/// Mode of the guard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GuardMode {
    /// Follows the plugin's setpoints, within the limits.
    Following,
    /// Stops and stays.
    Holding(HoldReason),
    /// Lands; final.
    Landing(LandReason),
}

/// Hold if this many standard deviations of the pose exceed the margin to the fence; land after `land_after_s`.
pub const UNSURE_SIGMAS: f64 = 3.0;
/// Hold without a setpoint for this long. A plugin at 10 Hz may miss four images. [s]
pub const SETPOINT_HOLD_S: f64 = 0.5;
/// Land without a setpoint for this long. [s]
pub const SETPOINT_LAND_S: f64 = 2.0;
/// Maximum time from a plugin's restart to its first setpoint. Python needs some seconds to load numpy and a small
/// model. [s]
pub const RESTART_WITHIN_S: f64 = 10.0;

/// Maximum age of the plugin's images at full speed: four images of a 30 Hz camera. Beyond it, the speed limit falls as
/// the age rises, so that the distance flown within this age stays constant. [s]
pub const SIGHT_FRESH_S: f64 = 0.15;
/// Hold if the image of the plugin's last reply is older than this. Longer than [`SETPOINT_HOLD_S`], so that a silent
/// plugin is reported as silent. [s]
pub const SIGHT_HOLD_S: f64 = 0.7;
/// Land after images have been too old for this long. [s]
pub const SIGHT_LAND_S: f64 = 2.0;

/// Maximum lag at the full speed limit; beyond it, the limit falls as the lag rises. [s]
pub const LAG_USUAL_S: f64 = 0.5;

/// Minimum rate of change that is allowed for a plugin's commands, for every vehicle. [m/s^2]
const LEAST_FOLLOWED_MPS2: f64 = 1.0;
/// Images that reduce the speed limit below this share are reported.
const SLOWED_NOTICE: f64 = 0.8;
/// Maximum time over which a pose is extrapolated by its velocity. [s]
const MAX_EXTRAPOLATION_S: f64 = 0.5;
/// Maximum speed of a stopped vehicle. [m/s]
const STOPPED_MPS: f64 = 0.3;
/// Maximum braking time before an orderly landing. [s]
const MAX_BRAKING_S: f64 = 2.0;
/// Minimum speed reduction by the fence that is reported. [m/s]
const FENCE_NOTICE_MPS: f64 = 0.1;
/// Maximum time step of a tick; a stall must not widen the slew limit. [s]
const MAX_TICK_S: f64 = 0.1;

/// Reduction of the plugin's speed because of old images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slowed {
    /// Age of the image of the plugin's last reply. [s]
    pub age_s: f64,
    /// Remaining share of the speed limit, 0 to 1.
    pub share: f64,
}

/// Reduction of the speed limit because the vehicle responds late.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lagging {
    /// Response of the vehicle.
    pub response: Response,
    /// Measured in this flight; otherwise taken from the autopilot's parameters, or unknown.
    pub measured: bool,
    /// Remaining share of the speed limit, 0 to 1.
    pub share: f64,
}

/// Guard of one flight.
#[derive(Clone, Debug)]
pub struct Guard {
    rules: Rules,
    sight: Sight,
    request: Request,
    command: Command,
    end: End,
}

/// Rules for the whole flight.
#[derive(Clone, Debug)]
struct Rules {
    fence: Fence,
    max_speed_mps: f64,
    /// Also bounds the tilt.
    max_acceleration_mps2: f64,
    /// Height of the vehicle when the plugin took over. [m, world]
    take_off_z_m: f64,
    /// Setpoint kinds that the course allows.
    allowed: SetpointKinds,
    pose_ages: PoseAges,
}

/// Age and quality of the plugin's images and the vehicle's pose, and the vehicle's response.
#[derive(Clone, Debug)]
struct Sight {
    /// Speed limit after the reductions for the age of images and the lag of the vehicle.
    speed_limit_mps: f64,
    /// Time of the pose behind the image of the plugin's last reply; `None` if unknown.
    seen_at: Option<HostTime>,
    /// Time since which that image has been too old.
    blind_since: Option<HostTime>,
    /// Time since which the pose has been too uncertain.
    unsure_since: Option<HostTime>,
    slowed: Option<Slowed>,
    answers: Answers,
}

/// Newest setpoint of the plugin.
#[derive(Clone, Debug)]
struct Request {
    setpoint: Option<Setpoint>,
    /// `setpoint` in world coordinates, resolved at its first tick.
    resolved: Resolved,
    /// Drift added to positions if the course withholds the pose.
    slip: Option<Slip>,
    /// Time of the setpoint, or of the start of the plugin's control.
    at: HostTime,
}

/// Newest command to the autopilot.
#[derive(Clone, Debug)]
struct Command {
    /// Reference of the slew limit. [m/s, world]
    v_world_mps: DVec3,
    /// Heading to send: an angle or a rate.
    yaw: YawTarget,
    /// Heading that [`YawTarget::Keep`] keeps, set at its first request. [rad]
    kept_yaw_rad: Option<f64>,
    hold_point_m: Option<DVec3>,
    /// Time of the command.
    at: HostTime,
    /// Whether the fence limited the command.
    fence_stops: bool,
}

/// End of the flight.
#[derive(Clone, Debug, Default)]
struct End {
    /// End of braking, in an orderly end.
    ending_until: Option<HostTime>,
    /// End of the wait for a restarting plugin.
    restarting_until: Option<HostTime>,
    landing: Option<LandReason>,
}

impl Guard {
    /// Creates the guard of a flight in `arena` that takes over the vehicle at `now`. `response` is the vehicle's
    /// response according to its parameters, if known. `slip_seed` seeds the drift added to positions when the course
    /// hides the pose.
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

    /// Accepts a setpoint of the plugin at `now`.
    ///
    /// # Errors
    /// Returns why the setpoint is rejected, for example a number that is not finite. A rejected setpoint does not
    /// reset the deadline.
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

    /// Records that the plugin replied to an image at `now` without a setpoint: an unfinished trajectory stays in
    /// force.
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

    /// Lands now. This is final.
    pub fn land(&mut self) {
        self.end.landing.get_or_insert(LandReason::Ordered);
    }

    /// Holds until the restarting plugin sends a setpoint; lands if none arrives within [`RESTART_WITHIN_S`].
    pub fn wait_for_plugin(&mut self, now: HostTime) {
        (self.request.setpoint, self.request.at) = (None, now);
        self.request.resolved = Resolved::Nothing;
        self.end.restarting_until = Some(now.plus_seconds(RESTART_WITHIN_S));
    }

    /// Brakes, then lands. This is final; [`Self::land`] ends the braking.
    pub fn brake_and_land(&mut self, now: HostTime) {
        self.end.ending_until.get_or_insert(now.plus_seconds(MAX_BRAKING_S));
    }

    /// Sets the measurement time of the pose behind the image of the plugin's last reply; the speed limit falls with
    /// its age. `None` keeps the last value.
    pub fn see(&mut self, seen_at: Option<HostTime>) {
        self.sight.seen_at = seen_at.or(self.sight.seen_at);
    }

    /// Returns how much old images reduce the plugin's speed, if significantly.
    pub fn slowed(&self) -> Option<Slowed> {
        self.sight.slowed
    }

    /// Returns the vehicle's response, if it lowers the speed limit.
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

    /// Returns the command to send at `now`, and the mode, from the newest motion of the vehicle.
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
        // Change direction only as fast as the vehicle can follow: acceleration along a face reduces the acceleration
        // left for stopping before it. Slowing down may use the full limit.
        let followed_mps2 = response.acceleration_mps2.max(LEAST_FOLLOWED_MPS2);
        let slows = v_target.length() < self.command.v_world_mps.length();
        let asked_mps = if slows { slew_mps } else { slew_mps.min(followed_mps2 * dt_s) };
        let change = (v_target - self.command.v_world_mps).clamp_length_max(asked_mps);
        let v_slewed = self.command.v_world_mps + change;
        // Extrapolate from the measurement of the pose to the present.
        let age_s = vehicle.age_s(now).clamp(0.0, MAX_EXTRAPOLATION_S);
        let p_now = vehicle.p_world_m + vehicle.v_world_mps * age_s;
        // The fence comes last: if it contradicts the slew limit, the fence wins, at flat faces within
        // [`FENCE_EXCESS`].
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

    /// Returns `v_slewed` [m/s, world] reduced by the fence. At flat faces it reduces the speed by at most
    /// [`FENCE_EXCESS`] of the slew limit, and this reduction has priority over the plugin's request.
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

/// Returns the remaining share of the speed limit for a vehicle with this response, 0 to 1.
fn share_of_lag(response: Response) -> f64 {
    (LAG_USUAL_S / response.lag_s).min(1.0)
}
