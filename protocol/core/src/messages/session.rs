//! The conversation between runtime and server on the control stream.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{Event, MAX_CAMERAS, Name, Telemetry, Text, Timing};
use crate::geometry::{Body, Cam, Intrinsics, Pose, Twist, Volume, World};
use crate::time::{HostTime, ServerTime};

/// First message of a runtime.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// The vehicle this runtime flies: the object's name in the localization system.
    pub vehicle: Name,
    /// The program and its version, for the page and the log.
    pub program: Text,
}

/// Asks the server's clock. The runtime sends one a second, four times as often at the start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClockRequest {
    /// When the runtime asked.
    pub sent: HostTime,
}

/// Answers [`ClockRequest`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClockReply {
    /// Copied from the request.
    pub sent: HostTime,
    /// When the server answered.
    pub answered: ServerTime,
}

/// Runtime to server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: the largest comes once a second, and there is no heap.
pub enum ToServer {
    /// Opens the conversation.
    Hello(Hello),
    /// Asks the time.
    Clock(ClockRequest),
    /// Reports. 10 Hz.
    Telemetry(Telemetry),
    /// Something the page should show.
    Event(Event),
    /// Reports where images get their age. 1 Hz.
    Timing(Timing),
}

/// Server to runtime.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: `Welcome` comes once, and there is no heap to box it on.
pub enum ToRuntime {
    /// Accepts the runtime.
    Welcome(ArenaInfo),
    /// Declines it, with the reason in a sentence that says what to do.
    Refused(Text),
    /// Tells the time.
    Clock(ClockReply),
    /// The vehicle's pose. At most 100 Hz.
    Pose(PoseSample),
    /// Something happened.
    Event(Event),
    /// A camera was changed while flying. Images drawn with it may come before this does: each
    /// says itself how it was drawn.
    Camera {
        /// Index into [`ArenaInfo::cameras`].
        index: u8,
        /// The camera as it is from now on; its name stays.
        camera: CameraInfo,
    },
}

/// The vehicle's pose as localized and fused by the server.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseSample {
    /// When the pose was true.
    pub stamp: ServerTime,
    /// Where the vehicle was.
    pub world_from_body: Pose<World, Body>,
    /// Linear velocity in world axes, angular in body axes.
    pub twist: Twist,
    /// Raised by one whenever the pose jumped for another reason than motion.
    pub resets: u8,
}

/// One camera that the server draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraInfo {
    /// What plugins call it: `front`.
    pub name: Name,
    /// Size, focal lengths, principal point.
    pub intrinsics: Intrinsics,
    /// Extrinsics.
    pub body_from_cam: Pose<Body, Cam>,
}

/// Limits that the guard enforces whatever a plugin asks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Greatest speed. [m/s]
    pub max_speed_mps: f64,
    /// Greatest acceleration; also what the guard counts on for stopping. [m/s^2]
    pub max_acceleration_mps2: f64,
}

/// What a runtime must know of the arena to fly in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArenaInfo {
    /// The arena's name.
    pub name: Name,
    /// Keep-in volume for the body's surface. [world]
    pub geofence: Volume,
    /// Limits of motion.
    pub limits: Limits,
    /// Radius of the sphere that encloses the vehicle. [m]
    pub body_radius_m: f64,
    /// Height above the start to which the runtime climbs before the plugin flies. [m]
    pub takeoff_height_m: f64,
    /// Where the flight shall end; the plugin gets it. [m, world]
    pub goal_m: Option<DVec3>,
    /// How near counts as reached. [m]
    pub goal_radius_m: f64,
    /// From take-off; 0 is none. [s]
    pub time_limit_s: f64,
    /// The cameras, in the order of their index on the wire.
    pub cameras: heapless::Vec<CameraInfo, MAX_CAMERAS>,
}
