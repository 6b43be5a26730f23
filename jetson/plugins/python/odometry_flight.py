"""What both visual odometries share: their start, the paths of their projects, flight along them, a data set in a
flight's place.

::

    flight:   vizflyt.Observation -> View, Imu -> Odometry.update -> publish_odometry
                                                  Odometry.now    -> Follower -> Setpoint.velocity
    data set: vizflyt export FLIGHT.mcap --format euroc -o DIR;  rgbd_odometry.py --dataset DIR -o estimate.tum

The frame `odom` begins where the vehicle stands before take-off, with its nose along x and z up. What steers the
vehicle is its own estimate alone: courses with a path withhold the pose.
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

# Of the vehicle along its path. [m/s]
SPEED_MPS = 0.8
# How fast that is reached, and left before corners and the end. [m/s^2]
RAMP_MPS2 = 0.8
# Velocity towards the path per distance from it. [1/s]
TOWARDS_PER_S = 1.2
# What is asked for is flown so much later. [s]
LAG_S = 0.3
# The path's reference waits for a vehicle that is farther from it. [m]
WAIT_M = 0.4
# Beyond its end the path goes straight on, so that the last gate is passed. [m]
BEYOND_M = 0.3
# If the finish does not come within this time at the end, the vehicle lands. [s]
PATIENCE_S = 5.0
# A corner sharper than this is taken slowly. [rad]
CORNER_RAD = 0.5
CORNER_MPS = 0.25


class Imu(NamedTuple):
    """One reading of accelerometer and gyroscope."""

    at_s: float
    accel_mps2: F64
    """Specific force, shape (3,). [m/s^2, body]"""
    gyro_radps: F64
    """Shape (3,). [rad/s, body]"""


class View(NamedTuple):
    """One camera's image, and how the camera is mounted."""

    camera: str
    at_ns: int
    """The instant that it shows. [ns]"""
    grey: npt.NDArray[np.uint8]
    """Shape (H, W), its contrast evened out."""
    depth_m: npt.NDArray[np.float32] | None
    """Along the optical axis, shape (H, W); 0 is no return. [m, cam]"""
    focal_px: F64
    """Focal lengths along x and y. [px]"""
    center_px: F64
    """Principal point, as OpenCV counts: the centre of the first pixel is 0. [px]"""
    body_from_cam: F64
    """Rotation, shape (3, 3)."""
    camera_m: F64
    """Where the camera sits. [m, body]"""

    def project(self, p_cam_m: F64) -> F64:
        """Returns the pixels (N, 2) of points (N, 3) before the camera. [px]"""
        return p_cam_m[:, :2] / p_cam_m[:, 2:] * self.focal_px + self.center_px

    def slopes(self, px: F64) -> F64:
        """Returns x/z and y/z (N, 2) of the rays through pixels (N, 2)."""
        return (px - self.center_px) / self.focal_px


class Estimate(NamedTuple):
    """Where the body is in the frame `odom`."""

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
    """Returns the unit quaternion of a rotation matrix, by its greatest element (S. Shepperd, J. Guidance and Control
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


# --- from images and readings to estimates

# It has left the ground when a tenth of a second's mean force or turn differs by so much. [m/s^2], [rad/s]
LIFT_MPS2, LIFT_RADPS = 0.4, 0.15
LIFT_READINGS, FEWEST_STANDING, MOST_STANDING = 10, 30, 1000
# An odometry begins so long before that was noticed. [s]
BEFORE_LIFT_S = 0.3


class Standing(NamedTuple):
    """What the IMU's readings are on the ground."""

    until_s: float
    accel_mps2: F64
    """Mean specific force, shape (3,). [m/s^2, body]"""
    gyro_bias: F64
    """Mean of the gyroscope, which is what it is off by, shape (3,). [rad/s, body]"""


def stood(readings: Sequence[Imu]) -> Standing | None:
    """Returns how it stood before it left the ground; None while it stands."""
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
    """What odometries have in common: readings and images in, estimates out, from when the vehicle leaves the ground.

    It must stand when it begins: there gravity is what the accelerometer feels, and the gyroscope's mean is its bias.
    Each odometry has `begin`, `see` and `now`.
    """

    def __init__(self) -> None:
        self.readings: list[Imu] = []
        """From the last one before the newest estimate on."""
        self._pending: list[View] = []
        self._began = False

    def update(self, imu: Sequence[Imu], views: Sequence[View]) -> list[Estimate]:
        """Takes what is new, each sorted by time; returns those of images up to which there are readings."""
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
        """Takes how it stood on the ground."""
        raise NotImplementedError

    def see(self, at_ns: int, views: list[View]) -> Estimate:
        """Returns the estimate of an instant, from its images and the readings until then."""
        raise NotImplementedError

    def now(self) -> Estimate | None:
        """Returns the estimate at the newest reading, for steering; None while it stands."""
        raise NotImplementedError

    def between(self, from_s: float, to_s: float) -> Iterator[tuple[float, F64, F64]]:
        """Yields in steps from an instant to one up to which there are readings: how long the step is [s], and
        accelerometer and gyroscope in its middle, between two readings. Forgets the readings before."""
        while from_s < to_s - 1e-9:
            # The readings before and after where it is.
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
    """Corners of one camera's images, followed from a key image to each later one.

    Corners by J. Shi and C. Tomasi, "Good features to track" (CVPR 1994); followed by B. Lucas and T. Kanade's method
    ("An iterative image registration technique", IJCAI 1981) in pyramids, there and back: what does not come back to
    where it was is dropped. From image to image small errors would add up, so it is the key image that each is compared
    with, until too few corners are left of it.
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
        """Finds the corners in the next image; `guess_px` (N, 2) is where they are likely to be. [px]"""
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
        """Drops all corners but these."""
        self.ids, self.px, self._key_px = self.ids[which], self.px[which], self._key_px[which]

    def add(self) -> int:
        """Where too few are left, makes the present image the key image and looks for new corners where there are none;
        returns how many were added, at the end."""
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


# What is finer than two pixels is not where it seems to be: rendered images alias, as those of sensors without an
# optical low-pass do. Without the blur a flight of 10 m ahead was 1 to 4 % too long. [px]
BLUR_PX = 1.5


# Brightness is spread so that its standard deviation is this; one that is less than so many levels is spread less.
SPREAD, LEAST_SPREAD = 50.0, 4.0


def even_grey(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Returns brightness without its finest details, and with its contrast spread: fog and dusk leave little of it.

    By one gain for the whole image. One that differs from place to place, as that of an adaptive equalization (CLAHE)
    does, is a pattern that stays in the image while the world moves: corners were followed twice as badly by it.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), BLUR_PX)
    mean, spread = cv2.meanStdDev(grey)
    gain = SPREAD / max(float(spread[0, 0]), LEAST_SPREAD)
    return cv2.addWeighted(grey, gain, grey, 0.0, 128 - gain * float(mean[0, 0]))


# --- paths


def path_m(name: str) -> F64:
    """Returns the path of a project, shape (N, 3), every 2 cm or so, from take-off at its height. [m, odom]

    Raises ValueError for a project that has none.
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
    """Flies along a path: a reference goes ahead on it, and waits where the vehicle cannot follow."""

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
        """Whether the reference is at the path's end."""
        return self._at_m >= self._along_m[-1]

    def velocity(self, p_m: F64, dt_s: float) -> F64:
        """Returns the velocity (3,) to fly with from a place, `dt_s` after the last call. [m/s, odom]"""
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
        # The velocity that is asked for now is flown a little later: farther along the path.
        later_m = self._at_m + self._speed_mps * LAG_S
        before_m, after_m = self._reference(later_m - 0.02), self._reference(later_m + 0.02)
        ahead = (after_m - before_m) / max(float(np.linalg.norm(after_m - before_m)), 1e-9)
        return ahead * (0.0 if self.is_over else self._speed_mps) + TOWARDS_PER_S * (next_m - p_m)

    def _reference(self, along_m: float) -> F64:
        return np.array([np.interp(along_m, self._along_m, self._points_m[:, axis]) for axis in range(3)])


# --- flight


class OdometryPlugin(vizflyt.Plugin):
    """Flies the project's path by an estimator of its own, and publishes what that says of each image."""

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
        """Returns the setpoint: along the path by the estimate."""
        now = self.estimator.now()
        dt_s = min(max(at_ns - self.last_ns, 0) * 1e-9, 0.1)
        self.last_ns = at_ns
        if not self.flying or self.finished or now is None:
            return Setpoint.hold()
        if self.follower.is_over:
            self.over_ns = self.over_ns or at_ns
            if at_ns - self.over_ns > PATIENCE_S * 1e9:
                print("the end of the path is here, and no finish: landing")
                return Setpoint.land()
        v_odom_mps = self.follower.velocity(now.p_m, dt_s)
        # Into the axes of the heading, as the estimate has it.
        x, y = now.rotation[0, 0], now.rotation[1, 0]
        length = math.hypot(x, y)
        ahead, left = np.array([x, y]) / length, np.array([-y, x]) / length
        return Setpoint.velocity([ahead @ v_odom_mps[:2], left @ v_odom_mps[:2], v_odom_mps[2]], axes="heading")


def view_of(image: vizflyt.CameraImage, with_depth: bool) -> View:
    """Returns a flight's image as estimators take it."""
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
    """Reads a folder that `vizflyt export --format euroc` wrote: yields, image instant by image instant, the IMU's
    readings until then and the images.

    Raises ValueError if the folder lacks what is needed.
    """
    readings = folder / "mav0/imu0/data.csv"
    if not readings.exists() or not (folder / "images.csv").exists():
        raise ValueError(f"{folder} lacks images.csv or mav0/imu0; write it by vizflyt export --format euroc")
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
    parser.add_argument("--dataset", type=Path, help="a folder by vizflyt export --format euroc; without it, fly")
    parser.add_argument("-o", "--output", type=Path, default=Path("estimate.tum"), help="where the poses go (TUM)")
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
