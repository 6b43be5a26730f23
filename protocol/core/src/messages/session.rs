//! Messages between runtime and server on the control stream.

use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use super::{
    Event, MAX_CAMERAS, MAX_NO_FLY, Name, SetpointKinds, Telemetry, Text, Timing, bounded,
};
use crate::geometry::{Body, Cam, Intrinsics, Pose, Twist, Volume, World, body_from_forward_cam};
use crate::sensor::{MAX_SENSORS, SensorInfo};
use crate::time::{HostTime, ServerTime};

/// Purpose of a client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Purpose {
    /// Flies the vehicle: receives everything, reports, sends events. One client at a time.
    #[default]
    Fly,
    /// Watches the vehicle: receives images, poses and events. The server ignores everything it sends except clock
    /// requests.
    Watch,
}

/// First message of a client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// Vehicle to fly or to watch: the name of the object in the localization system.
    pub vehicle: Name,
    /// Purpose of the client.
    pub purpose: Purpose,
    /// Program and version, for the page and the log.
    pub program: Text,
    /// Random number of this run of the program. It distinguishes events of different runs.
    pub boot: u64,
    /// Server events that were already received.
    pub received_events: ReceivedEvents,
}

/// Reply that accepts a client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Welcome {
    /// Random number of this run of the server. A different number means that the server was restarted.
    pub boot: u64,
    /// Events of this client that the server has already received.
    pub received_events: ReceivedEvents,
    /// Description of the arena.
    pub arena: ArenaInfo,
    /// UDP port of the pose feed ([`crate::packet::feed`]) for the guardian of a flight; 0 if there is none.
    pub feed_port: u16,
}

/// Progress of receiving the other side's events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReceivedEvents {
    /// Run of the sender: its `boot`; 0 before the first event.
    pub boot: u64,
    /// Number of the newest event; 0 before the first.
    pub seq: u64,
}

impl ReceivedEvents {
    /// Returns the newest number received from the run `boot`; 0 for any other run.
    pub fn of(&self, boot: u64) -> u64 {
        if self.boot == boot { self.seq } else { 0 }
    }

    /// Records an event of the run `boot`. Returns whether it is new.
    pub fn receive(&mut self, boot: u64, seq: u64) -> bool {
        let is_new = seq > self.of(boot);
        if is_new {
            *self = Self { boot, seq };
        }
        is_new
    }
}

/// Request for the server's time. The runtime sends one per second, and four per second at the start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClockRequest {
    /// Time at which the runtime sent the request.
    pub sent: HostTime,
}

/// Reply to [`ClockRequest`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClockReply {
    /// Copied from the request.
    pub sent: HostTime,
    /// Time at which the server replied.
    pub answered: ServerTime,
}

/// Client to server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: the largest comes once a second, and there is no heap.
pub enum ToServer {
    /// First message of a client.
    Hello(Hello),
    /// Request for the server's time.
    Clock(ClockRequest),
    /// Report of the runtime, at 10 Hz.
    Telemetry(Telemetry),
    /// Event for the page.
    Event {
        /// Sequence number among this client's events.
        seq: u64,
        /// Event.
        event: Event,
    },
    /// Acknowledges all events of the server up to this number.
    EventsReceived(u64),
    /// Latency report by stage, at 1 Hz.
    Timing(Timing),
    /// Readings of the autopilot's IMU, oldest first, each sent once. 25 to 50 Hz.
    Imu(heapless::Vec<ImuReading, MAX_IMU_BATCH>),
    /// Limits that the guard enforces. Sent once per connection and after each change. A server that does not support
    /// this message drops it.
    Guarded(Guarded),
}

/// Limits within which the runtime keeps its vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Guarded {
    /// Geofence of the guard, for the body's surface. [world]
    pub geofence: Volume,
    /// Number of no-fly boxes of the guard.
    pub no_fly: u8,
    /// Height of the floor. [m, world]
    pub floor_z_m: f64,
    /// Limits of motion: the stricter ones of arena and vehicle.
    pub limits: Limits,
    /// Number of polygons that the autopilot has accepted for its own fence in this flight; `None` if it accepted none.
    pub polygons: Option<u8>,
}

impl Guarded {
    /// Returns the limits of a guard in `arena`, with an autopilot that has accepted this number of polygons.
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
    /// Rejects the client, with the reason and a remedy.
    Refused(Text),
    /// Reply with the server's time.
    Clock(ClockReply),
    /// Event for the runtime or a watcher.
    Event {
        /// Sequence number among this server's events. A client may not receive every number.
        seq: u64,
        /// Event.
        event: Event,
    },
    /// Acknowledges all events of this client up to this number.
    EventsReceived(u64),
    /// A camera was changed in flight. Images rendered with the new camera may arrive earlier than this message; each
    /// image contains its own camera parameters.
    Camera {
        /// Index into [`ArenaInfo::cameras`].
        index: u8,
        /// New parameters of the camera. The name does not change.
        camera: CameraInfo,
    },
    /// A sensor was changed in flight.
    Sensor {
        /// Index into [`ArenaInfo::sensors`].
        index: u8,
        /// New parameters of the sensor. Name and kind do not change.
        sensor: SensorInfo,
    },
}

/// Server to client, unordered and unreliable. Encoded by [`crate::packet::framing::encode_body`] without a length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Datagram {
    /// Pose of the vehicle, at most 100 Hz. The newest stamp counts.
    Pose(PoseSample),
}

/// Pose of the vehicle, localized and fused by the server.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseSample {
    /// Time of the measurement.
    pub stamp: ServerTime,
    /// Pose of the vehicle.
    pub world_from_body: Pose<World, Body>,
    /// Linear velocity in world axes, angular velocity in body axes.
    pub twist: Twist,
    /// Counter of jumps of the pose that are not motion.
    pub resets: u8,
    /// Standard deviation of the position per axis; 0 if unknown. [m, world]
    pub position_sigma_m: Vec3,
    /// Standard deviation of the attitude about each axis; 0 if unknown. [rad, body]
    pub rotation_sigma_rad: Vec3,
    /// Additional age that is allowed beyond [`PoseAges`], for the constant delay of the source and the period of a
    /// slow source. Between 0 and [`MAX_ALLOWANCE_S`]. [s]
    pub allowance_s: f32,
}

/// Maximum additional age for the delay and period of a source. [s]
pub const MAX_ALLOWANCE_S: f32 = 0.3;

impl PoseSample {
    /// Returns the sample of a vehicle at rest, of unknown uncertainty.
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

    /// Whether all numbers are finite and in range.
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

/// Ages of the newest pose at which the guard reacts. The pose's [`allowance_s`](PoseSample::allowance_s) is subtracted
/// first.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseAges {
    /// Age at which the guard holds. [s]
    pub hold_after_s: f64,
    /// Age at which the guard lands. [s]
    pub land_after_s: f64,
}

impl PoseAges {
    /// Returns the [`allowance_s`](PoseSample::allowance_s) of poses with this delay and interval. It is the delay,
    /// plus the time in which a slow source may skip one pose and send the next one late. [s]
    pub fn allowance_s(&self, delay_s: f64, interval_s: f64) -> f64 {
        let slow_s = (MISSED_POSES * interval_s - self.hold_after_s).max(0.0);
        (delay_s.max(0.0) + slow_s).min(f64::from(MAX_ALLOWANCE_S))
    }
}

/// Intervals that pass if one pose is skipped and the next is late.
const MISSED_POSES: f64 = 2.5;

impl Default for PoseAges {
    /// At 5 m/s, the vehicle flies 0.75 m in 0.15 s, and a 200 Hz mocap misses 30 packets. After 0.5 s, ArduCopter's
    /// own estimate is still good enough to land in place (it lasts 7 s, measured).
    fn default() -> Self {
        Self { hold_after_s: 0.15, land_after_s: 0.5 }
    }
}

/// Reading of the autopilot's accelerometer and gyroscope.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImuReading {
    /// Time of the measurement.
    pub stamp: ServerTime,
    /// Specific force: at rest and level, +9.8 along z. [m/s^2, body]
    pub accel_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: DVec3,
}

/// Maximum number of readings in one [`ToServer::Imu`].
pub const MAX_IMU_BATCH: usize = 8;

/// Camera that the server renders.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraInfo {
    /// Name for plugins, for example `front`.
    pub name: Name,
    /// Size, focal lengths, principal point.
    pub intrinsics: Intrinsics,
    /// Extrinsics: pose of the camera on the body.
    pub body_from_cam: Pose<Body, Cam>,
}

impl CameraInfo {
    /// Returns a camera at the body's centre that looks straight ahead.
    pub fn forward(name: &str, intrinsics: Intrinsics) -> Self {
        let body_from_cam = body_from_forward_cam(DVec3::ZERO, 0.0);
        Self { name: bounded(name), intrinsics, body_from_cam }
    }
}

/// Limits that the guard enforces for any setpoint.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Maximum speed. [m/s]
    pub max_speed_mps: f64,
    /// Maximum acceleration. The guard also uses it to compute stopping distances. [m/s^2]
    pub max_acceleration_mps2: f64,
    /// Maximum tilt from level. Without it, only the acceleration limits the tilt. [deg]
    pub max_tilt_deg: Option<f64>,
    /// Maximum height of the body's centre. Without it, only the geofence limits the height. [m, world]
    pub max_altitude_m: Option<f64>,
}

impl Limits {
    /// No limits. [`Self::stricter`] with these returns the other limits.
    pub const NONE: Self = Self::new(f64::INFINITY, f64::INFINITY);

    /// Returns limits of speed [m/s] and acceleration [m/s^2] only.
    pub const fn new(max_speed_mps: f64, max_acceleration_mps2: f64) -> Self {
        Self { max_speed_mps, max_acceleration_mps2, max_tilt_deg: None, max_altitude_m: None }
    }

    /// Returns the stricter value of each limit.
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
        // A NaN must neither override a limit nor disappear: `check` rejects it later.
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

/// Description of the arena for a runtime that flies in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArenaInfo {
    /// Name of the arena.
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
    /// Goal of the flight, which the plugin receives, too. [m, world]
    pub goal_m: Option<DVec3>,
    /// Radius around the goal within which it is reached. [m]
    pub goal_radius_m: f64,
    /// Time limit from take-off; 0 for none. [s]
    pub time_limit_s: f64,
    /// Box in which the body's centre must be for a take-off; `None` for anywhere. [world]
    pub start_box: Option<Volume>,
    /// Whether plugins receive the vehicle's pose and velocity. If not, these values are not present in the memory of
    /// the plugin's process.
    pub ground_truth: bool,
    /// Ages of the pose at which the guard holds and lands.
    pub pose_ages: PoseAges,
    /// Kinds of setpoint that plugins may use. The guard rejects others.
    pub setpoints: SetpointKinds,
    /// The cameras, in the order of their index on the wire.
    pub cameras: heapless::Vec<CameraInfo, MAX_CAMERAS>,
    /// The sensors other than cameras, in the order of their index on the wire.
    pub sensors: heapless::Vec<SensorInfo, MAX_SENSORS>,
}

impl ArenaInfo {
    /// Returns an arena with this fence [world] and these limits. Defaults: floor at zero, no goal, no time limit, no
    /// camera, body radius 0.1 m, take-off height 1 m, and the plugin receives its pose.
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
    fn accepts_each_event_of_a_run_once() {
        let mut received = ReceivedEvents::default();
        assert!(received.receive(7, 1) && received.receive(7, 4));
        assert!(!received.receive(7, 1) && !received.receive(7, 4));
        assert_eq!((received.of(7), received.of(8)), (4, 0));
        // The other side was restarted and counts from 1.
        assert!(received.receive(8, 1));
        assert_eq!((received.of(7), received.of(8)), (0, 1));
    }
}
