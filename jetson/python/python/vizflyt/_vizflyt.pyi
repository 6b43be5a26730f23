# Signatures are written here by hand; docstrings are copied from the compiled module by
# tests/python/stub.py --write.
from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal, SupportsFloat, final

import numpy as np
import numpy.typing as npt

__version__: Final[str]
PROTOCOL_VERSION: Final[int]
_Frame = Literal["world", "body", "cam", "odom", "sensor"]
_Axes = Literal["world", "heading", "body"]
_Vector = npt.ArrayLike
_F64 = npt.NDArray[np.float64]

@final
class ArenaInfo:
    """What a plugin must know of the arena it flies in.

    `ArenaInfo(goal_m=[5, 0, 1], ...)` makes one, for tests; every keyword has a default.
    """

    def __new__(
        cls,
        *,
        name: str = "test",
        geofence: Volume | None = None,
        no_fly: Sequence[Volume] = ...,
        floor_z_m: float = 0.0,
        limits: Limits | None = None,
        body_radius_m: float = 0.12,
        takeoff_height_m: float = 1.0,
        goal_m: _Vector | None = None,
        goal_radius_m: float = 1.0,
        time_limit_s: float = 0.0,
        start_box: Volume | None = None,
        ground_truth: bool = True,
        attitude_rate: bool = False,
        setpoints: Sequence[str] | None = None,
        cameras: Sequence[CameraInfo] = ...,
        sensors: Sequence[SensorInfo] = ...,
    ) -> ArenaInfo: ...
    @property
    def name(self) -> str:
        """The arena's name."""

    @property
    def geofence(self) -> Volume:
        """Keep-in volume of the body's surface. [world]"""

    @property
    def no_fly(self) -> list[Volume]:
        """Keep-out volumes of the body's surface. [world]"""

    @property
    def floor_z_m(self) -> float:
        """Height of the floor. [m, world]"""

    @property
    def limits(self) -> Limits:
        """Limits of motion."""

    @property
    def body_radius_m(self) -> float:
        """Radius of the sphere that encloses the vehicle. [m]"""

    @property
    def takeoff_height_m(self) -> float:
        """Height above the start to which the runtime climbs before the plugin flies. [m]"""

    @property
    def goal_m(self) -> _F64 | None:
        """Where the flight shall end: shape (3,), float64; None if the course has no goal. [m, world]"""

    @property
    def goal_radius_m(self) -> float:
        """How near counts as reached. [m]"""

    @property
    def time_limit_s(self) -> float:
        """From take-off; 0 is none. [s]"""

    @property
    def start_box(self) -> Volume | None:
        """Where a flight begins; None if anywhere. [world]"""

    @property
    def ground_truth(self) -> bool:
        """Whether the plugin gets the vehicle's pose and velocity."""
    @property
    def attitude_rate(self) -> bool:
        """Whether the plugin may ask for `Setpoint.attitude_rate`."""

    @property
    def setpoints(self) -> list[str]:
        """Kinds of setpoint that the plugin may ask for, of 'position', 'velocity', 'acceleration',
        'offset', 'attitude_rate' and 'trajectory'; hold, land and take_off it always may."""

    @property
    def cameras(self) -> list[CameraInfo]:
        """The vehicle's cameras."""

    @property
    def sensors(self) -> list[SensorInfo]:
        """The vehicle's sensors beside the cameras."""

@final
class CameraInfo:
    """One camera of the vehicle.

    `CameraInfo(name, intrinsics, body_from_cam=None)` makes one, for tests; without a mounting it looks
    along the nose.
    """

    def __new__(
        cls, name: str, intrinsics: Intrinsics, body_from_cam: Pose | None = None
    ) -> CameraInfo: ...
    @property
    def name(self) -> str:
        """What `obs.camera(name)` calls it."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Size, focal lengths, principal point, lens."""

    @property
    def body_from_cam(self) -> Pose:
        """How it is mounted."""

@final
class Limits:
    """Limits that the guard enforces whatever a plugin asks."""

    def __new__(
        cls,
        *,
        max_speed_mps: float,
        max_acceleration_mps2: float,
        max_tilt_deg: float | None = None,
        max_altitude_m: float | None = None,
    ) -> Limits: ...
    @property
    def max_tilt_deg(self) -> float | None:
        """Greatest tilt from level; None if the acceleration alone limits it. [deg]"""
    @property
    def max_altitude_m(self) -> float | None:
        """Greatest height of the body's centre; None if the geofence alone limits it. [m, world]"""
    @property
    def max_speed_mps(self) -> float:
        """Greatest speed. [m/s]"""

    @property
    def max_acceleration_mps2(self) -> float:
        """Greatest acceleration; also what the guard counts on for stopping. [m/s^2]"""

@final
class Observation:
    """The vehicle and its cameras' images at one moment.

    Images lie in shared memory and are not copied. Those you keep beyond `on_image` stay as they are; keep
    more than the newest two and later ones are copied, with a warning.
    """

    @property
    def seq(self) -> int:
        """The observation's number in this flight; numbers missing were skipped."""

    @property
    def stamp_ns(self) -> int:
        """When the newest image's pose was measured. [ns, `time.monotonic_ns()`]"""

    def camera(self, name: str) -> CameraImage | None:
        """Returns the image of the camera of this name; None if it has none yet.

        Raises LookupError if the vehicle has no such camera.
        """

    @property
    def cameras(self) -> list[CameraImage]:
        """The images there are, in the order of the arena's cameras."""

    def sensor(self, name: str) -> SensorReading | None:
        """Returns the newest reading of the sensor of this name; None if it has none yet.

        Raises LookupError if the vehicle has no such sensor.
        """

    @property
    def sensors(self) -> list[SensorReading]:
        """The newest readings there are, in the order of the arena's sensors."""

    @property
    def pose_at_image(self) -> Pose | None:
        """Where the body was at the instant that the newest image shows: the pose that belongs to its pixels. None
        without an image, and where the course withholds the pose. [m, world]
        """

    @property
    def vehicle(self) -> Vehicle | None:
        """What is known of the vehicle; None before anything is."""

    @property
    def imu(self) -> list[ImuSample]:
        """The autopilot's IMU samples since the image that the plugin got before this one, oldest first; at
        most the newest 64 (0.6 s at 100 Hz).
        """
    @property
    def battery(self) -> Battery:
        """The battery's state."""
    @property
    def is_copy(self) -> bool:
        """Whether the images are copies, because the plugin keeps too many earlier ones."""

@final
class SensorInfo:
    """One sensor of the vehicle that is no camera.

    `SensorInfo(name, kind, most_records=1, ...)` makes one, for tests; without a mounting it looks along the nose.
    """

    def __new__(
        cls,
        name: str,
        kind: str,
        *,
        most_records: int = 1,
        rate_hz: float = 10.0,
        min_range_m: float = 0.0,
        max_range_m: float = 100.0,
        horizontal_fov_rad: float = 0.0,
        vertical_fov_rad: float = 0.0,
        body_from_sensor: Pose | None = None,
    ) -> SensorInfo: ...
    @property
    def name(self) -> str:
        """What `obs.sensor(name)` calls it."""

    @property
    def kind(self) -> str:
        """'lidar', 'range_finder', 'sonar' or 'radar'."""

    @property
    def rate_hz(self) -> float:
        """Readings a second. [Hz]"""

    @property
    def min_range_m(self) -> float:
        """Nearest that it measures. [m]"""

    @property
    def max_range_m(self) -> float:
        """Furthest that it measures. [m]"""

    @property
    def horizontal_fov_rad(self) -> float:
        """Width of what it sees. [rad]"""

    @property
    def vertical_fov_rad(self) -> float:
        """Height of what it sees. [rad]"""

    @property
    def body_from_sensor(self) -> Pose:
        """How it is mounted: sensor axes are x forward, y left, z up."""

@final
class SensorReading:
    """The newest reading of one sensor. It stays in later observations until the next one comes: `seq` tells whether
    it is new.
    """

    @property
    def name(self) -> str:
        """The sensor's name in `arena.toml`."""

    @property
    def kind(self) -> str:
        """'lidar', 'range_finder', 'sonar' or 'radar'."""

    @property
    def seq(self) -> int:
        """Counts this sensor's readings, from 1."""

    @property
    def stamp_ns(self) -> int:
        """When the newest pose behind it was measured. [ns, `time.monotonic_ns()`]"""

    @property
    def shown_ns(self) -> int:
        """The instant that it is of; of a sweep that of its last beam. [ns, `time.monotonic_ns()`]"""

    @property
    def ready_ns(self) -> int:
        """When the runtime had it. [ns, `time.monotonic_ns()`]"""

    @property
    def records(self) -> npt.NDArray[np.void]:
        """What was measured: a read-only structured view of shape (N,). [sensor: x forward, y left, z up]

        lidar: `p_m` (3 x float32, [m]), `before_ns` (uint32), `intensity` (uint16), `ring` (uint16);
        range_finder, sonar (N is 1): `range_m` (0 is no echo), `signal` (float32);
        radar: `range_m`, `azimuth_rad`, `radial_mps`, `snr_db`, `cross_section_m2` (float32).
        """

    @property
    def points_m(self) -> npt.NDArray[np.float32] | None:
        """The points of a LiDAR: a read-only view of shape (N, 3), float32; None of another sensor. [m, sensor]"""

    @property
    def range_m(self) -> float | None:
        """The distance that a range finder or a sonar has measured; None where nothing came back, and of other
        sensors. [m]
        """

    @property
    def body_from_sensor(self) -> Pose:
        """Where the sensor sits."""

    @property
    def pose_at_reading(self) -> Pose | None:
        """Where the body was at the instant that it is of; None where the course withholds the pose. [m, world]"""

@final
class CameraImage:
    """One camera's RGB-D image. Row 0 is the top; index arrays as [y, x]."""

    @property
    def name(self) -> str:
        """The camera's name in `arena.toml`: 'front'."""

    @property
    def seq(self) -> int:
        """Tick of the server that made the image; equal for all cameras of a tick."""

    @property
    def stamp_ns(self) -> int:
        """When the newest pose behind the image was measured. [ns, `time.monotonic_ns()`]"""

    @property
    def shown_ns(self) -> int:
        """The instant that the image shows, about now: where depth is to meet the vehicle's pose, take
        the pose of this instant. [ns, `time.monotonic_ns()`]"""

    @property
    def ready_ns(self) -> int:
        """When the runtime had the decoded image. [ns, `time.monotonic_ns()`]"""

    @property
    def width_px(self) -> int:
        """Width. [px]"""

    @property
    def height_px(self) -> int:
        """Height. [px]"""

    @property
    def rgb(self) -> npt.NDArray[np.uint8]:
        """Colour: a read-only view of shape (H, W, 3), uint8, sRGB, in the order red, green, blue.

        OpenCV shows it right after `cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)`.
        """

    @property
    def depth(self) -> npt.NDArray[np.float32]:
        """Depth along the optical axis: read-only, shape (H, W), float32; 0 is no return. [m, cam]

        Converted from `depth_mm` when asked for the first time (0.1 ms at 640x480).
        """

    @property
    def depth_mm(self) -> npt.NDArray[np.uint16]:
        """Depth along the optical axis: a read-only view of shape (H, W), uint16; 0 is no return. [mm, cam]"""

    def depth_m(self, x_px: int, y_px: int) -> float | None:
        """Returns the depth at column x, row y; None where there is no return. [m, cam]

        Raises IndexError outside the image.
        """

    @property
    def intrinsics(self) -> Intrinsics:
        """Size, focal lengths, principal point, lens."""

    @property
    def pose_at_image(self) -> Pose | None:
        """Where the body was at the instant that the image shows: what it was rendered from; None where the course
        withholds the pose. [m, world]
        """

    @property
    def body_from_cam(self) -> Pose:
        """How the camera is mounted."""

@final
class Vehicle:
    """What is known of the vehicle.

    `Vehicle(world_from_body, v_world_mps, omega_body_radps, ...)` makes one, for tests.
    """

    def __new__(
        cls,
        world_from_body: Pose | None = None,
        v_world_mps: _Vector | None = None,
        omega_body_radps: _Vector | None = None,
        *,
        attitude_xyzw: _Vector | None = None,
        stamp_ns: int = 0,
    ) -> Vehicle: ...
    @property
    def stamp_ns(self) -> int:
        """When this was true. [ns, `time.monotonic_ns()`]"""
    @property
    def attitude_xyzw(self) -> _F64:
        """Attitude as a unit quaternion x, y, z, w that rotates vectors from body to world axes: shape (4,),
        float64. The localized one where the course gives the pose, else the autopilot's estimate.
        """
    @property
    def yaw_rad(self) -> float:
        """Heading: angle of the nose from world x, counter-clockwise. [rad, world]"""
    @property
    def omega_body_radps(self) -> _F64:
        """Angular velocity: shape (3,), float64. [rad/s, body]"""
    @property
    def world_from_body(self) -> Pose | None:
        """Position and attitude as localized; None where the course withholds them. [m, world]"""
    @property
    def p_world_m(self) -> _F64 | None:
        """Position: shape (3,), float64; None where the course withholds it. [m, world]"""
    @property
    def v_world_mps(self) -> _F64 | None:
        """Velocity: shape (3,), float64; None where the course withholds it. [m/s, world]"""

@final
class ImuSample:
    """One reading of the autopilot's accelerometer and gyroscope.

    `ImuSample(accel_mps2, gyro_radps, stamp_ns=0)` makes one, for tests.
    """

    def __new__(
        cls, accel_mps2: _Vector, gyro_radps: _Vector, *, stamp_ns: int = 0
    ) -> ImuSample: ...
    @property
    def stamp_ns(self) -> int:
        """When it was measured. [ns, `time.monotonic_ns()`]"""
    @property
    def accel_mps2(self) -> _F64:
        """Specific force: shape (3,), float64; at rest and level +9.8 along z. [m/s^2, body]"""
    @property
    def gyro_radps(self) -> _F64:
        """Angular velocity: shape (3,), float64. [rad/s, body]"""

@final
class Battery:
    """The battery, as the autopilot measures it.

    `Battery(fraction=None, voltage_v=None)` makes one, for tests.
    """

    def __new__(
        cls, fraction: float | None = None, voltage_v: float | None = None
    ) -> Battery: ...
    @property
    def fraction(self) -> float | None:
        """What is left, 0 to 1; None if the autopilot does not know."""
    @property
    def voltage_v(self) -> float | None:
        """Voltage; None if it is not measured. [V]"""

@final
class Setpoint:
    """What a plugin asks of the vehicle; the newest one holds until the guard's deadline of 0.5 s.

    `yaw` is where the nose shall point: an angle from world x, counter-clockwise [rad]. `yaw_rate` is how
    fast it shall turn, counter-clockwise [rad/s]. Without either the heading stays; on a path the nose
    points into the direction of travel.

    `axes` are those in which a vector is given: 'world' (x east, y north, z up), 'heading' (x along the
    nose, y left, z up, levelled: ahead never means into the floor) or 'body' (x forward, y left, z up, as
    the vehicle is tilted at the moment).
    """

    @property
    def kind(self) -> str:
        """What it asks for: 'hold', 'land', 'take_off', 'position', 'offset', 'velocity', 'acceleration',
        'attitude_rate' or 'trajectory'.
        """
    @staticmethod
    def hold() -> Setpoint:
        """Stop and stay."""
    @staticmethod
    def land() -> Setpoint:
        """Come down here and disarm."""
    @staticmethod
    def take_off() -> Setpoint:
        """Go straight up or down to the height at which the plugin took over after take-off. (The runtime
        takes off by itself as soon as the plugin answers images.)
        """
    @staticmethod
    def position(
        p_world_m: _Vector,
        *,
        yaw: SupportsFloat | None = None,
        yaw_rate: SupportsFloat | None = None,
    ) -> Setpoint:
        """Fly to a point (3,) and stay. [m, world]"""
    @staticmethod
    def offset(
        d_m: _Vector,
        *,
        axes: _Axes = "world",
        yaw: SupportsFloat | None = None,
        yaw_rate: SupportsFloat | None = None,
    ) -> Setpoint:
        """Fly to a point (3,) given from where the vehicle is when the runtime takes this, and stay: for
        plugins that do not know their position. [m, axes]
        """
    @staticmethod
    def velocity(
        v_mps: _Vector,
        *,
        axes: _Axes = "world",
        yaw: SupportsFloat | None = None,
        yaw_rate: SupportsFloat | None = None,
    ) -> Setpoint:
        """Fly at a velocity (3,). [m/s, axes]"""
    @staticmethod
    def acceleration(
        a_mps2: _Vector,
        *,
        axes: _Axes = "world",
        yaw: SupportsFloat | None = None,
        yaw_rate: SupportsFloat | None = None,
    ) -> Setpoint:
        """Accelerate (3,), gravity already compensated: zero keeps the velocity. [m/s^2, axes]"""
    @staticmethod
    def attitude_rate(omega_body_radps: _Vector, thrust: SupportsFloat) -> Setpoint:
        """Turn at body rates (3,) [rad/s, body] under a thrust, of all motors together over the vehicle's
        weight: 1 carries it when level. Only where the course allows it (`ArenaInfo.attitude_rate`).
        """
    @staticmethod
    def waypoints(
        points_m: npt.ArrayLike,
        speed_mps: npt.ArrayLike = 1.0,
        *,
        id: int = 0,
        axes: _Axes = "world",
        yaw: SupportsFloat | None = None,
        yaw_rate: SupportsFloat | None = None,
    ) -> Setpoint:
        """Follow straight lines through up to 32 points (N, 3) [m, axes], at most at `speed_mps` (one number,
        or one per point for the way to it) [m/s], and stay at the last.

        The runtime follows it as long as the plugin answers images, with None or the same path again. A
        path of another `id` starts again. With axes 'heading' or 'body' the points count from where the
        vehicle is when the runtime takes the path.
        """
    @staticmethod
    def polynomial(
        seconds: npt.ArrayLike,
        coefficients: npt.ArrayLike,
        *,
        id: int = 0,
        axes: _Axes = "world",
        yaw: SupportsFloat | None = None,
        yaw_rate: SupportsFloat | None = None,
    ) -> Setpoint:
        """Follow up to 8 polynomial pieces, one after the other: piece i lasts `seconds[i]` [s], and after t
        seconds of it the position is the sum of `coefficients[i, k] * t**k`. `coefficients` has the shape
        (pieces, up to 8, 3). [m/s^k, axes]

        Otherwise as `waypoints`.
        """

@final
class Event:
    """One occurrence of the flight.

    `Event(kind, text, stamp_ns=0, **details)` makes one, for tests.
    """

    def __new__(cls, kind: str, text: str = "", *, stamp_ns: int = 0, **details: Any) -> Event: ...
    @property
    def kind(self) -> str:
        """What happened: 'collision', 'geofence', 'stage', 'finished', 'time_limit', 'pose_lost', 'pose_regained',
        'emergency_stop', 'phase', 'plugin_failed', 'note', 'start' or 'land'.
        """

    @property
    def details(self) -> dict[str, Any]:
        """What belongs to the kind, by name: `{'seconds': 12.4}` of 'finished', `{'phase': 'flying'}` of 'phase',
        `{'index': 0, 'name': 'gate'}` of 'stage', `{'p_world_m': [...], 'clearance_m': ...}` of 'collision'.
        """

    @property
    def text(self) -> str:
        """One sentence for a person."""

    @property
    def stamp_ns(self) -> int:
        """When, on the server's clock. [ns]"""

@final
class Pose:
    """A rigid transform that knows its two frames: `world_from_body` takes body coordinates to world
    coordinates, and is the pose of the body in the world.

    Frames are 'world' (x east, y north, z up), 'body' (x forward, y left, z up) and 'cam' (x right,
    y down, z forward). Composing is `@`, and works only where the frames meet:
    `world_from_body @ body_from_cam`.

    `Pose(into, from_, translation_m, rotation_xyzw)` makes one, for tests.
    """

    def __new__(
        cls,
        into: _Frame,
        from_: _Frame,
        translation_m: _Vector,
        rotation_xyzw: _Vector | None = None,
    ) -> Pose: ...
    @property
    def translation_m(self) -> _F64:
        """Origin of the right frame in the left one: shape (3,), float64. [m]"""

    @property
    def rotation_xyzw(self) -> _F64:
        """Unit quaternion x, y, z, w: shape (4,), float64."""

    @property
    def rotation_matrix(self) -> _F64:
        """Rotation as a matrix: shape (3, 3), float64."""

    @property
    def matrix(self) -> _F64:
        """The whole transform as a homogeneous matrix: shape (4, 4), float64."""

    @property
    def yaw_rad(self) -> float:
        """Heading: angle of the right frame's x axis about z, from x, counter-clockwise. [rad]"""

    def inverse(self) -> Pose:
        """Returns the transform the other way round."""

    def transform_point(self, points_m: npt.ArrayLike) -> _F64:
        """Takes a point (3,) or points (N, 3) from the right frame to the left one. [m]"""

    def rotate(self, vectors: npt.ArrayLike) -> _F64:
        """Takes a direction or velocity (3,), or many (N, 3), from the right frame to the left one."""

    def __matmul__(self, other: Pose) -> Pose: ...

@final
class Intrinsics:
    """Size, focal lengths, principal point and lens of a camera.

    Pixels are continuous: (0, 0) is the outer corner of the top-left pixel, its centre is (0.5, 0.5).
    """

    def __new__(
        cls, width_px: int, height_px: int, fx_px: float, fy_px: float, cx_px: float, cy_px: float
    ) -> Intrinsics: ...
    @staticmethod
    def from_horizontal_fov(width_px: int, height_px: int, fov_rad: float) -> Intrinsics:
        """Makes a camera with square pixels, a centred principal point and this field of view. [px, rad]"""

    @property
    def width_px(self) -> int:
        """Image width. [px]"""

    @property
    def height_px(self) -> int:
        """Image height. [px]"""

    @property
    def fx_px(self) -> float:
        """Focal length along x. [px]"""

    @property
    def fy_px(self) -> float:
        """Focal length along y. [px]"""

    @property
    def cx_px(self) -> float:
        """Principal point, x; the image's centre is `width_px / 2`. [px]"""

    @property
    def cy_px(self) -> float:
        """Principal point, y. [px]"""

    @property
    def distortion_model(self) -> Literal["none", "brown_conrady", "kannala_brandt"]:
        """The lens: 'none', 'brown_conrady' (OpenCV's usual model) or 'kannala_brandt' (its fisheye)."""

    @property
    def distortion(self) -> _F64:
        """The lens's coefficients in OpenCV's order: shape (0,), (5,) or (4,), float64."""

    @property
    def matrix(self) -> _F64:
        """The camera matrix: shape (3, 3), float64. [px]"""

    @property
    def opencv_matrix(self) -> _F64:
        """The camera matrix for OpenCV, whose (0, 0) is the centre of the top-left pixel: half a pixel less.
        Shape (3, 3), float64. [px]
        """

    def project(self, p_cam_m: npt.ArrayLike) -> _F64:
        """Returns where a point (3,) [m, cam] lies in the image: shape (2,) [px]; of points (N, 3), shape (N, 2).
        NaN for what lies behind the camera or out of the lens's reach.
        """

def course_map() -> list[Volume] | None:
    """Returns every obstacle of the course, where its map is known; None where it is not. [world]

    # Errors
    `ValueError` for a map that cannot be read.
    """

@final
class Volume:
    """A solid in the world frame: sphere, box, capsule or half space."""

    @staticmethod
    def sphere(center_m: _Vector, radius_m: float) -> Volume:
        """Makes a sphere. [m, world]"""

    @staticmethod
    def aabb(min_m: _Vector, max_m: _Vector) -> Volume:
        """Makes a box from two opposite corners, its sides along the axes. [m, world]"""

    def signed_distance_m(self, p_world_m: npt.ArrayLike) -> Any:
        """Returns how far a point (3,), or each of points (N, 3), is from the surface: negative inside.
        A float or shape (N,), float64. [m, world]
        """

@final
class ObservationBuffer:
    """Observations made by hand: for a plugin's own tests and for notebooks.

    `ObservationBuffer([CameraInfo(...)], [SensorInfo(...)])` has planes for these cameras, and room for these sensors.
    """

    def __new__(
        cls, cameras: Sequence[CameraInfo], sensors: Sequence[SensorInfo] = ...
    ) -> ObservationBuffer: ...
    def clear(self, seq: int = 0) -> None:
        """Empties it and numbers it."""

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Fills in what is known of the vehicle."""

    def set_battery(self, battery: Battery) -> None:
        """Fills in the battery's state."""
    def set_imu(self, samples: Sequence[ImuSample]) -> None:
        """Fills in the newest IMU samples, oldest first; those with stamps that a plugin has had already, it
        does not get again.
        """
    def set_image(
        self,
        name: str,
        rgb: npt.NDArray[np.uint8] | None = None,
        depth_mm: npt.NDArray[np.uint16] | None = None,
        *,
        seq: int = 0,
        stamp_ns: int = 0,
        ready_ns: int | None = None,
    ) -> None:
        """Fills in a camera's image: `rgb` (H, W, 3) uint8, `depth_mm` (H, W) uint16; black and without
        returns where not given. Stamps are of `time.monotonic_ns()`. [ns]
        """

    def set_pose_at_image(self, name: str, world_from_body: Pose) -> None:
        """Fills in where the body was at the instant that a camera's image shows."""

    def set_reading(
        self,
        name: str,
        records: bytes | npt.NDArray[np.void],
        *,
        seq: int = 1,
        stamp_ns: int = 0,
        pose_at_reading: Pose | None = None,
    ) -> None:
        """Fills in a sensor's reading: `records` as bytes or as an array of the layout that `SensorReading.records`
        documents. `pose_at_reading` is where the body was. Stamps are of `time.monotonic_ns()`. [ns]
        """

    def observation(self) -> Observation:
        """Returns what a plugin would see."""

@final
class Rehearsal:
    """A runtime without a flight: plays the runtime's part for a plugin that runs on another thread, or in
    another process, attached to `service`. With `waiting`, `vizflyt.run` finds it by itself.
    """

    def __new__(cls, cameras: Sequence[CameraInfo], *, waiting: bool = False) -> Rehearsal: ...
    @property
    def service(self) -> str:
        """What the plugin attaches to: `vizflyt.run(MyPlugin, service=...)`."""

    @property
    def is_attached(self) -> bool:
        """Whether a plugin has attached: from then on messages reach it."""

    def start(self, info: ArenaInfo) -> None:
        """Sends the plugin its arena."""

    def note(self, text: str) -> None:
        """Tells it an event of kind 'note'."""

    def finish(self, seconds: float) -> None:
        """Tells it that the goal was reached after so many seconds."""

    def stop(self) -> None:
        """Tells it to end."""

    def publish(self, buffer: ObservationBuffer) -> None:
        """Hands it the buffer's images, through shared memory."""

    def receive(
        self, timeout_s: float = 10.0
    ) -> tuple[Literal["ready", "odometry", "answer", "failed"], int, Any, int] | None:
        """Waits for a message of the plugin: ('ready', 0, name, 0), ('odometry', 0, pose, stamp_ns),
        ('answer', seq, setpoint, entered_ns) or ('failed', 0, reason, 0); None if none comes within this time. [s]
        """

class NotFiniteError(ValueError):
    """A NaN or an infinity where a number must be finite. Out of `on_image` it counts as an answer that the
    runtime refuses: the vehicle holds after 0.5 s and lands after 2 s without a better one.
    """

@final
class PluginEnd:
    """Not for plugins: what `vizflyt.run` is made of."""

    def __new__(cls, service: str) -> PluginEnd: ...
    def wait(self, timeout_s: float) -> bool:
        """Waits until there is something to take, `timeout_s` at most; returns whether there is."""

    def receive(self) -> tuple[Literal["start", "event", "stop", "gone"], Any] | None:
        """Returns the runtime's next message: ("start", `ArenaInfo`), ("event", Event), ("stop", None),
        or None if there is none; ("gone", None) once the runtime has ended.
        """

    def observation(self) -> Observation | None:
        """Returns the newest observation, if there is one not taken yet."""

    def ready(self, name: str) -> None:
        """Reports that `on_start` has returned."""

    def answer(self, seq: int, entered_ns: int, setpoint: Setpoint | None) -> None:
        """Sends the answer to one observation."""

    def answer_not_finite(self, seq: int, entered_ns: int) -> None:
        """Answers one observation with a setpoint that is not finite, which the runtime refuses by that name."""

    def failed(self, reason: str) -> None:
        """Reports that the plugin has failed, with the reason."""

def publish_odometry(stamp_ns: int, p_odom_m: _Vector, rotation_xyzw: npt.ArrayLike) -> None:
    """Publishes where the plugin thinks the vehicle was at `stamp_ns`; of an estimate from an image that is
    `image.shown_ns`. It leaves with the answer to the image, is logged on `/odometry`, and `vizflyt grade` reports how
    far off it was. Nothing is flown by it.

    `p_odom_m` is the body's position, shape (3,) [m]; `rotation_xyzw` the unit quaternion that rotates from body to
    odom axes, shape (4,). z of the frame `odom` is up; its origin and heading are the plugin's choice.

    Raises NotFiniteError or ValueError for what is no pose, ValueError for more than four in one `on_image`.
    """

def decode_image(
    bitstream: bytes, jpeg: bytes | None = None
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint16]]:
    """Not for plugins: returns colour (H, W, 3) and depth (H, W) [mm] of an image as logs hold it, whose colour may be
    apart.

    Raises ValueError for what does not decode.
    """

def waiting_services() -> list[str]:
    """Returns the services of this user's runtimes that wait for a plugin, the longest waiting first."""
