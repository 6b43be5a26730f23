//! The conversation between runtime and server on the control stream.

use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use super::{
    Event, MAX_CAMERAS, MAX_NO_FLY, Name, SetpointKinds, Telemetry, Text, Timing, bounded,
};
use crate::geometry::{Body, Cam, Intrinsics, Pose, Twist, Volume, World, body_from_forward_cam};
use crate::sensor::{MAX_SENSORS, SensorInfo};
use crate::time::{HostTime, ServerTime};

/// What a client is there for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Purpose {
    /// Flies the vehicle: gets all, reports, sends events. One at a time.
    #[default]
    Fly,
    /// Watches it: gets images, poses and events; what it sends but clock requests is ignored.
    Watch,
}

/// First message of a client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// The vehicle that it flies or watches: the object's name in the localization system.
    pub vehicle: Name,
    /// What it is there for.
    pub purpose: Purpose,
    /// The program and its version, for the page and the log.
    pub program: Text,
    /// Random, chosen when the program started: distinguishes its events from those of another run.
    pub boot: u64,
    /// What it has received of the server's events before.
    pub received_events: ReceivedEvents,
}

/// Accepts a client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Welcome {
    /// Random, chosen when the server started: another one means that it was restarted.
    pub boot: u64,
    /// What the server has received of this client's events before.
    pub received_events: ReceivedEvents,
    /// What it must know of the arena.
    pub arena: ArenaInfo,
    /// UDP port of the pose feed ([`crate::packet::feed`]) for the guardian of a flight; 0 is none.
    pub feed_port: u16,
}

/// How many of the other side's events have been received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReceivedEvents {
    /// Whose they were: the other side's `boot`; 0 is nobody's.
    pub boot: u64,
    /// Number of the newest; 0 is none.
    pub seq: u64,
}

impl ReceivedEvents {
    /// Returns the newest number received of the run `boot`; 0 of any other.
    pub fn of(&self, boot: u64) -> u64 {
        if self.boot == boot { self.seq } else { 0 }
    }

    /// Takes note of an event of the run `boot`; returns whether it is new.
    pub fn receive(&mut self, boot: u64, seq: u64) -> bool {
        let is_new = seq > self.of(boot);
        if is_new {
            *self = Self { boot, seq };
        }
        is_new
    }
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

/// Client to server.
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
    Event {
        /// Its number among this client's events, rising.
        seq: u64,
        /// The event.
        event: Event,
    },
    /// Every event of the server up to this number has been received.
    EventsReceived(u64),
    /// Reports where images get their age. 1 Hz.
    Timing(Timing),
    /// Readings of the autopilot's IMU, oldest first; each once. 25 to 50 Hz.
    Imu(heapless::Vec<ImuReading, MAX_IMU_BATCH>),
    /// Reports what the guard keeps the vehicle within; once a connection, and when it changes. A server that does
    /// not know it drops it.
    Guarded(Guarded),
}

/// What the runtime keeps its vehicle within.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Guarded {
    /// Keep-in volume of the guard, for the body's surface. [world]
    pub geofence: Volume,
    /// Keep-out volumes of the guard.
    pub no_fly: u8,
    /// Height of the floor. [m, world]
    pub floor_z_m: f64,
    /// Limits of motion: the stricter ones of arena and vehicle.
    pub limits: Limits,
    /// Polygons that the autopilot has accepted for its own fence in this flight; `None` if it accepted none.
    pub polygons: Option<u8>,
}

impl Guarded {
    /// Returns what a guard holds that flies by `arena`, with an autopilot that has accepted so many polygons.
    pub fn of(arena: &ArenaInfo, polygons: Option<u8>) -> Self {
        Self {
            geofence: arena.geofence,
            no_fly: arena.no_fly.len() as u8,
            floor_z_m: arena.floor_z_m,
            limits: arena.limits,
            polygons,
        }
    }
}

/// Server to client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: `Welcome` comes once, and there is no heap to box it on.
pub enum ToRuntime {
    /// Accepts the client.
    Welcome(Welcome),
    /// Declines it, with the reason and what to do.
    Refused(Text),
    /// Returns the time.
    Clock(ClockReply),
    /// Something happened.
    Event {
        /// Its number among this server's events, rising; not every number is for every client.
        seq: u64,
        /// The event.
        event: Event,
    },
    /// Every event of this client up to this number has been received.
    EventsReceived(u64),
    /// A camera was changed while flying. Images rendered with it may come before this does: each
    /// states itself how it was rendered.
    Camera {
        /// Index into [`ArenaInfo::cameras`].
        index: u8,
        /// The camera as it is from now on; its name stays.
        camera: CameraInfo,
    },
    /// A sensor was changed while flying.
    Sensor {
        /// Index into [`ArenaInfo::sensors`].
        index: u8,
        /// The sensor as it is from now on; its name and its kind stay.
        sensor: SensorInfo,
    },
}

/// Server to client, unordered, possibly lost; [`crate::packet::framing::encode_body`] without a
/// length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Datagram {
    /// The vehicle's pose. At most 100 Hz; the newest by stamp counts.
    Pose(PoseSample),
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
    /// How far the position may be off, one standard deviation an axis; 0 is not known. [m, world]
    pub position_sigma_m: Vec3,
    /// How far the attitude may be off, about each axis; 0 is not known. [rad, body]
    pub rotation_sigma_rad: Vec3,
    /// How much older it may grow than [`PoseAges`] say: by the delay that its source always has, and by the period of
    /// a slow one. Within 0 and [`MAX_ALLOWANCE_S`]. [s]
    pub allowance_s: f32,
}

/// No delay or period of a source makes ages of a pose count more than so much later. [s]
pub const MAX_ALLOWANCE_S: f32 = 0.3;

impl PoseSample {
    /// Makes the sample of a vehicle that stands still, of unknown uncertainty.
    pub const fn still(stamp: ServerTime, world_from_body: Pose<World, Body>) -> Self {
        let twist = Twist { linear_mps: DVec3::ZERO, angular_radps: DVec3::ZERO };
        let (position_sigma_m, rotation_sigma_rad) = (Vec3::ZERO, Vec3::ZERO);
        Self {
            stamp,
            world_from_body,
            twist,
            resets: 0,
            position_sigma_m,
            rotation_sigma_rad,
            allowance_s: 0.0,
        }
    }

    /// Whether every number in it is one to work with.
    pub fn is_valid(&self) -> bool {
        let Twist { linear_mps, angular_radps } = self.twist;
        self.world_from_body.is_valid()
            && linear_mps.is_finite()
            && angular_radps.is_finite()
            && self.position_sigma_m.is_finite()
            && self.rotation_sigma_rad.is_finite()
            && (0.0..=MAX_ALLOWANCE_S).contains(&self.allowance_s)
    }
}

/// Ages of the newest pose, less its [`allowance_s`](PoseSample::allowance_s), from which a flight does not go on as
/// it was.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseAges {
    /// The guard holds. [s]
    pub hold_after_s: f64,
    /// The guard lands. [s]
    pub land_after_s: f64,
}

impl PoseAges {
    /// Returns the [`allowance_s`](PoseSample::allowance_s) of poses that come so late, one each `interval_s`: their delay,
    /// and until a slow source has left out one and is late with the next. [s]
    pub fn allowance_s(&self, delay_s: f64, interval_s: f64) -> f64 {
        let slow_s = (MISSED_POSES * interval_s - self.hold_after_s).max(0.0);
        (delay_s.max(0.0) + slow_s).min(f64::from(MAX_ALLOWANCE_S))
    }
}

/// Intervals that pass while one pose is left out and the next is late.
const MISSED_POSES: f64 = 2.5;

impl Default for PoseAges {
    /// At 5 m/s 0.15 s are 0.75 m flown blind, and 30 packets of a 200 Hz mocap missed; after 0.5 s
    /// ArduCopter's own estimate is still good for a landing in place (it lasts 7 s, measured).
    fn default() -> Self {
        Self { hold_after_s: 0.15, land_after_s: 0.5 }
    }
}

/// A reading of the autopilot's accelerometer and gyroscope.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImuReading {
    /// When it was made.
    pub stamp: ServerTime,
    /// Specific force: at rest and level, +9.8 along z. [m/s^2, body]
    pub accel_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: DVec3,
}

/// Most readings of one [`ToServer::Imu`].
pub const MAX_IMU_BATCH: usize = 8;

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

impl CameraInfo {
    /// Makes a camera at the body's centre that looks straight ahead.
    pub fn forward(name: &str, intrinsics: Intrinsics) -> Self {
        let body_from_cam = body_from_forward_cam(DVec3::ZERO, 0.0);
        Self { name: bounded(name), intrinsics, body_from_cam }
    }
}

/// Limits that the guard enforces whatever a plugin asks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Greatest speed. [m/s]
    pub max_speed_mps: f64,
    /// Greatest acceleration; also what the guard counts on for stopping. [m/s^2]
    pub max_acceleration_mps2: f64,
    /// Greatest tilt from level; without it the acceleration alone limits tilt. [deg]
    pub max_tilt_deg: Option<f64>,
    /// Greatest height of the body's centre; without it the geofence alone limits height.
    /// [m, world]
    pub max_altitude_m: Option<f64>,
}

impl Limits {
    /// No limit at all: what [`Self::stricter`] leaves any other as it is.
    pub const NONE: Self = Self::new(f64::INFINITY, f64::INFINITY);

    /// Makes limits of speed [m/s] and acceleration [m/s^2] only.
    pub const fn new(max_speed_mps: f64, max_acceleration_mps2: f64) -> Self {
        Self { max_speed_mps, max_acceleration_mps2, max_tilt_deg: None, max_altitude_m: None }
    }

    /// Returns limits that keep both: of each limit the stricter.
    ///
    /// ```
    /// use vizflyt_protocol::messages::Limits;
    /// let arena = Limits { max_tilt_deg: Some(30.0), ..Limits::new(3.0, 8.0) };
    /// let vehicle = Limits { max_altitude_m: Some(2.5), ..Limits::new(5.0, 4.0) };
    /// let both = arena.stricter(&vehicle);
    /// assert_eq!((both.max_speed_mps, both.max_acceleration_mps2), (3.0, 4.0));
    /// assert_eq!((both.max_tilt_deg, both.max_altitude_m), (Some(30.0), Some(2.5)));
    /// ```
    #[must_use]
    pub fn stricter(&self, other: &Self) -> Self {
        // A NaN must not win over a limit, nor vanish: `check` refuses it where it is used.
        let least = |a: f64, b: f64| if a.is_nan() || a < b { a } else { b };
        let least_of = |a: Option<f64>, b: Option<f64>| match (a, b) {
            (Some(a), Some(b)) => Some(least(a, b)),
            (a, b) => a.or(b),
        };
        Self {
            max_speed_mps: least(self.max_speed_mps, other.max_speed_mps),
            max_acceleration_mps2: least(self.max_acceleration_mps2, other.max_acceleration_mps2),
            max_tilt_deg: least_of(self.max_tilt_deg, other.max_tilt_deg),
            max_altitude_m: least_of(self.max_altitude_m, other.max_altitude_m),
        }
    }
}

/// What a runtime must know of the arena to fly in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArenaInfo {
    /// The arena's name.
    pub name: Name,
    /// Keep-in volume for the body's surface. [world]
    pub geofence: Volume,
    /// Keep-out volumes for the body's surface. [world]
    pub no_fly: heapless::Vec<Volume, MAX_NO_FLY>,
    /// Height of the floor. [m, world]
    pub floor_z_m: f64,
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
    /// Where the body's centre must be for a take-off; anywhere without one. [world]
    pub start_box: Option<Volume>,
    /// Whether plugins get the vehicle's pose and velocity. Where not, they are not in the plugin
    /// process's memory at all.
    pub ground_truth: bool,
    /// When the guard holds, and when it lands, for want of a pose.
    pub pose_ages: PoseAges,
    /// What plugins may ask for; the guard refuses the rest.
    pub setpoints: SetpointKinds,
    /// The cameras, in the order of their index on the wire.
    pub cameras: heapless::Vec<CameraInfo, MAX_CAMERAS>,
    /// The sensors beside the cameras, in the order of their index on the wire.
    pub sensors: heapless::Vec<SensorInfo, MAX_SENSORS>,
}

impl ArenaInfo {
    /// Makes an arena of a fence [world] and limits alone: the floor at zero, no goal, no time limit, no
    /// camera; a body of 0.1 m that rises by 1 m, and a plugin that gets its pose.
    pub fn new(name: &str, geofence: Volume, limits: Limits) -> Self {
        Self {
            name: bounded(name),
            geofence,
            no_fly: heapless::Vec::new(),
            floor_z_m: 0.0,
            limits,
            body_radius_m: 0.1,
            takeoff_height_m: 1.0,
            goal_m: None,
            goal_radius_m: 1.0,
            time_limit_s: 0.0,
            start_box: None,
            ground_truth: true,
            pose_ages: PoseAges::default(),
            setpoints: SetpointKinds::USUAL,
            cameras: heapless::Vec::new(),
            sensors: heapless::Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_event_of_a_run_is_new_once() {
        let mut received = ReceivedEvents::default();
        assert!(received.receive(7, 1) && received.receive(7, 4));
        assert!(!received.receive(7, 1) && !received.receive(7, 4));
        assert_eq!((received.of(7), received.of(8)), (4, 0));
        // The other side was restarted and counts from the start.
        assert!(received.receive(8, 1));
        assert_eq!((received.of(7), received.of(8)), (0, 1));
    }
}
