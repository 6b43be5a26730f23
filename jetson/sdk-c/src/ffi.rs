//! C interface. Types mirror `include/vizflyt.h` field by field; see there for their meaning.

#![allow(unsafe_code, reason = "the C interface: pointers from the caller")]

use std::ffi::{CString, c_char, c_int, c_void};
use std::process::ExitCode;

use vizflyt_sdk::glam::{DQuat, DVec3};
use vizflyt_sdk::protocol::messages::{MAX_CAMERAS, MAX_NO_FLY, MAX_PIECES, MAX_WAYPOINTS};
use vizflyt_sdk::protocol::packet::ObservationHeader;
use vizflyt_sdk::protocol::sensor::{LidarPoint, RadarDetection, RangeReading, SensorHeader};
use vizflyt_sdk::{
    ArenaInfo, Autonomy, Axes, Event, HostTime, Observation, Path, PathYaw, Piece, Pose, Setpoint,
    SetpointKind, Trajectory, Volume, Waypoint, YawTarget,
};

/// Waypoint of a path.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct VizflytWaypoint {
    /// Position. [m, axes]
    pub p_m: [f64; 3],
    /// Maximum speed on the way to it. [m/s]
    pub speed_mps: f64,
}

/// Polynomial in time.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct VizflytPiece {
    /// Duration. [s]
    pub seconds: f64,
    /// Coefficients of `t^k`. [m/s^k, axes]
    pub coefficients: [[f64; 3]; 8],
}

/// Setpoint that a plugin returns.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct VizflytSetpoint {
    /// `VIZFLYT_HOLD` and so on.
    pub kind: u32,
    /// `VIZFLYT_WORLD` and so on.
    pub axes: u32,
    /// `VIZFLYT_YAW_KEEP` and so on.
    pub yaw_kind: u32,
    /// Number of waypoints or pieces.
    pub count: u32,
    /// Vector; its meaning depends on `kind`.
    pub v: [f64; 3],
    /// Yaw or yaw rate, by `yaw_kind`. [rad or rad/s]
    pub yaw: f64,
    /// Thrust / weight.
    pub thrust: f64,
    /// Id of a trajectory.
    pub id: u32,
    /// Always zero.
    pub reserved: u32,
    /// `count` waypoints.
    pub waypoints: *const VizflytWaypoint,
    /// `count` pieces.
    pub pieces: *const VizflytPiece,
}

/// Solid volume.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct VizflytVolume {
    /// `VIZFLYT_SPHERE` and so on.
    pub kind: u32,
    /// Always zero.
    pub reserved: u32,
    /// First vector; its meaning depends on `kind`. [m, world]
    pub a: [f64; 3],
    /// Second vector; its meaning depends on `kind`.
    pub b: [f64; 3],
    /// Radius of a sphere or capsule; offset of a half space. [m]
    pub radius_m: f64,
    /// Rotation of a box to world.
    pub rotation_xyzw: [f64; 4],
}

impl From<&Volume> for VizflytVolume {
    fn from(volume: &Volume) -> Self {
        let zero = DVec3::ZERO;
        let level = DQuat::IDENTITY;
        let (kind, a, b, radius_m, rotation) = match *volume {
            Volume::Sphere { center_m, radius_m } => (0, center_m, zero, radius_m, level),
            Volume::Capsule { a_m, b_m, radius_m } => (1, a_m, b_m, radius_m, level),
            Volume::Cuboid { center_m, half_m, rotation } => (2, center_m, half_m, 0.0, rotation),
            Volume::HalfSpace { normal, offset_m } => (3, normal, zero, offset_m, level),
        };
        let rotation_xyzw = rotation.to_array();
        Self { kind, reserved: 0, a: a.to_array(), b: b.to_array(), radius_m, rotation_xyzw }
    }
}

/// Description of the flight, passed to `on_start`.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct VizflytArena {
    /// Number of cameras.
    pub camera_count: u32,
    /// Whether `goal_m` is set.
    pub has_goal: u32,
    /// Goal of the flight. [m, world]
    pub goal_m: [f64; 3],
    /// Maximum speed. [m/s]
    pub max_speed_mps: f64,
    /// Maximum acceleration. [m/s^2]
    pub max_acceleration_mps2: f64,
    /// Whether observations contain the pose.
    pub ground_truth: u32,
    /// Whether attitude rates are allowed.
    pub attitude_rate: u32,
    /// Name of the arena, zero-terminated.
    pub name: [u8; 33],
    /// Names of the cameras, zero-terminated.
    pub cameras: [[u8; 33]; MAX_CAMERAS],
    /// Allowed kinds of setpoint: bit `VIZFLYT_POSITION` and so on.
    pub setpoints: u32,
    /// Height of the floor. [m, world]
    pub floor_z_m: f64,
    /// Volume in which the body's surface must stay.
    pub geofence: VizflytVolume,
    /// Number of no-fly volumes.
    pub no_fly_count: u32,
    /// Number of volumes of the map; 0 if the course does not give it.
    pub map_count: u32,
    /// Volumes that the body's surface must not enter.
    pub no_fly: [VizflytVolume; MAX_NO_FLY],
    /// Every obstacle, if the course gives the map.
    pub map: *const VizflytVolume,
}

/// Callbacks of a plugin.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct VizflytPlugin {
    /// Passed to each callback.
    pub user: *mut c_void,
    /// Called before the first image.
    pub on_start: Option<unsafe extern "C" fn(*mut c_void, *const VizflytArena)>,
    /// Called for each image with the observation's memory, which begins with its [`ObservationHeader`].
    pub on_image:
        Option<unsafe extern "C" fn(*mut c_void, *const c_void, *mut VizflytSetpoint) -> c_int>,
    /// Called for each event.
    pub on_event: Option<unsafe extern "C" fn(*mut c_void, *const c_char)>,
    /// Called at the end of the flight.
    pub on_stop: Option<unsafe extern "C" fn(*mut c_void)>,
}

/// Attaches to the runtime that started this program and runs until the end of the flight. Returns the exit status for
/// `main`.
///
/// # Safety
/// `plugin` points to a `VizflytPlugin` with callbacks that follow `vizflyt.h`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vizflyt_run(plugin: *const VizflytPlugin) -> c_int {
    // SAFETY: guaranteed by the caller, or null.
    let Some(&callbacks) = (unsafe { plugin.as_ref() }) else {
        eprintln!("vizflyt_run: the plugin is NULL");
        return NOT_ATTACHED;
    };
    if callbacks.on_image.is_none() {
        eprintln!("vizflyt_run: on_image is NULL; a plugin must answer images");
        return NOT_ATTACHED;
    }
    let code = vizflyt_sdk::run(CPlugin(callbacks));
    // `ExitCode` does not expose its number.
    [0, 1, 2, 101].into_iter().find(|&n| ExitCode::from(n) == code).unwrap_or(1).into()
}

/// Publishes the plugin's estimate of the vehicle's pose. Returns 1, or 0 for an invalid pose or too many calls.
///
/// # Safety
/// `p_odom_m` points to three numbers and `rotation_xyzw` to four, or either is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vizflyt_publish_odometry(
    stamp_ns: u64,
    p_odom_m: *const [f64; 3],
    rotation_xyzw: *const [f64; 4],
) -> c_int {
    // SAFETY: guaranteed by the caller, or null.
    let given = unsafe { p_odom_m.as_ref().zip(rotation_xyzw.as_ref()) };
    let published = given.map(|(&p_m, &xyzw)| {
        let pose = Pose::new(DVec3::from(p_m), DQuat::from_array(xyzw));
        vizflyt_sdk::publish_odometry(HostTime::from_ns(stamp_ns), pose)
    });
    matches!(published, Some(Ok(()))).into()
}

const NOT_ATTACHED: c_int = 2;

/// Returns the number of a kind of setpoint in `vizflyt.h`. Both kinds of trajectory share the first one's number.
fn number(kind: SetpointKind) -> u32 {
    match kind {
        SetpointKind::Position => 2,
        SetpointKind::Velocity => 3,
        SetpointKind::Acceleration => 4,
        SetpointKind::Offset => 5,
        SetpointKind::AttitudeRate => 6,
        SetpointKind::Trajectory => 8,
    }
}

struct CPlugin(VizflytPlugin);

impl Autonomy for CPlugin {
    fn on_start(&mut self, info: &ArenaInfo) {
        let Some(on_start) = self.0.on_start else { return };
        let mut cameras = [[0; 33]; MAX_CAMERAS];
        for (name, camera) in cameras.iter_mut().zip(&info.cameras) {
            *name = zero_ended(&camera.name);
        }
        let map: Vec<VizflytVolume> = match vizflyt_sdk::map() {
            Ok(map) => map.iter().flatten().map(VizflytVolume::from).collect(),
            Err(error) => {
                eprintln!("{error}");
                Vec::new()
            }
        };
        let mut no_fly = [VizflytVolume::from(&info.geofence); MAX_NO_FLY];
        for (slot, volume) in no_fly.iter_mut().zip(&info.no_fly) {
            *slot = volume.into();
        }
        let arena = VizflytArena {
            camera_count: info.cameras.len() as u32,
            has_goal: info.goal_m.is_some().into(),
            goal_m: info.goal_m.unwrap_or_default().to_array(),
            max_speed_mps: info.limits.max_speed_mps,
            max_acceleration_mps2: info.limits.max_acceleration_mps2,
            ground_truth: info.ground_truth.into(),
            attitude_rate: info.setpoints.contains(SetpointKind::AttitudeRate).into(),
            name: zero_ended(&info.name),
            cameras,
            setpoints: info.setpoints.iter().fold(0, |bits, kind| bits | 1 << number(kind)),
            floor_z_m: info.floor_z_m,
            geofence: (&info.geofence).into(),
            no_fly_count: info.no_fly.len() as u32,
            map_count: map.len() as u32,
            no_fly,
            map: if map.is_empty() { std::ptr::null() } else { map.as_ptr() },
        };
        // SAFETY: the callback follows `vizflyt.h`; `arena` outlives the call.
        unsafe { on_start(self.0.user, &raw const arena) }
    }

    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        let on_image = self.0.on_image?;
        let mut answer = VizflytSetpoint {
            kind: 0,
            axes: 0,
            yaw_kind: 0,
            count: 0,
            v: [0.0; 3],
            yaw: 0.0,
            thrust: 0.0,
            id: 0,
            reserved: 0,
            waypoints: std::ptr::null(),
            pieces: std::ptr::null(),
        };
        // The memory begins with the header, followed by the planes; `Observation` has validated it.
        let memory = obs.as_bytes().as_ptr().cast::<c_void>();
        // SAFETY: the callback follows `vizflyt.h`; both pointers outlive the call.
        let answered = unsafe { on_image(self.0.user, memory, &raw mut answer) };
        if answered == 0 {
            return None;
        }
        // SAFETY: the callback has filled in `answer` according to `vizflyt.h`.
        let setpoint = unsafe { setpoint(&answer) };
        if setpoint.is_none() {
            eprintln!("vizflyt: invalid setpoint: {answer:?}");
        }
        setpoint
    }

    fn on_event(&mut self, event: &Event) {
        let (Some(on_event), Ok(text)) = (self.0.on_event, CString::new(event.text.as_str()))
        else {
            return;
        };
        // SAFETY: the callback follows `vizflyt.h`; `text` outlives the call.
        unsafe { on_event(self.0.user, text.as_ptr()) }
    }

    fn on_stop(&mut self) {
        if let Some(on_stop) = self.0.on_stop {
            // SAFETY: the callback follows `vizflyt.h`.
            unsafe { on_stop(self.0.user) }
        }
    }
}

/// Returns `name`, of at most 32 bytes, with a terminating zero.
fn zero_ended(name: &str) -> [u8; 33] {
    let mut out = [0; 33];
    for (to, from) in out[..32].iter_mut().zip(name.bytes()) {
        *to = from;
    }
    out
}

/// Converts to a setpoint. `None` for an unknown number, or a list that is NULL or too long.
///
/// # Safety
/// `waypoints` or `pieces`, depending on the kind, is NULL or points to `count` elements.
unsafe fn setpoint(answer: &VizflytSetpoint) -> Option<Setpoint> {
    let axes = match answer.axes {
        0 => Axes::World,
        1 => Axes::Heading,
        2 => Axes::Body,
        _ => return None,
    };
    let target = match answer.yaw_kind {
        0 => Some(YawTarget::Keep),
        1 => Some(YawTarget::Angle(answer.yaw)),
        2 => Some(YawTarget::Rate(answer.yaw)),
        _ => None,
    };
    let v = DVec3::from(answer.v);
    let count = answer.count as usize;
    let trajectory = |path| {
        let yaw = match (answer.yaw_kind, target) {
            (3, _) => PathYaw::Ahead,
            (_, target) => PathYaw::Target(target?),
        };
        Some(Setpoint::Trajectory(Trajectory { id: answer.id, axes, path, yaw }))
    };
    Some(match answer.kind {
        0 => Setpoint::Hold,
        1 => Setpoint::Land,
        2 => Setpoint::Position { p_world_m: v, yaw: target? },
        3 => Setpoint::Velocity { v_mps: v, axes, yaw: target? },
        4 => Setpoint::Acceleration { a_mps2: v, axes, yaw: target? },
        5 => Setpoint::Offset { d_m: v, axes, yaw: target? },
        6 => Setpoint::AttitudeRate { omega_body_radps: v, thrust: answer.thrust },
        7 => Setpoint::TakeOff,
        8 => {
            if answer.waypoints.is_null() || count > MAX_WAYPOINTS {
                return None;
            }
            // SAFETY: not null, so the caller guarantees `count` elements.
            let given = unsafe { std::slice::from_raw_parts(answer.waypoints, count) };
            let point = |point: &VizflytWaypoint| Waypoint {
                p_m: point.p_m.into(),
                speed_mps: point.speed_mps,
            };
            return trajectory(Path::Waypoints(given.iter().map(point).collect()));
        }
        9 => {
            if answer.pieces.is_null() || count > MAX_PIECES {
                return None;
            }
            // SAFETY: not null, so the caller guarantees `count` elements.
            let given = unsafe { std::slice::from_raw_parts(answer.pieces, count) };
            let piece = |piece: &VizflytPiece| Piece {
                seconds: piece.seconds,
                coefficients: piece.coefficients.map(DVec3::from),
            };
            return trajectory(Path::Polynomial(given.iter().map(piece).collect()));
        }
        _ => return None,
    })
}

// The same layout that `vizflyt.h` asserts.
const _: () = assert!(size_of::<ObservationHeader>() == 4064);
const _: () = assert!(std::mem::offset_of!(ObservationHeader, sensors_offset) == 4056);
const _: () = assert!(size_of::<SensorHeader>() == 192);
const _: () = assert!(std::mem::offset_of!(SensorHeader, kind) == 144);
const _: () = assert!(size_of::<LidarPoint>() == 20 && size_of::<RangeReading>() == 8);
const _: () = assert!(size_of::<RadarDetection>() == 20);
const _: () = assert!(std::mem::offset_of!(ObservationHeader, cameras) == 2200);
