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
    """Description of the arena in which the plugin flies.

    `ArenaInfo(goal_m=[5, 0, 1], ...)` creates one for tests; every keyword has a default.
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
        """Name of the arena."""

    @property
    def geofence(self) -> Volume:
        """Volume in which the body's surface must stay. [world]"""

    @property
    def no_fly(self) -> list[Volume]:
        """Volumes that the body's surface must not enter. [world]"""

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
        """Height above the start to which the runtime climbs before the plugin gets control. [m]"""

    @property
    def goal_m(self) -> _F64 | None:
        """Goal of the flight: shape (3,), float64; None if the course has no goal. [m, world]"""

    @property
    def goal_radius_m(self) -> float:
        """Distance at which the goal counts as reached. [m]"""

    @property
    def time_limit_s(self) -> float:
        """Time limit from take-off; 0 means no limit. [s]"""

    @property
    def start_box(self) -> Volume | None:
        """Box in which a flight begins; None if anywhere. [world]"""

    @property
    def ground_truth(self) -> bool:
        """Whether the plugin receives the vehicle's pose and velocity."""
    @property
    def attitude_rate(self) -> bool:
        """Whether `Setpoint.attitude_rate` is allowed."""

    @property
    def setpoints(self) -> list[str]:
        """Allowed kinds of setpoint, of 'position', 'velocity', 'acceleration', 'offset', 'attitude_rate' and
        'trajectory'. hold, land and take_off are always allowed.
        """

    @property
    def cameras(self) -> list[CameraInfo]:
        """Cameras of the vehicle."""

    @property
    def sensors(self) -> list[SensorInfo]:
        """Sensors of the vehicle other than cameras."""

@final
class CameraInfo:
    """One camera of the vehicle.

    `CameraInfo(name, intrinsics, body_from_cam=None)` creates one for tests. Without `body_from_cam` it looks
    forward.
    """

    def __new__(
        cls, name: str, intrinsics: Intrinsics, body_from_cam: Pose | None = None
    ) -> CameraInfo: ...
    @property
    def name(self) -> str:
        """Name of the camera, the argument of `obs.camera(name)`."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Size, focal lengths, principal point, lens."""

    @property
    def body_from_cam(self) -> Pose:
        """Pose of the camera on the body."""

@final
class Limits:
    """Limits that the guard enforces on every setpoint."""

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
        """Maximum tilt from level; None if only the acceleration limits it. [deg]"""
    @property
    def max_altitude_m(self) -> float | None:
        """Maximum height of the body's centre; None if only the geofence limits it. [m, world]"""
    @property
    def max_speed_mps(self) -> float:
        """Maximum speed. [m/s]"""

    @property
    def max_acceleration_mps2(self) -> float:
        """Maximum acceleration; the guard also assumes it for stopping. [m/s^2]"""

@final
class Observation:
    """The vehicle and the images of its cameras at one moment.

    Images lie in shared memory and are not copied. Images that you keep after `on_image` do not change. If you
    keep more than the newest two, later images are copied, with a warning.
    """

    @property
    def seq(self) -> int:
        """Number of the observation in this flight; missing numbers were skipped."""

    @property
    def stamp_ns(self) -> int:
        """Measurement time of the newest image's pose. [ns, `time.monotonic_ns()`]"""

    def camera(self, name: str) -> CameraImage | None:
        """Returns the image of the camera with this name; None if there is no image yet.

        Raises LookupError if the vehicle has no such camera.
        """

    @property
    def cameras(self) -> list[CameraImage]:
        """Available images, in the order of the arena's cameras."""

    def sensor(self, name: str) -> SensorReading | None:
        """Returns the newest reading of the sensor with this name; None if there is no reading yet.

        Raises LookupError if the vehicle has no such sensor.
        """

    @property
    def sensors(self) -> list[SensorReading]:
        """Newest available readings, in the order of the arena's sensors."""

    @property
    def pose_at_image(self) -> Pose | None:
        """Pose of the body at the instant that the newest image shows, which belongs to its pixels. None without an
        image, and if the course withholds the pose. [m, world]
        """

    @property
    def vehicle(self) -> Vehicle | None:
        """State of the vehicle; None before the first one."""

    @property
    def imu(self) -> list[ImuSample]:
        """IMU samples of the autopilot since the plugin's previous image, oldest first. At most the newest 64 (0.6
        s at 100 Hz).
        """
    @property
    def battery(self) -> Battery:
        """State of the battery."""
    @property
    def is_copy(self) -> bool:
        """Whether the images are copies, because the plugin keeps too many earlier ones."""

@final
class SensorInfo:
    """One sensor of the vehicle other than a camera.

    `SensorInfo(name, kind, most_records=1, ...)` creates one for tests. Without `body_from_sensor` it points
    forward.
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
        """Name of the sensor, the argument of `obs.sensor(name)`."""

    @property
    def kind(self) -> str:
        """Kind: 'lidar', 'range_finder', 'sonar' or 'radar'."""

    @property
    def rate_hz(self) -> float:
        """Rate of readings. [Hz]"""

    @property
    def min_range_m(self) -> float:
        """Minimum range. [m]"""

    @property
    def max_range_m(self) -> float:
        """Maximum range. [m]"""

    @property
    def horizontal_fov_rad(self) -> float:
        """Horizontal field of view. [rad]"""

    @property
    def vertical_fov_rad(self) -> float:
        """Vertical field of view. [rad]"""

    @property
    def body_from_sensor(self) -> Pose:
        """Pose of the sensor on the body. Sensor axes are x forward, y left, z up."""

@final
class SensorReading:
    """Newest reading of one sensor. It stays in later observations until the next one arrives; a changed `seq`
    marks a new reading.
    """

    @property
    def name(self) -> str:
        """Name of the sensor in `arena.toml`."""

    @property
    def kind(self) -> str:
        """Kind: 'lidar', 'range_finder', 'sonar' or 'radar'."""

    @property
    def seq(self) -> int:
        """Number of the reading, from 1."""

    @property
    def stamp_ns(self) -> int:
        """Measurement time of the newest pose behind the reading. [ns, `time.monotonic_ns()`]"""

    @property
    def shown_ns(self) -> int:
        """Instant of the reading; for a sweep, the instant of its last beam. [ns, `time.monotonic_ns()`]"""

    @property
    def ready_ns(self) -> int:
        """Time at which the runtime received the reading. [ns, `time.monotonic_ns()`]"""

    @property
    def records(self) -> npt.NDArray[np.void]:
        """Measured values: a read-only structured view of shape (N,). [sensor: x forward, y left, z up]

        lidar: `p_m` (3 x float32, [m]), `before_ns` (uint32), `intensity` (uint16), `ring` (uint16);
        range_finder, sonar (N is 1): `range_m` (0 means no echo), `signal` (float32);
        radar: `range_m`, `azimuth_rad`, `radial_mps`, `snr_db`, `cross_section_m2` (float32).
        """

    @property
    def points_m(self) -> npt.NDArray[np.float32] | None:
        """Points of a LiDAR: a read-only view of shape (N, 3), float32; None for other sensors. [m, sensor]"""

    @property
    def range_m(self) -> float | None:
        """Distance measured by a range finder or sonar; None without a return, and for other sensors. [m]"""

    @property
    def body_from_sensor(self) -> Pose:
        """Pose of the sensor on the body."""

    @property
    def pose_at_reading(self) -> Pose | None:
        """Pose of the body at the instant of the reading; None if the course withholds the pose. [m, world]"""

@final
class CameraImage:
    """RGB-D image of one camera. Row 0 is the top; index arrays as [y, x]."""

    @property
    def name(self) -> str:
        """Name of the camera in `arena.toml`, for example 'front'."""

    @property
    def seq(self) -> int:
        """Server tick that rendered the image; equal for all cameras of a tick."""

    @property
    def stamp_ns(self) -> int:
        """Measurement time of the newest pose behind the image. [ns, `time.monotonic_ns()`]"""

    @property
    def shown_ns(self) -> int:
        """Instant that the image shows, which is about now. To combine depth with the vehicle's pose, use the pose
        at this instant. [ns, `time.monotonic_ns()`]
        """

    @property
    def ready_ns(self) -> int:
        """Time at which the runtime had decoded the image. [ns, `time.monotonic_ns()`]"""

    @property
    def width_px(self) -> int:
        """Width. [px]"""

    @property
    def height_px(self) -> int:
        """Height. [px]"""

    @property
    def rgb(self) -> npt.NDArray[np.uint8]:
        """Colour: a read-only view of shape (H, W, 3), uint8, sRGB, in the order red, green, blue.

        For OpenCV, convert it with `cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)`.
        """

    @property
    def depth(self) -> npt.NDArray[np.float32]:
        """Depth along the optical axis: read-only, shape (H, W), float32; 0 means no return. [m, cam]

        Converted from `depth_mm` on first access (0.1 ms at 640x480).
        """

    @property
    def depth_mm(self) -> npt.NDArray[np.uint16]:
        """Depth along the optical axis: a read-only view of shape (H, W), uint16; 0: no return. [mm, cam]"""

    def depth_m(self, x_px: int, y_px: int) -> float | None:
        """Returns the depth at column x, row y; None without a return. [m, cam]

        Raises IndexError outside the image.
        """

    @property
    def intrinsics(self) -> Intrinsics:
        """Size, focal lengths, principal point, lens."""

    @property
    def pose_at_image(self) -> Pose | None:
        """Pose of the body at the instant that the image shows, from which the image was rendered. None if the
        course withholds the pose. [m, world]
        """

    @property
    def body_from_cam(self) -> Pose:
        """Pose of the camera on the body."""

@final
class Vehicle:
    """State of the vehicle.

    `Vehicle(world_from_body, v_world_mps, omega_body_radps, ...)` creates one for tests.
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
        """Time of this state. [ns, `time.monotonic_ns()`]"""
    @property
    def attitude_xyzw(self) -> _F64:
        """Attitude as a unit quaternion x, y, z, w that rotates vectors from body to world axes: shape (4,),
        float64. From localization if the course gives the pose, otherwise the autopilot's estimate.
        """
    @property
    def yaw_rad(self) -> float:
        """Heading: angle of the nose from world x, counter-clockwise. [rad, world]"""
    @property
    def omega_body_radps(self) -> _F64:
        """Angular velocity: shape (3,), float64. [rad/s, body]"""
    @property
    def world_from_body(self) -> Pose | None:
        """Position and attitude from localization; None if the course withholds them. [m, world]"""
    @property
    def p_world_m(self) -> _F64 | None:
        """Position: shape (3,), float64; None if the course withholds it. [m, world]"""
    @property
    def v_world_mps(self) -> _F64 | None:
        """Velocity: shape (3,), float64; None if the course withholds it. [m/s, world]"""

@final
class ImuSample:
    """One sample of the autopilot's accelerometer and gyroscope.

    `ImuSample(accel_mps2, gyro_radps, stamp_ns=0)` creates one for tests.
    """

    def __new__(
        cls, accel_mps2: _Vector, gyro_radps: _Vector, *, stamp_ns: int = 0
    ) -> ImuSample: ...
    @property
    def stamp_ns(self) -> int:
        """Time of the measurement. [ns, `time.monotonic_ns()`]"""
    @property
    def accel_mps2(self) -> _F64:
        """Specific force: shape (3,), float64; at rest and level +9.8 along z. [m/s^2, body]"""
    @property
    def gyro_radps(self) -> _F64:
        """Angular velocity: shape (3,), float64. [rad/s, body]"""

@final
class Battery:
    """State of the battery, as measured by the autopilot.

    `Battery(fraction=None, voltage_v=None)` creates one for tests.
    """

    def __new__(
        cls, fraction: float | None = None, voltage_v: float | None = None
    ) -> Battery: ...
    @property
    def fraction(self) -> float | None:
        """Remaining charge, 0 to 1; None if the autopilot does not report it."""
    @property
    def voltage_v(self) -> float | None:
        """Voltage; None if it is not measured. [V]"""

@final
class Setpoint:
    """Requested motion of the vehicle. The newest setpoint stays in force until the guard's deadline of 0.5 s.

    `yaw` is the direction of the nose: an angle from world x, counter-clockwise [rad]. `yaw_rate` is the rate of
    turn, counter-clockwise [rad/s]. Without either, the heading does not change; on a path the nose points in
    the direction of travel.

    `axes` are the axes of a vector: 'world' (x east, y north, z up), 'heading' (x along the nose, y left, z up,
    level: forward never points at the floor) or 'body' (x forward, y left, z up, with the vehicle's current
    tilt).
    """

    @property
    def kind(self) -> str:
        """Kind of setpoint: 'hold', 'land', 'take_off', 'position', 'offset', 'velocity', 'acceleration',
        'attitude_rate' or 'trajectory'.
        """
    @staticmethod
    def hold() -> Setpoint:
        """Stop and stay."""
    @staticmethod
    def land() -> Setpoint:
        """Land here and disarm."""
    @staticmethod
    def take_off() -> Setpoint:
        """Climb or descend vertically to the height at which the plugin got control after take-off. (The runtime
        takes off automatically as soon as the plugin replies to images.)
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
        """Fly to a point (3,) relative to the vehicle's position at the time when the runtime takes the setpoint,
        and stay: for plugins that do not have their position. [m, axes]
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
        """Accelerate (3,). Gravity is compensated: zero keeps the velocity. [m/s^2, axes]"""
    @staticmethod
    def attitude_rate(omega_body_radps: _Vector, thrust: SupportsFloat) -> Setpoint:
        """Turn at body rates (3,) [rad/s, body] with a thrust of all motors, relative to the vehicle's weight: 1
        carries the level vehicle. Only if the course allows it (`ArenaInfo.attitude_rate`).
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
        """Follow straight lines through up to 32 points (N, 3) [m, axes], with a maximum speed of `speed_mps` (one
        number, or one per point for the way to it) [m/s], and stay at the last point.

        The runtime follows the path as long as the plugin replies to images, with None or the same path. A path
        with another `id` starts from its first point. With axes 'heading' or 'body', the points are relative to
        the vehicle's position at the time when the runtime takes the path.
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
        """Follow up to 8 polynomial pieces, one after the other. Piece i takes `seconds[i]` [s]; t seconds after
        its start, the position is the sum of `coefficients[i, k] * t**k`. `coefficients` has the shape (pieces,
        up to 8, 3). [m/s^k, axes]

        Otherwise as `waypoints`.
        """

@final
class Event:
    """One event of the flight.

    `Event(kind, text, stamp_ns=0, **details)` creates one for tests.
    """

    def __new__(cls, kind: str, text: str = "", *, stamp_ns: int = 0, **details: Any) -> Event: ...
    @property
    def kind(self) -> str:
        """Kind of event: 'collision', 'geofence', 'stage', 'finished', 'time_limit', 'pose_lost', 'pose_regained',
        'emergency_stop', 'phase', 'ended', 'note', 'start' or 'land'. The documentation lists them in 'Events'.
        """

    @property
    def details(self) -> dict[str, Any]:
        """Fields of the kind by name: `{'seconds': 12.4}` for 'finished', `{'phase': 'flying'}` for 'phase',
        `{'index': 0, 'name': 'gate'}` for 'stage', `{'p_world_m': [...], 'clearance_m': ...}` for 'collision'.
        """

    @property
    def text(self) -> str:
        """Description in words."""

    @property
    def stamp_ns(self) -> int:
        """Time on the server's clock. [ns]"""

@final
class Pose:
    """A rigid transform between two named frames. `world_from_body` converts body coordinates to world coordinates,
    and is the pose of the body in the world.

    Frames are 'world' (x east, y north, z up), 'body' (x forward, y left, z up) and 'cam' (x right, y down, z
    forward). `@` composes poses. The inner frames must be the same: `world_from_body @ body_from_cam`.

    `Pose(into, from_, translation_m, rotation_xyzw)` creates one for tests.
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
        """Complete transform as a homogeneous matrix: shape (4, 4), float64."""

    @property
    def yaw_rad(self) -> float:
        """Heading: angle of the right frame's x axis about z, from x, counter-clockwise. [rad]"""

    def inverse(self) -> Pose:
        """Returns the inverse transform."""

    def transform_point(self, points_m: npt.ArrayLike) -> _F64:
        """Converts a point (3,) or points (N, 3) from the right frame to the left one. [m]"""

    def rotate(self, vectors: npt.ArrayLike) -> _F64:
        """Rotates a direction or velocity (3,), or many (N, 3), from the right frame to the left one."""

    def __matmul__(self, other: Pose) -> Pose: ...

@final
class Intrinsics:
    """Size, focal lengths, principal point and lens of a camera.

    Pixels are continuous: (0, 0) is the outer corner of the top-left pixel, (0.5, 0.5) is its centre.
    """

    def __new__(
        cls, width_px: int, height_px: int, fx_px: float, fy_px: float, cx_px: float, cy_px: float
    ) -> Intrinsics: ...
    @staticmethod
    def from_horizontal_fov(width_px: int, height_px: int, fov_rad: float) -> Intrinsics:
        """Creates a camera with square pixels, a centred principal point and this field of view. [px, rad]"""

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
        """Lens model: 'none', 'brown_conrady' (OpenCV's standard model) or 'kannala_brandt' (its fisheye model)."""

    @property
    def distortion(self) -> _F64:
        """Distortion coefficients in OpenCV's order: shape (0,), (5,) or (4,), float64."""

    @property
    def matrix(self) -> _F64:
        """Camera matrix: shape (3, 3), float64. [px]"""

    @property
    def opencv_matrix(self) -> _F64:
        """Camera matrix for OpenCV, where (0, 0) is the centre of the top-left pixel: the principal point is
        smaller by half a pixel. Shape (3, 3), float64. [px]
        """

    def project(self, p_cam_m: npt.ArrayLike) -> _F64:
        """Returns the pixel of a point (3,) [m, cam]: shape (2,) [px]. For points (N, 3), shape (N, 2). NaN for
        points behind the camera or outside the range of the lens model.
        """

def course_map() -> list[Volume] | None:
    """Returns every obstacle of the course, or None if the course does not give the map. [world]

    Raises ValueError if the map cannot be read.
    """

@final
class Volume:
    """A solid volume in the world frame: sphere, box, capsule or half space."""

    @staticmethod
    def sphere(center_m: _Vector, radius_m: float) -> Volume:
        """Creates a sphere. [m, world]"""

    @staticmethod
    def aabb(min_m: _Vector, max_m: _Vector) -> Volume:
        """Creates a box from two opposite corners, with its sides along the axes. [m, world]"""

    def signed_distance_m(self, p_world_m: npt.ArrayLike) -> Any:
        """Returns the distance of a point (3,), or of points (N, 3), from the surface; negative inside. A float or
        shape (N,), float64. [m, world]
        """

@final
class ObservationBuffer:
    """Observations created by hand, for a plugin's own tests and for notebooks.

    `ObservationBuffer([CameraInfo(...)], [SensorInfo(...)])` has planes for these cameras and space for these
    sensors.
    """

    def __new__(
        cls, cameras: Sequence[CameraInfo], sensors: Sequence[SensorInfo] = ...
    ) -> ObservationBuffer: ...
    def clear(self, seq: int = 0) -> None:
        """Removes all content and sets the number of the observation."""

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Sets the state of the vehicle."""

    def set_battery(self, battery: Battery) -> None:
        """Sets the state of the battery."""
    def set_imu(self, samples: Sequence[ImuSample]) -> None:
        """Sets the newest IMU samples, oldest first. A plugin receives each stamp only once."""
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
        """Sets a camera's image: `rgb` (H, W, 3) uint8, `depth_mm` (H, W) uint16. The default is black, without
        returns. Stamps are `time.monotonic_ns()`. [ns]
        """

    def set_pose_at_image(self, name: str, world_from_body: Pose) -> None:
        """Sets the pose of the body at the instant that a camera's image shows."""

    def set_reading(
        self,
        name: str,
        records: bytes | npt.NDArray[np.void],
        *,
        seq: int = 1,
        stamp_ns: int = 0,
        pose_at_reading: Pose | None = None,
    ) -> None:
        """Sets a sensor's reading: `records` as bytes, or as an array with the layout of `SensorReading.records`.
        `pose_at_reading` is the pose of the body. Stamps are `time.monotonic_ns()`. [ns]
        """

    def observation(self) -> Observation:
        """Returns the observation that a plugin would receive."""

@final
class Rehearsal:
    """A runtime without a flight, for a plugin that runs on another thread or in another process, attached to
    `service`. With `waiting`, `vizflyt.run` finds it automatically.
    """

    def __new__(cls, cameras: Sequence[CameraInfo], *, waiting: bool = False) -> Rehearsal: ...
    @property
    def service(self) -> str:
        """Service that the plugin attaches to: `vizflyt.run(MyPlugin, service=...)`."""

    @property
    def is_attached(self) -> bool:
        """Whether a plugin is attached, so that messages reach it."""

    def start(self, info: ArenaInfo) -> None:
        """Sends the description of the arena to the plugin."""

    def note(self, text: str) -> None:
        """Sends an event of kind 'note'."""

    def finish(self, seconds: float) -> None:
        """Sends the event that the goal was reached after this time. [s]"""

    def stop(self) -> None:
        """Requests the plugin to stop."""

    def publish(self, buffer: ObservationBuffer) -> None:
        """Publishes the buffer's images through shared memory."""

    def receive(
        self, timeout_s: float = 10.0
    ) -> tuple[Literal["ready", "odometry", "answer", "failed"], int, Any, int] | None:
        """Waits for a message of the plugin: ('ready', 0, name, 0), ('odometry', 0, pose, stamp_ns), ('answer',
        seq, setpoint, entered_ns) or ('failed', 0, reason, 0). None after a timeout. [s]
        """

class NotFiniteError(ValueError):
    """A NaN or an infinity where a number must be finite. Raised by `on_image`, it counts as a reply that the
    runtime rejects: the vehicle holds after 0.5 s and lands after 2 s without a valid one.
    """

@final
class PluginEnd:
    """Not for plugins: connection to the runtime, used by `vizflyt.run`."""

    def __new__(cls, service: str) -> PluginEnd: ...
    def wait(self, timeout_s: float) -> bool:
        """Waits for a message or an observation, at most `timeout_s`; returns whether there is one."""

    def receive(self) -> tuple[Literal["start", "event", "stop", "gone"], Any] | None:
        """Returns the runtime's next message: ("start", `ArenaInfo`), ("event", Event) or ("stop", None). None if
        no message is waiting; ("gone", None) after the runtime has ended.
        """

    def observation(self) -> Observation | None:
        """Returns the newest observation, unless it was returned before."""

    def ready(self, name: str) -> None:
        """Reports that `on_start` has returned."""

    def answer(self, seq: int, entered_ns: int, setpoint: Setpoint | None) -> None:
        """Sends the reply to one observation."""

    def answer_not_finite(self, seq: int, entered_ns: int) -> None:
        """Replies to one observation with a setpoint that is not finite, so that the runtime rejects it with this
        reason.
        """

    def failed(self, reason: str) -> None:
        """Reports that the plugin has failed, with the reason."""

def publish_odometry(stamp_ns: int, p_odom_m: _Vector, rotation_xyzw: npt.ArrayLike) -> None:
    """Publishes the plugin's estimate of the vehicle's pose at `stamp_ns`. For an estimate from an image, pass
    `image.shown_ns`. The estimate is sent with the reply to the image and logged on `/odometry`, and `vizflyt
    grade` reports its error. It does not control the flight.

    `p_odom_m` is the body's position, shape (3,) [m]; `rotation_xyzw` is the unit quaternion that rotates from
    body to odom axes, shape (4,). z of the frame `odom` is up; the plugin chooses its origin and heading.

    Raises NotFiniteError or ValueError for an invalid pose, ValueError for more than four in one `on_image`.
    """

def decode_image(
    bitstream: bytes, jpeg: bytes | None = None
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint16]]:
    """Not for plugins: returns colour (H, W, 3) and depth (H, W) [mm] of an image in a log. `jpeg` is the colour if
    the log stores it separately.

    Raises ValueError if the image does not decode.
    """

def waiting_services() -> list[str]:
    """Returns the services of this user's runtimes that wait for a plugin, the longest waiting first."""
