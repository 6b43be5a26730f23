"""A flight's log as numpy arrays: images by the instant that they show, poses, IMU, setpoints."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, overload

import numpy as np
import numpy.typing as npt

from ._mcap import DamagedMessageError, McapFile, Place, fields
from ._vizflyt import PROTOCOL_VERSION, Pose, decode_image

_F64 = npt.NDArray[np.float64]
_I64 = npt.NDArray[np.int64]

# Oldest protocol version with this layout of images.
FIRST_PROTOCOL = 13
# Layout of an image's header: rotation and position of the camera in the world, of the camera on the body, intrinsics,
# distortion.
NUMBERS_AT, NUMBERS, SIZE_AT, HEADER = 48, struct.Struct("<23d"), 232, 252
LENSES = {0: "none", 1: "brown_conrady", 2: "kannala_brandt"}


class Poses(NamedTuple):
    """Poses in the order of their instants."""

    at_ns: _I64
    """Shape (N,). [ns, since 1970]"""
    p_m: _F64
    """Position of the body, shape (N, 3). [m]"""
    q_xyzw: _F64
    """Unit quaternions from body axes to those of the frame, shape (N, 4)."""
    frame: Literal["world", "odom"] = "world"
    """Frame of the poses."""

    def at(self, at_ns: int) -> Pose | None:
        """Returns the pose at an instant, interpolated between poses at most 0.2 s apart; otherwise None."""
        after = int(np.searchsorted(self.at_ns, at_ns))
        if after == len(self.at_ns):
            return None
        if self.at_ns[after] == at_ns:
            return Pose(self.frame, "body", self.p_m[after], _unit(self.q_xyzw[after]))
        if after == 0 or self.at_ns[after] - self.at_ns[after - 1] > 200_000_000:
            return None
        share = (at_ns - self.at_ns[after - 1]) / (self.at_ns[after] - self.at_ns[after - 1])
        p_m = (1 - share) * self.p_m[after - 1] + share * self.p_m[after]
        return Pose(self.frame, "body", p_m, _slerp(self.q_xyzw[after - 1], self.q_xyzw[after], share))


class Motion(NamedTuple):
    """Velocities of the poses, and standard deviations."""

    at_ns: _I64
    v_world_mps: _F64
    """Shape (N, 3). [m/s, world]"""
    omega_body_radps: _F64
    """Shape (N, 3). [rad/s, body]"""
    position_sigma_m: _F64
    """One standard deviation for each axis, shape (N, 3); 0 means unknown. [m, world]"""
    rotation_sigma_rad: _F64
    """One standard deviation about each axis, shape (N, 3); 0 means unknown. [rad, body]"""


class Imu(NamedTuple):
    """The autopilot's IMU."""

    at_ns: _I64
    """Shape (N,). [ns, since 1970]"""
    accel_mps2: _F64
    """Specific force, shape (N, 3): at rest and level +9.8 along z. [m/s^2, body]"""
    gyro_radps: _F64
    """Shape (N, 3). [rad/s, body]"""


class Sent(NamedTuple):
    """Setpoints after the guard, as sent to the autopilot."""

    at_ns: _I64
    v_world_mps: _F64
    """Shape (N, 3). [m/s, world]"""
    yaw_rad: _F64
    """Shape (N,); NaN if not set. [rad, world]"""
    yaw_rate_radps: _F64
    """Shape (N,); NaN if not set. [rad/s]"""


class LogImage(NamedTuple):
    """One image of a log, decoded."""

    camera: str
    """Name of the camera."""
    shown_ns: int
    """Instant that the image shows. [ns, since 1970]"""
    pose_stamp_ns: int
    """Measurement time of the newest pose behind the image. [ns, since 1970]"""
    seq: int
    """Number of the observation with this image."""
    rgb: npt.NDArray[np.uint8]
    """Shape (H, W, 3), sRGB."""
    depth_mm: npt.NDArray[np.uint16]
    """Along the optical axis, shape (H, W); 0 means no return. [mm, cam]"""
    world_from_body: Pose
    """Pose of the body from which the image was rendered."""
    body_from_cam: Pose
    """Pose of the camera on the body."""
    k: _F64
    """OpenCV's camera matrix, shape (3, 3): the centre of the first pixel is 0. [px]"""
    lens: str
    """'none', 'brown_conrady' (OpenCV's standard model) or 'kannala_brandt' (its fisheye model)."""
    distortion: _F64
    """Coefficients in the order of OpenCV, shape (5,)."""

    @property
    def depth(self) -> npt.NDArray[np.float32]:
        """Depth along the optical axis, shape (H, W); 0 means no return. [m, cam]"""
        return self.depth_mm.astype(np.float32) / np.float32(1000)

    @property
    def world_from_cam(self) -> Pose:
        """Pose of the camera."""
        return self.world_from_body @ self.body_from_cam


class Images(Sequence[LogImage]):
    """The images of one camera, decoded on access."""

    def __init__(self, log: Log, found: list[_Found]):
        self._log, self._found = log, found

    def __len__(self) -> int:
        return len(self._found)

    @overload
    def __getitem__(self, index: int) -> LogImage: ...
    @overload
    def __getitem__(self, index: slice) -> Images: ...
    def __getitem__(self, index: int | slice) -> LogImage | Images:
        if isinstance(index, slice):
            return Images(self._log, self._found[index])
        return self._log._decode(self._found[index])

    def __iter__(self) -> Iterator[LogImage]:
        return (self._log._decode(found) for found in self._found)

    @property
    def shown_ns(self) -> _I64:
        """Instants that the images show, shape (N,). [ns, since 1970]"""
        return np.array([found.shown_ns for found in self._found], np.int64)


class _Found(NamedTuple):
    place: Place
    nth: int
    camera: str
    shown_ns: int


class Log:
    """A flight's log (MCAP), read from `path`.

        log = vizflyt.Log("flight.mcap")
        for image in log.images("front"):
            pose = image.world_from_body                    # the image was rendered from it
            print(image.shown_ns, image.rgb.shape, image.depth.max(), pose.translation_m)
        print(log.imu.accel_mps2.mean(axis=0), log.poses.p_m[-1], log.sent.v_world_mps.max())

    Times are nanoseconds since 1970, on the clock of the vehicle's computer; in graded flights, on their virtual clock.

    Raises OSError if the file cannot be read, ValueError if it is not a log or has an unknown version.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self._file = McapFile(self.path)
        self.flight: dict[str, str] = self._file.metadata.get("vizflyt.flight", {})
        """Description of the flight: program, protocol, plugin, arguments, images."""
        self.is_cut = self._file.is_cut
        """Whether the log ends early, because the flight was killed or the file is damaged."""
        self._colors = {
            topic.removeprefix("/camera/").removesuffix("/image"): {one.log_time_ns: one for one in places}
            for topic, places in self._file.messages.items()
            if topic.startswith("/camera/") and topic.endswith("/image")
        }
        self._found: dict[str, list[_Found]] = {}
        for place in self._file.messages.get("/observation", []):
            try:
                observation = fields(self._file.data(place))
                _check(_first(observation, 2, 0), self.path)
                published = _first(observation, 3, 0)
                for index, data in enumerate(observation.get(5, [])):
                    image = fields(data)
                    camera = _first(image, 2, b"").decode()
                    shown_ns = _first(image, 8, 0)
                    found = _Found(place, index, camera, shown_ns + place.log_time_ns - published)
                    self._found.setdefault(camera, []).append(found)
            except (struct.error, IndexError, UnicodeDecodeError, DamagedMessageError):
                # Skip a damaged message; the others are valid.
                continue

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras with images in the log."""
        return list(self._found)

    def images(self, camera: str | None = None) -> Images:
        """Returns the images of a camera as a sequence, decoded on access. The name is optional if there is only one.

        Raises LookupError if there is no such camera, or no image at all; its message has the next step.
        """
        if not self._found:
            raise LookupError(f"{self.path} contains no image: fly with --log full or --log reduced")
        if camera is None and len(self._found) == 1:
            camera = next(iter(self._found))
        if camera not in self._found:
            raise LookupError(f"there is no camera {camera!r} in {self.path}; it has {', '.join(self._found)}")
        return Images(self, self._found[camera])

    @property
    def poses(self) -> Poses:
        """Poses from localization, in the frame `world`."""
        return self._poses("/pose")

    @property
    def pose_at_image(self) -> Poses:
        """Poses from which the images were rendered, in the frame `world`."""
        return self._poses("/pose_at_image")

    @property
    def odometry(self) -> Poses:
        """Poses that the plugin published with `publish_odometry`, in the plugin's frame `odom`."""
        return self._poses("/odometry", "odom")

    @property
    def motion(self) -> Motion:
        """Velocities, and standard deviations of the poses."""
        stamps, rows = self._json("/motion")
        names = ("v_world_mps", "omega_body_radps", "position_sigma_m", "rotation_sigma_rad")
        return Motion(stamps, *(_vectors(rows, name) for name in names))

    @property
    def imu(self) -> Imu:
        """Accelerometer and gyroscope of the autopilot."""
        stamps, rows = self._json("/imu")
        return Imu(stamps, _vectors(rows, "accel_mps2"), _vectors(rows, "gyro_radps"))

    @property
    def sent(self) -> Sent:
        """Setpoints after the guard, as sent to the autopilot."""
        stamps, rows = self._json("/setpoint/sent")
        yaw, rate = (np.array([_number(row.get(name)) for row in rows]) for name in ("yaw_rad", "yaw_rate_radps"))
        return Sent(stamps, _vectors(rows, "v_world_mps"), yaw, rate)

    @property
    def asked(self) -> list[tuple[int, int, Any]]:
        """Replies of the plugin: time [ns, since 1970], number of the observation, setpoint in the log's JSON form."""
        stamps, rows = self._json("/setpoint/asked")
        return [(int(at_ns), row.get("seq", 0), row.get("setpoint")) for at_ns, row in zip(stamps, rows)]

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(found)} of {camera}" for camera, found in self._found.items())
        return f"Log({str(self.path)!r}, images: {counts or 'none'})"

    def _poses(self, topic: str, frame: Literal["world", "odom"] = "world") -> Poses:
        rows = []
        for place in self._file.messages.get(topic, []):
            try:
                rows.append(_pose_in_frame(self._file.data(place)))
            except (ValueError, struct.error):
                continue
        rows.sort(key=lambda row: row[0])
        numbers = np.array([row[1:] for row in rows], np.float64).reshape(-1, 7)
        return Poses(np.array([row[0] for row in rows], np.int64), numbers[:, :3], numbers[:, 3:], frame)

    def _json(self, topic: str) -> tuple[_I64, list[dict[str, Any]]]:
        stamps, rows = [], []
        for place in sorted(self._file.messages.get(topic, []), key=lambda place: place.log_time_ns):
            try:
                row = json.loads(self._file.data(place))
            except ValueError:
                continue
            if isinstance(row, dict):
                stamps.append(place.log_time_ns)
                rows.append(row)
        return np.array(stamps, np.int64), rows

    def _header(self, found: _Found) -> tuple[tuple[float, ...], dict[int, list[Any]], dict[int, list[Any]]]:
        observation = fields(self._file.data(found.place))
        image = fields(observation[5][found.nth])
        header = _first(image, 3, b"")
        if len(header) < HEADER or header[:4] != b"VZIM":
            raise ValueError(f"{self.path}: the image of observation {_first(observation, 1, 0)} has no header")
        return NUMBERS.unpack_from(header, NUMBERS_AT), image, observation

    def _decode(self, found: _Found) -> LogImage:
        numbers, image, observation = self._header(found)
        header, camera = _first(image, 3, b""), found.camera
        jpeg = None
        if _first(image, 6, 0):
            place = self._colors.get(camera, {}).get(found.place.log_time_ns)
            if place is None:
                raise ValueError(f"{self.path}: the log lacks the colour of an image of {camera}")
            jpeg = _first(fields(self._file.data(place)), 2, b"")
        rgb, depth_mm = decode_image(_first(image, 5, b""), jpeg)
        if rgb.shape[:2] != struct.unpack_from("<II", header, SIZE_AT)[::-1]:
            raise ValueError(f"{self.path}: the size of an image of {camera} differs from its header")
        pose_ns, shown_ns = _first(image, 7, 0), _first(image, 8, 0)
        fx, fy, cx, cy = numbers[14:18]
        return LogImage(
            camera=camera,
            shown_ns=found.shown_ns,
            pose_stamp_ns=found.shown_ns - shown_ns + pose_ns,
            seq=_first(observation, 1, 0),
            rgb=rgb,
            depth_mm=depth_mm,
            world_from_body=_body(numbers),
            body_from_cam=_mount(numbers),
            # In OpenCV, 0 is the centre of the first pixel; in the header, its corner.
            k=np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]], np.float64),
            lens=LENSES.get(header[7], "unknown"),
            distortion=np.array(numbers[18:23], np.float64),
        )


def _first(message: dict[int, list[Any]], number: int, otherwise: Any) -> Any:
    """Returns the first value of a field, or `otherwise`, because protobuf omits fields that are 0 or empty."""
    found = message.get(number, [otherwise])[0]
    return found if isinstance(found, type(otherwise)) else otherwise


def _check(protocol: int, path: Path) -> None:
    if not FIRST_PROTOCOL <= protocol <= PROTOCOL_VERSION:
        raise ValueError(f"{path} is of protocol {protocol}; this version reads {FIRST_PROTOCOL} to {PROTOCOL_VERSION}")


def _pose_in_frame(message: bytes) -> tuple[float, ...]:
    """Returns stamp [ns], x, y, z, qx, qy, qz, qw of a foxglove.PoseInFrame."""
    whole = fields(message)
    stamp, pose = fields(_first(whole, 1, b"")), fields(_first(whole, 3, b""))
    at_ns = _first(stamp, 1, 0) * 1_000_000_000 + _first(stamp, 2, 0)
    place, turn = fields(_first(pose, 1, b"")), fields(_first(pose, 2, b""))
    zero = bytes(8)
    numbers = [_first(place, n, zero) for n in (1, 2, 3)] + [_first(turn, n, zero) for n in (1, 2, 3, 4)]
    return (at_ns, *struct.unpack("<7d", b"".join(numbers)))


def _mount(numbers: tuple[float, ...]) -> Pose:
    return Pose("body", "cam", numbers[7:10], _unit(np.array(numbers[10:14])))


def _body(numbers: tuple[float, ...]) -> Pose:
    world_from_cam = Pose("world", "cam", numbers[:3], _unit(np.array(numbers[3:7])))
    return world_from_cam @ _mount(numbers).inverse()


def _unit(quaternion: _F64) -> _F64:
    return quaternion / np.linalg.norm(quaternion)


def _slerp(a: _F64, b: _F64, share: float) -> _F64:
    a, b = _unit(a), _unit(b)
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-8:
        return _unit((1 - share) * a + share * b)
    return _unit((np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle))


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else float("nan")


def _vectors(rows: list[dict[str, Any]], name: str) -> _F64:
    vectors = [row.get(name) for row in rows]
    good = [v if isinstance(v, list) and len(v) == 3 else [float("nan")] * 3 for v in vectors]
    return np.array([[_number(one) for one in v] for v in good], np.float64).reshape(-1, 3)
