"""Common parts of both visual odometry plugins: start, paths of the projects, flight along them, and data sets instead
of a flight.

::

    flight:   vizflyt.Observation -> View, Imu -> Odometry.update -> publish_odometry
                                                  Odometry.now    -> Follower -> Setpoint.velocity
    data set: vizflyt export FLIGHT.mcap --format euroc -o DIR;  rgbd_odometry.py --dataset DIR -o estimate.tum

The origin of the frame `odom` is the vehicle's position before take-off, with x along the nose and z up. The plugin
steers only by its own estimate, because courses with a path withhold the pose.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

import vizflyt
from vizflyt import Setpoint

F64 = npt.NDArray[np.float64]

# Speed along the path. [m/s]
SPEED_MPS = 0.8
# Acceleration, and deceleration before corners and the end. [m/s^2]
RAMP_MPS2 = 0.8
# Gain of the velocity towards the path. [1/s]
TOWARDS_PER_S = 1.2
# Delay until a setpoint is flown. [s]
LAG_S = 0.3
# The path's reference waits if the vehicle is further away. [m]
WAIT_M = 0.4
# Straight extension at the path's end, so that the last gate is passed. [m]
BEYOND_M = 0.3
# Timeout for the finish after the end of the path; then the vehicle lands. [s]
PATIENCE_S = 5.0
# Corners sharper than this are flown slowly. [rad]
CORNER_RAD = 0.5
CORNER_MPS = 0.25


class Imu(NamedTuple):
    """One sample of accelerometer and gyroscope."""

    at_s: float
    accel_mps2: F64
    """Specific force, shape (3,). [m/s^2, body]"""
    gyro_radps: F64
    """Shape (3,). [rad/s, body]"""


class View(NamedTuple):
    """Image of one camera, and the pose of the camera on the body."""

    camera: str
    at_ns: int
    """Instant that the image shows. [ns]"""
    grey: npt.NDArray[np.uint8]
    """Shape (H, W), with normalized contrast."""
    depth_m: npt.NDArray[np.float32] | None
    """Along the optical axis, shape (H, W); 0 means no return. [m, cam]"""
    focal_px: F64
    """Focal lengths along x and y. [px]"""
    center_px: F64
    """Principal point in OpenCV's convention: the centre of the first pixel is 0. [px]"""
    body_from_cam: F64
    """Rotation, shape (3, 3)."""
    camera_m: F64
    """Position of the camera. [m, body]"""

    def project(self, p_cam_m: F64) -> F64:
        """Returns the pixels (N, 2) of points (N, 3) in front of the camera. [px]"""
        return p_cam_m[:, :2] / p_cam_m[:, 2:] * self.focal_px + self.center_px

    def slopes(self, px: F64) -> F64:
        """Returns x/z and y/z (N, 2) of the rays through pixels (N, 2)."""
        return (px - self.center_px) / self.focal_px


class Estimate(NamedTuple):
    """Pose and velocity of the body in the frame `odom`."""

    at_ns: int
    p_m: F64
    rotation: F64
    """From body to odom axes, shape (3, 3)."""
    v_mps: F64


# --- small rotations


def skew(v: F64) -> F64:
    """Returns the matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def exp_so3(turn_rad: F64) -> F64:
    """Returns the rotation (3, 3) by a vector (Rodrigues' formula). [rad]"""
    angle = math.sqrt(float(turn_rad @ turn_rad))
    cross = skew(turn_rad)
    if angle < 1e-8:
        return np.eye(3) + cross
    return np.eye(3) + math.sin(angle) / angle * cross + (1 - math.cos(angle)) / angle**2 * cross @ cross


def quaternion_xyzw(rotation: F64) -> F64:
    """Returns the unit quaternion of a rotation matrix, from its largest element (S. Shepperd, J. Guidance and Control
    1(3), 1978)."""
    trace = float(np.trace(rotation))
    squares = np.array([*(1 - trace + 2 * np.diag(rotation)), 1 + trace]) / 4
    at = int(squares.argmax())
    q = np.empty(4)
    q[at] = math.sqrt(squares[at])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        if at == 3:
            q[i] = (rotation[k, j] - rotation[j, k]) / (4 * q[3])
        elif i == at:
            q[3] = (rotation[k, j] - rotation[j, k]) / (4 * q[at])
            q[j] = (rotation[i, j] + rotation[j, i]) / (4 * q[at])
            q[k] = (rotation[i, k] + rotation[k, i]) / (4 * q[at])
    return q / np.linalg.norm(q)


def level_from_body(accel_mps2: F64) -> F64:
    """Returns the rotation that levels a body at rest: the mean specific force points up, the nose along x."""
    up = accel_mps2 / np.linalg.norm(accel_mps2)
    left = np.cross(up, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, up), left, up])


# --- from images and samples to estimates

# The vehicle has lifted off when the mean of 0.1 s differs by this much. [m/s^2], [rad/s]
LIFT_MPS2, LIFT_RADPS = 0.4, 0.15
LIFT_READINGS, FEWEST_STANDING, MOST_STANDING = 10, 30, 1000
# Odometry begins at this time before the lift-off was detected. [s]
BEFORE_LIFT_S = 0.3


class Standing(NamedTuple):
    """Mean IMU samples on the ground."""

    until_s: float
    accel_mps2: F64
    """Mean specific force, shape (3,). [m/s^2, body]"""
    gyro_bias: F64
    """Mean of the gyroscope at rest, which is its bias, shape (3,). [rad/s, body]"""


def stood(readings: Sequence[Imu]) -> Standing | None:
    """Returns the means at rest before lift-off; None if the vehicle has not lifted off."""
    standing = len(readings) - LIFT_READINGS
    if standing < FEWEST_STANDING:
        return None
    accel = np.array([one.accel_mps2 for one in readings])
    gyro = np.array([one.gyro_radps for one in readings])
    force = np.abs(accel[standing:].mean(axis=0) - accel[:standing].mean(axis=0)).max()
    turn = np.abs(gyro[standing:].mean(axis=0) - gyro[:standing].mean(axis=0)).max()
    if force < LIFT_MPS2 and turn < LIFT_RADPS:
        return None
    count = sum(one.at_s < readings[-1].at_s - BEFORE_LIFT_S for one in readings)
    return Standing(readings[count - 1].at_s, accel[:count].mean(axis=0), gyro[:count].mean(axis=0))


class Odometry:
    """Base class of odometries: IMU samples and images in, estimates out, from lift-off on.

    The vehicle must be at rest at the beginning, so that the accelerometer measures gravity and the gyroscope's mean
    is its bias. Subclasses define `begin`, `see` and `now`.
    """

    def __init__(self) -> None:
        self.readings: list[Imu] = []
        """Samples from the last one before the newest estimate."""
        self._pending: list[View] = []
        self._began = False

    def update(self, imu: Sequence[Imu], views: Sequence[View]) -> list[Estimate]:
        """Adds new samples and images, sorted by time. Returns estimates of all images that the samples cover."""
        self.readings += imu
        self._pending += views
        if not self._began:
            standing = stood(self.readings)
            if standing is None:
                self.readings = self.readings[-MOST_STANDING:]
                self._pending = [view for view in self._pending if view.at_ns > views[-1].at_ns - 1e9] if views else []
                return []
            self.begin(standing)
            self._began = True
            self.readings = [one for one in self.readings if one.at_s >= standing.until_s]
            self._pending = [view for view in self._pending if view.at_ns * 1e-9 > standing.until_s]
        estimates = []
        while self._pending and self.readings[-1].at_s >= self._pending[0].at_ns * 1e-9:
            at_ns = self._pending[0].at_ns
            together = [view for view in self._pending if view.at_ns == at_ns]
            self._pending = self._pending[len(together) :]
            estimates.append(self.see(at_ns, together))
        return estimates

    def begin(self, standing: Standing) -> None:
        """Starts with the means at rest."""
        raise NotImplementedError

    def see(self, at_ns: int, views: list[View]) -> Estimate:
        """Returns the estimate at an instant, from its images and the samples until then."""
        raise NotImplementedError

    def now(self) -> Estimate | None:
        """Returns the estimate at the newest sample, for steering; None before lift-off."""
        raise NotImplementedError

    def between(self, from_s: float, to_s: float) -> Iterator[tuple[float, F64, F64]]:
        """Yields steps from one instant to another that the samples cover: duration [s], and interpolated accelerometer
        and gyroscope in the middle of the step. Removes earlier samples."""
        while from_s < to_s - 1e-9:
            # The samples before and after the current instant.
            while len(self.readings) > 2 and self.readings[1].at_s <= from_s + 1e-9:
                self.readings.pop(0)
            before, after = self.readings[:2]
            until_s = min(after.at_s, to_s)
            share = ((from_s + until_s) / 2 - before.at_s) / (after.at_s - before.at_s)
            yield (
                until_s - from_s,
                before.accel_mps2 + share * (after.accel_mps2 - before.accel_mps2),
                before.gyro_radps + share * (after.gyro_radps - before.gyro_radps),
            )
            from_s = until_s


# --- features


class Tracks:
    """Corners of one camera's images, tracked from a key image to each later image.

    Corners by J. Shi and C. Tomasi, "Good features to track" (CVPR 1994). Tracking by B. Lucas and T. Kanade's method
    ("An iterative image registration technique", IJCAI 1981) in pyramids, forwards and backwards; a corner that does
    not return to its start is dropped. Tracking from image to image would accumulate small errors. Therefore each image
    is compared with the key image, until too few of its corners are left.
    """

    def __init__(self, most: int = 120, apart_px: int = 14, renewed: float = 0.75):
        self.ids = np.empty(0, np.int64)
        self.px = np.empty((0, 2))
        self._grey: npt.NDArray[np.uint8] | None = None
        self._key: npt.NDArray[np.uint8] | None = None
        self._key_px = np.empty((0, 2))
        self._most, self._apart_px, self._renewed = most, apart_px, renewed
        self._fewest, self._next = 0.0, 0

    def follow(self, grey: npt.NDArray[np.uint8], guess_px: F64 | None = None) -> None:
        """Tracks the corners to the next image. `guess_px` (N, 2) are their predicted positions. [px]"""
        self._grey = grey
        if self._key is None or not len(self.ids):
            return
        flow = dict(
            winSize=(15, 15),
            maxLevel=2,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        old = self._key_px.astype(np.float32)
        new = (self.px if guess_px is None else guess_px).astype(np.float32)
        new, found, _ = cv2.calcOpticalFlowPyrLK(self._key, grey, old, new.copy(), **flow)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(grey, self._key, new, old.copy(), **flow)
        height, width = grey.shape
        inside = (new > 4).all(axis=1) & (new[:, 0] < width - 5) & (new[:, 1] < height - 5)
        same = np.linalg.norm(back - old, axis=1) < 0.5
        self.px = new.astype(np.float64)
        self.keep((found.ravel() == 1) & (found_back.ravel() == 1) & inside & same)

    def keep(self, which: npt.NDArray[np.bool_]) -> None:
        """Keeps only these corners."""
        self.ids, self.px, self._key_px = self.ids[which], self.px[which], self._key_px[which]

    def add(self) -> int:
        """If too few corners are left, makes the current image the key image and detects new corners in empty areas.
        Returns the number of new corners, which are at the end."""
        if self._grey is None or len(self.ids) > self._fewest:
            return 0
        mask = np.full(self._grey.shape, 255, np.uint8)
        for x, y in self.px:
            cv2.circle(mask, (round(x), round(y)), self._apart_px, 0, -1)
        edge = 8
        mask[:edge], mask[-edge:], mask[:, :edge], mask[:, -edge:] = 0, 0, 0, 0
        wanted = max(self._most - len(self.ids), 1)
        corners = cv2.goodFeaturesToTrack(self._grey, wanted, 0.01, self._apart_px, mask=mask, blockSize=5)
        fresh = np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        self.ids = np.concatenate([self.ids, np.arange(self._next, self._next + len(fresh))])
        self._next += len(fresh)
        self.px = np.concatenate([self.px, fresh])
        self._key, self._key_px = self._grey, self.px
        self._fewest = self._renewed * len(self.ids)
        return len(fresh)


# Details finer than two pixels have position errors: rendered images alias, like images of sensors without an optical
# low-pass filter. Without this blur, the estimate of a flight of 10 m was 1 to 4 % too long. [px]
BLUR_PX = 1.5


# Target standard deviation of brightness, and lower limit of the measured one. [levels]
SPREAD, LEAST_SPREAD = 50.0, 4.0


def even_grey(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Returns brightness without the finest details and with more contrast, because fog and dusk reduce it.

    Uses one gain for the complete image. A local gain, as in adaptive equalization (CLAHE), is a pattern that stays in
    the image while the world moves: it doubled the tracking error.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), BLUR_PX)
    mean, spread = cv2.meanStdDev(grey)
    gain = SPREAD / max(float(spread[0, 0]), LEAST_SPREAD)
    return cv2.addWeighted(grey, gain, grey, 0.0, 128 - gain * float(mean[0, 0]))


# --- paths


def path_m(name: str) -> F64:
    """Returns the path of a project, shape (N, 3), about every 2 cm, from take-off at its height. [m, odom]

    Raises ValueError for a project without a path.
    """
    s = np.linspace(0, 1, 801)
    if name == "square":
        corners = np.array([(0, 0), (0, -1.4), (2.8, -1.4), (2.8, 1.4), (0, 1.4), (0, 0)], np.float64)
        sides = [np.linspace(a, b, 101)[:-1] for a, b in itertools.pairwise(corners)]
        flat = np.concatenate([*sides, corners[-1:]])
        points = np.column_stack([flat, np.zeros(len(flat))])
    elif name == "spiral":
        r, a = 1.5 - 0.9 * s, 4 * np.pi * s
        points = np.column_stack([1.5 - r * np.cos(a), -r * np.sin(a), 0.8 * s])
    elif name == "lemniscate":
        a = 2 * np.pi * s
        size = 2.5 / (1 + np.sin(a) ** 2)
        points = np.column_stack([2.5 - size * np.cos(a), size * np.sin(a) * np.cos(a), np.zeros_like(a)])
    else:
        raise ValueError(f"the project '{name}' has no path to fly; fly --project square, spiral or lemniscate")
    end = points[-1] - points[-2]
    return np.concatenate([points, [points[-1] + end / np.linalg.norm(end) * BEYOND_M]])


class Follower:
    """Flies along a path: a reference point moves along the path, and waits if the vehicle cannot follow."""

    def __init__(self, points_m: F64):
        self._points_m = points_m
        sides = np.diff(points_m, axis=0)
        lengths = np.linalg.norm(sides, axis=1)
        self._along_m = np.concatenate([[0.0], np.cumsum(lengths)])
        heads = sides / lengths[:, None]
        turns = np.arccos(np.clip((heads[1:] * heads[:-1]).sum(axis=1), -1, 1))
        self._slow_m = np.concatenate([self._along_m[1:-1][turns > CORNER_RAD], self._along_m[-1:]])
        self._at_m, self._speed_mps = 0.0, 0.0

    @property
    def is_over(self) -> bool:
        """Whether the reference point is at the path's end."""
        return self._at_m >= self._along_m[-1]

    def velocity(self, p_m: F64, dt_s: float) -> F64:
        """Returns the velocity (3,) for a position, `dt_s` after the last call. [m/s, odom]"""
        reference_m = self._reference(self._at_m)
        if np.linalg.norm(reference_m - p_m) < WAIT_M:
            ahead_m = self._slow_m[self._slow_m > self._at_m] - self._at_m
            corner_mps = 0.0 if len(ahead_m) < 2 else CORNER_MPS
            brake_mps = math.sqrt(corner_mps**2 + 2 * RAMP_MPS2 * ahead_m[0]) if len(ahead_m) else 0.0
            self._speed_mps = min(self._speed_mps + RAMP_MPS2 * dt_s, SPEED_MPS, max(brake_mps, 0.05))
            self._at_m = min(self._at_m + self._speed_mps * dt_s, self._along_m[-1])
        else:
            self._speed_mps = max(self._speed_mps - RAMP_MPS2 * dt_s, 0.0)
        next_m = self._reference(self._at_m)
        # The setpoint is flown after a delay, so use the direction further along the path.
        later_m = self._at_m + self._speed_mps * LAG_S
        before_m, after_m = self._reference(later_m - 0.02), self._reference(later_m + 0.02)
        ahead = (after_m - before_m) / max(float(np.linalg.norm(after_m - before_m)), 1e-9)
        return ahead * (0.0 if self.is_over else self._speed_mps) + TOWARDS_PER_S * (next_m - p_m)

    def _reference(self, along_m: float) -> F64:
        return np.array([np.interp(along_m, self._along_m, self._points_m[:, axis]) for axis in range(3)])


# --- flight


class OdometryPlugin(vizflyt.Plugin):
    """Flies the project's path with an estimator, and publishes its estimate of each image."""

    make_estimator: Callable[[], Odometry]
    needs_depth = False

    def on_start(self, info: vizflyt.ArenaInfo) -> None:
        self.estimator = self.make_estimator()
        self.follower = Follower(path_m(info.name) + np.array([0.0, 0.0, info.takeoff_height_m]))
        self.shown_ns: dict[str, int] = {}
        self.flying = self.finished = False
        self.last_ns = self.over_ns = 0

    def on_event(self, event: vizflyt.Event) -> None:
        self.flying |= event.details.get("phase") == "flying"
        self.finished |= event.kind == "finished"

    def on_image(self, obs: vizflyt.Observation) -> Setpoint | None:
        views = []
        for image in obs.cameras:
            if self.shown_ns.get(image.name, -1) < image.shown_ns:
                self.shown_ns[image.name] = image.shown_ns
                views.append(view_of(image, self.needs_depth))
        views.sort(key=lambda view: view.at_ns)
        imu = [Imu(one.stamp_ns * 1e-9, one.accel_mps2, one.gyro_radps) for one in obs.imu]
        for estimate in self.estimator.update(imu, views)[-4:]:
            vizflyt.publish_odometry(estimate.at_ns, estimate.p_m, quaternion_xyzw(estimate.rotation))
        return self.steer(obs.stamp_ns)

    def steer(self, at_ns: int) -> Setpoint:
        """Returns the setpoint along the path, from the estimate."""
        now = self.estimator.now()
        dt_s = min(max(at_ns - self.last_ns, 0) * 1e-9, 0.1)
        self.last_ns = at_ns
        if not self.flying or self.finished or now is None:
            return Setpoint.hold()
        if self.follower.is_over:
            self.over_ns = self.over_ns or at_ns
            if at_ns - self.over_ns > PATIENCE_S * 1e9:
                print("end of the path without a finish: landing")
                return Setpoint.land()
        v_odom_mps = self.follower.velocity(now.p_m, dt_s)
        # Rotate to the axes of the estimated heading.
        x, y = now.rotation[0, 0], now.rotation[1, 0]
        length = math.hypot(x, y)
        ahead, left = np.array([x, y]) / length, np.array([-y, x]) / length
        return Setpoint.velocity([ahead @ v_odom_mps[:2], left @ v_odom_mps[:2], v_odom_mps[2]], axes="heading")


def view_of(image: vizflyt.CameraImage, with_depth: bool) -> View:
    """Converts an image of a flight to the estimator's input."""
    k, mount = image.intrinsics.opencv_matrix, image.body_from_cam
    return View(
        image.name,
        image.shown_ns,
        even_grey(image.rgb),
        image.depth if with_depth else None,
        np.array([k[0, 0], k[1, 1]]),
        np.array([k[0, 2], k[1, 2]]),
        mount.rotation_matrix,
        mount.translation_m,
    )


# --- data set


def data_set(folder: Path, with_depth: bool) -> Iterator[tuple[list[Imu], list[View]]]:
    """Reads a folder written by `vizflyt export --format euroc`. Yields for each image instant the IMU samples until
    then and the images.

    Raises ValueError if the folder is incomplete.
    """
    readings = folder / "mav0/imu0/data.csv"
    if not readings.exists() or not (folder / "images.csv").exists():
        raise ValueError(f"{folder} lacks images.csv or mav0/imu0; write it with vizflyt export --format euroc")
    numbers = np.loadtxt(readings, delimiter=",", skiprows=1, ndmin=2)
    stamps = np.loadtxt(readings, delimiter=",", skiprows=1, usecols=0, dtype=np.int64, ndmin=1)
    order = np.argsort(stamps, kind="stable")
    stamps, numbers = stamps[order], numbers[order]
    with (folder / "images.csv").open(newline="") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: int(row["timestamp_ns"]))
    if with_depth and not any(row["depth_file"] for row in rows):
        raise ValueError(f"{folder} has no depth: fly --level ug")
    at = 0
    for instant, together in itertools.groupby(rows, key=lambda row: int(row["timestamp_ns"])):
        until = int(np.searchsorted(stamps, instant, side="right"))
        imu = [Imu(int(stamps[n]) * 1e-9, numbers[n, 4:7], numbers[n, 1:4]) for n in range(at, until)]
        at = until
        yield imu, [_view_of_row(folder, row, with_depth) for row in together]


def _view_of_row(folder: Path, row: dict[str, str], with_depth: bool) -> View:
    def number(*names: str) -> F64:
        return np.array([float(row[name]) for name in names])

    rgb = cv2.cvtColor(cv2.imread(str(folder / row["file"])), cv2.COLOR_BGR2RGB)
    depth_m = None
    if with_depth:
        depth_mm = cv2.imread(str(folder / row["depth_file"]), cv2.IMREAD_UNCHANGED)
        depth_m = depth_mm.astype(np.float32) / np.float32(1000)
    mount = [f"body_from_cam_{axis}" for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    pose = vizflyt.Pose("body", "cam", number(*mount[:3]), number(*mount[3:]))
    return View(
        row["camera"],
        int(row["timestamp_ns"]),
        even_grey(rgb),
        depth_m,
        number("fx_px", "fy_px"),
        number("cx_px", "cy_px"),
        pose.rotation_matrix,
        pose.translation_m,
    )


def main(plugin: type[OdometryPlugin]) -> None:
    """Flies the plugin, or runs its estimator over a data set: `--dataset DIR -o estimate.tum`."""
    parser = argparse.ArgumentParser(description=(plugin.__doc__ or "").splitlines()[0])
    parser.add_argument("--dataset", type=Path, help="folder of vizflyt export --format euroc (default: fly)")
    parser.add_argument("-o", "--output", type=Path, default=Path("estimate.tum"), help="output file (TUM poses)")
    arguments, _ = parser.parse_known_args()
    if arguments.dataset is None:
        vizflyt.run(plugin)
        return
    estimator = plugin.make_estimator()
    lines = []
    for imu, views in data_set(arguments.dataset, plugin.needs_depth):
        for estimate in estimator.update(imu, views):
            numbers = [*estimate.p_m, *quaternion_xyzw(estimate.rotation)]
            seconds, rest = divmod(estimate.at_ns, 1_000_000_000)
            lines.append(f"{seconds}.{rest:09d} " + " ".join(f"{number:.9f}" for number in numbers) + "\n")
    arguments.output.write_text("".join(lines))
    print(f"{arguments.output}: {len(lines)} poses")
