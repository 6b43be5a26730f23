#!/usr/bin/env python3
"""Flies square, spiral or lemniscate with visual-inertial odometry: colour images and the IMU, no depth.

A multi-state constraint Kalman filter (A. Mourikis and S. Roumeliotis, "A multi-state constraint Kalman filter for
vision-aided inertial navigation", ICRA 2007). Its state is the body's motion, the IMU's biases, and the body's poses at
the last key images. The IMU propagates the state between images, and gives scale and the direction of gravity. A corner
seen in several key images constrains their relative poses: its position is eliminated (Schur complement), so it needs
no space in the state. Corners that are tracked for longer get a position in the state (M. Li and A. Mourikis,
"Optimization-based estimator design for vision-aided inertial navigation", RSS 2012). They keep the scale after the
images that measured it have left the state. The scale is known from the start, because the vehicle is at rest before
take-off: its velocity is 0, the accelerometer measures gravity, and the gyroscope's mean is its bias.

::

    IMU -> propagate -> clone at key images -> corners that end or grow old -> triangulate -> update
                                            -> corners with a place ------------------------> update

Fly:       vizflyt demo --project spiral --level g --plugin jetson/plugins/python/inertial_odometry.py
Data set:  inertial_odometry.py --dataset DIR -o estimate.tum
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from odometry_flight import (
    F64,
    Estimate,
    Odometry,
    OdometryPlugin,
    Standing,
    Tracks,
    View,
    exp_so3,
    level_from_body,
    main,
    skew,
)

GRAVITY_MPS2 = np.array([0.0, 0.0, -9.80665])
# White noise and random walk of the IMU: an ICM-42688 class sensor on a small frame. The noise of a sample is 0.2 m/s^2
# and 0.01 rad/s at 100 Hz; divided by the root of 100 Hz.
# [m/s^2/sqrt(Hz)], [rad/s/sqrt(Hz)], [m/s^3/sqrt(Hz)], [rad/s^2/sqrt(Hz)]
ACCEL_NOISE, GYRO_NOISE, ACCEL_WALK, GYRO_WALK = 0.02, 0.001, 1e-3, 1e-4
# Initial standard deviations: tilt [rad], velocity [m/s], biases [rad/s], [m/s^2]; and of the mean specific force.
# [m/s^2]
TILT_SIGMA, V_SIGMA, GYRO_SIGMA, ACCEL_SIGMA, STANDING_SIGMA = 0.05, 0.003, 0.001, 0.05, 0.01
# Heading and position are zero in the frame's definition.
OWN_SIGMA = 1e-4
# Interval between key images, and number of key images in the state. [s]
KEY_S, KEYS = 0.09, 20
# Standard deviation between the predicted pose, from which an image is rendered, and the true pose. [rad], [m]
PREDICTED_RAD, PREDICTED_M = 0.0015, 0.001
# Number of corners per camera, and minimum distance between them. [px]
CORNERS, APART_PX = 220, 10
# Standard deviation of a tracked corner. [px]
SIGMA_PX = 0.5
# Number of corners with a position in the state, and standard deviation of such a corner, which drifts while it is
# tracked. [px]
PLACES, PLACE_SIGMA_PX = 50, 1.5
# Residuals beyond HUBER sigmas get a lower weight, beyond DROPPED none; beyond LOST, a position leaves the state.
HUBER, DROPPED, LOST = 1.5, 6.0, 4.0
# Minimum number of key images of a corner, and range of accepted positions. [m, cam]
FEWEST_SEEN, NEAREST_M, FARTHEST_M = 4, 0.1, 40.0
TRIANGULATIONS = 5

# The error state begins with rotation of the body [rad, body], velocity, position, biases of gyroscope and
# accelerometer. Then follow the positions of corners, and rotation and position of each clone.
TURN, V, P, GYRO, ACCEL = (slice(n, n + 3) for n in (0, 3, 6, 9, 12))
IMU_SIZE, PLACE_SIZE, CLONE_SIZE = 15, 3, 6


class Motion(NamedTuple):
    """Motion of the body at an instant, in the frame `odom`, and biases of the IMU."""

    at_s: float
    rotation: F64
    v_mps: F64
    p_m: F64
    gyro_bias: F64
    accel_bias: F64


class Clone(NamedTuple):
    """Pose of the body at a key image."""

    key: int
    rotation: F64
    p_m: F64
    first_rotation: F64
    """First estimate. All measurements are linearised there; otherwise the filter would become too certain of its
    heading (G. Huang, A. Mourikis and S. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
    estimators", IJRR 2010)."""
    first_m: F64


class Sight(NamedTuple):
    """A corner in a key image: the slopes x/z and y/z of its ray."""

    key: int
    slope: F64


# Name of a corner: its camera, and its number.
Name = tuple[str, int]


class Place(NamedTuple):
    """A corner with a position in the state."""

    name: Name
    p_m: F64
    first_m: F64
    """First estimate; see `Clone`."""


class Rays(NamedTuple):
    """The sights of M corners, each in up to N key images."""

    seen: npt.NDArray[np.bool_]
    """Valid sights, shape (M, N): the first ones in each row."""
    clone: npt.NDArray[np.int64]
    """Index of the clone of each sight, shape (M, N)."""
    slopes: F64
    """Shape (M, N, 2)."""
    body_from_cam: F64
    """Rotation, shape (M, 1, 3, 3)."""
    camera_m: F64
    """Position of the camera, shape (M, 1, 3, 1). [m, body]"""
    sigma: F64
    """Standard deviation of slopes, shape (M,)."""


def moved(motion: Motion, accel_mps2: F64, gyro_radps: F64, dt_s: float) -> Motion:
    """Returns the motion after `dt_s` with constant samples. Exact for a constant angular velocity, and a force that is
    constant in the axes at the middle of the step."""
    omega = gyro_radps - motion.gyro_bias
    middle = motion.rotation @ exp_so3(omega * dt_s / 2)
    a_mps2 = middle @ (accel_mps2 - motion.accel_bias) + GRAVITY_MPS2
    return motion._replace(
        at_s=motion.at_s + dt_s,
        rotation=motion.rotation @ exp_so3(omega * dt_s),
        v_mps=motion.v_mps + a_mps2 * dt_s,
        p_m=motion.p_m + motion.v_mps * dt_s + a_mps2 * dt_s**2 / 2,
    )


def transition(motion: Motion, accel_mps2: F64, gyro_radps: F64, dt_s: float) -> F64:
    """Returns the transition matrix of the motion's error over `dt_s`, shape (15, 15)."""
    omega = gyro_radps - motion.gyro_bias
    half = exp_so3(omega * dt_s / 2)
    force = motion.rotation @ half
    by_turn = -motion.rotation @ skew(half @ (accel_mps2 - motion.accel_bias))
    out = np.eye(IMU_SIZE)
    out[TURN, TURN], out[TURN, GYRO] = exp_so3(-omega * dt_s), -np.eye(3) * dt_s
    out[V, TURN], out[V, ACCEL] = by_turn * dt_s, -force * dt_s
    out[V, GYRO] = -by_turn * dt_s**2 / 2
    out[P, V] = np.eye(3) * dt_s
    out[P, TURN], out[P, ACCEL] = by_turn * dt_s**2 / 2, -force * dt_s**2 / 2
    return out


def triangulate(axes: F64, from_m: F64, slopes: F64, seen: npt.NDArray[np.bool_]) -> tuple[F64, F64]:
    """Returns the intersections (M, 3) of rays [m, odom], and the residuals (M, N, 2) of their slopes.

    Inputs: axes (M, N, 3, 3) and positions (M, N, 3) of the cameras, slopes (M, N, 2), and valid sights (M, N). Starts
    with the midpoint of the rays, then Gauss-Newton (R. Hartley and A. Zisserman, "Multiple view geometry", 2nd ed.,
    chapter 12). NaN for parallel rays.
    """
    rays = np.einsum("mnij,mnj->mni", axes, np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=2))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    across = (np.eye(3) - rays[..., :, None] * rays[..., None, :]) * seen[..., None, None]
    matrix, right = across.sum(axis=1), np.einsum("mnij,mnj->mi", across, from_m)
    parallel = np.linalg.eigvalsh(matrix)[:, 0] < 1e-5 * seen.sum(axis=1)
    matrix[parallel] = np.eye(3)
    places_m = np.linalg.solve(matrix, right[..., None])[..., 0]
    for _ in range(TRIANGULATIONS):
        residual, slope = _look(axes, from_m, slopes, seen, places_m)
        matrix = np.einsum("mnij,mnik->mjk", slope, slope)
        # Small relative damping, because rays of a single camera at rest give a singular matrix.
        matrix += (1e-9 + 1e-12 * np.trace(matrix, axis1=1, axis2=2))[:, None, None] * np.eye(3)
        places_m = places_m - np.linalg.solve(matrix, np.einsum("mnij,mni->mj", slope, residual)[..., None])[..., 0]
    residual, _ = _look(axes, from_m, slopes, seen, places_m)
    in_cam_m = np.einsum("mnji,mnj->mni", axes, places_m[:, None] - from_m)
    behind = ((in_cam_m[..., 2] < NEAREST_M) & seen).any(axis=1)
    places_m[parallel | behind] = np.nan
    return places_m, residual


def _look(
    axes: F64, from_m: F64, slopes: F64, seen: npt.NDArray[np.bool_], places_m: F64
) -> tuple[F64, F64]:
    """Returns residuals of slopes (M, N, 2), and their derivatives by the position, shape (M, N, 2, 3)."""
    in_cam_m = np.einsum("mnji,mnj->mni", axes, places_m[:, None] - from_m)
    z_m = np.maximum(in_cam_m[..., 2:], 1e-3)
    residual = (in_cam_m[..., :2] / z_m - slopes) * seen[..., None]
    by_cam = np.zeros((*seen.shape, 2, 3))
    by_cam[..., 0, 0] = by_cam[..., 1, 1] = 1 / z_m[..., 0]
    by_cam[..., 2] = -in_cam_m[..., :2] / z_m**2
    return residual, by_cam @ np.swapaxes(axes, 2, 3) * seen[..., None, None]


def chi_square(freedom: int) -> float:
    """Returns the 95 % quantile of a chi-square variable, accurate to 1 % (E. Wilson and M. Hilferty, PNAS 17(12),
    1931)."""
    spread = 2 / (9 * freedom)
    return freedom * (1 - spread + 1.645 * spread**0.5) ** 3


class InertialOdometry(Odometry):
    """Pose of the body, from images and IMU."""

    def __init__(self) -> None:
        super().__init__()
        self._motion: Motion | None = None
        self._covariance = np.zeros((IMU_SIZE, IMU_SIZE))
        self._clones: list[Clone] = []
        self._places: list[Place] = []
        self._keys = 0
        self._tracks: dict[str, Tracks] = {}
        self._sights: dict[Name, list[Sight]] = {}
        self._views: dict[str, View] = {}
        self._key_s: dict[str, float] = {}

    def begin(self, standing: Standing) -> None:
        """Starts at rest."""
        # The bias along the specific force is known, because gravity is. Across it, bias and tilt cannot be
        # distinguished.
        accel_mps2 = standing.accel_mps2
        accel_bias = accel_mps2 * (1 + GRAVITY_MPS2[2] / float(np.linalg.norm(accel_mps2)))
        level, zero = level_from_body(accel_mps2), np.zeros(3)
        self._motion = Motion(standing.until_s, level, zero, zero, standing.gyro_bias, accel_bias)
        sigmas = [TILT_SIGMA, TILT_SIGMA, OWN_SIGMA]
        for sigma in (V_SIGMA, OWN_SIGMA, GYRO_SIGMA, ACCEL_SIGMA):
            sigmas += [sigma] * 3
        covariance = np.diag(np.square(sigmas))
        # The accelerometer at rest correlates tilt and bias.
        by_error = np.zeros((3, IMU_SIZE))
        by_error[:, TURN], by_error[:, ACCEL] = skew(level.T @ -GRAVITY_MPS2), np.eye(3)
        expected = by_error @ covariance @ by_error.T + np.eye(3) * STANDING_SIGMA**2
        self._covariance = covariance - covariance @ by_error.T @ np.linalg.solve(expected, by_error @ covariance)

    def see(self, at_ns: int, views: list[View]) -> Estimate:
        """Returns the estimate at an instant, from its images and the samples until then."""
        self._propagate(at_ns * 1e-9)
        self._follow(at_ns * 1e-9, views)
        return self._estimate(at_ns, self._motion)

    def now(self) -> Estimate | None:
        """Returns the motion at the newest sample, for steering; None before lift-off."""
        if self._motion is None:
            return None
        motion = self._motion
        for one in self.readings:
            if one.at_s > motion.at_s:
                motion = moved(motion, one.accel_mps2, one.gyro_radps, one.at_s - motion.at_s)
        return self._estimate(round(motion.at_s * 1e9), motion)

    @staticmethod
    def _estimate(at_ns: int, motion: Motion) -> Estimate:
        return Estimate(at_ns, motion.p_m, motion.rotation, motion.v_mps)

    # --- the IMU

    def _propagate(self, to_s: float) -> None:
        """Propagates the state to an instant that the samples cover."""
        for dt_s, accel, gyro in self.between(self._motion.at_s, to_s):
            by_error = transition(self._motion, accel, gyro, dt_s)
            noise = np.repeat([GYRO_NOISE, ACCEL_NOISE, 0.0, GYRO_WALK, ACCEL_WALK], 3) ** 2 * dt_s
            covariance = self._covariance
            covariance[:IMU_SIZE] = by_error @ covariance[:IMU_SIZE]
            covariance[:, :IMU_SIZE] = covariance[:, :IMU_SIZE] @ by_error.T
            covariance[np.arange(IMU_SIZE), np.arange(IMU_SIZE)] += noise
            self._motion = moved(self._motion, accel, gyro, dt_s)

    # --- images

    def _follow(self, at_s: float, views: list[View]) -> None:
        """Tracks corners to new images; updates the filter at key images."""
        key_views = []
        for view in views:
            tracks = self._tracks.setdefault(view.camera, Tracks(CORNERS, APART_PX))
            tracks.follow(view.grey)
            self._views[view.camera] = view
            if at_s - self._key_s.get(view.camera, -1e9) >= KEY_S:
                key_views.append(view)
        if not key_views:
            return
        self._clone()
        going_on = {(camera, int(number)) for camera, tracks in self._tracks.items() for number in tracks.ids}
        self._forget_places({place.name for place in self._places} - going_on)
        placed = {place.name for place in self._places}
        looks: dict[Name, F64] = {}
        for view in key_views:
            tracks = self._tracks[view.camera]
            self._key_s[view.camera] = at_s
            for number, slope in zip(tracks.ids, view.slopes(tracks.px)):
                name = view.camera, int(number)
                if name in placed:
                    looks[name] = slope
                else:
                    self._sights.setdefault(name, []).append(Sight(self._keys, slope))
        ended = [name for name in self._sights if name not in going_on]
        old = []
        if len(self._clones) > KEYS:
            oldest = self._clones[0].key
            old = sorted(name for name in going_on if name in self._sights and self._sights[name][0].key == oldest)
        self._use(sorted(ended + old), looks)
        self._place(old[: PLACES - len(self._places)])
        for name in ended + old:
            del self._sights[name]
        if len(self._clones) > KEYS:
            self._forget_oldest()
        for view in key_views:
            tracks = self._tracks[view.camera]
            added = tracks.add()
            first = len(tracks.ids) - added
            for number, slope in zip(tracks.ids[first:], view.slopes(tracks.px[first:])):
                self._sights[view.camera, int(number)] = [Sight(self._keys, slope)]

    # --- what is in the state

    def _clone_at(self, index: int) -> int:
        """Returns the index of a clone in the error state."""
        return IMU_SIZE + PLACE_SIZE * len(self._places) + CLONE_SIZE * index

    def _clone(self) -> None:
        """Adds the current pose to the state. The image shows the predicted pose."""
        self._keys += 1
        rotation, p_m = self._motion.rotation, self._motion.p_m
        self._clones.append(Clone(self._keys, rotation, p_m, rotation, p_m))
        rows = np.concatenate([self._covariance[TURN], self._covariance[P]])
        corner = np.concatenate([rows[:, TURN], rows[:, P]], axis=1)
        corner = corner + np.diag([PREDICTED_RAD**2] * 3 + [PREDICTED_M**2] * 3)
        self._covariance = np.block([[self._covariance, rows.T], [rows, corner]])

    def _forget_oldest(self) -> None:
        at = self._clone_at(0)
        del self._clones[0]
        self._keep(np.r_[0:at, at + CLONE_SIZE : len(self._covariance)])

    def _forget_places(self, names: set[Name]) -> None:
        stay = np.repeat([place.name not in names for place in self._places], PLACE_SIZE)
        places = IMU_SIZE + np.flatnonzero(stay)
        self._keep(np.r_[0:IMU_SIZE, places, self._clone_at(0) : len(self._covariance)])
        self._places = [place for place in self._places if place.name not in names]

    def _keep(self, which: npt.NDArray[np.int64]) -> None:
        self._covariance = self._covariance[np.ix_(which, which)]

    def _place(self, names: list[Name]) -> None:
        """Adds positions of corners to the state."""
        if not names:
            return
        rays = self._rays(names)
        places_m, _, off = self._meet(rays)
        by_state, by_place = self._slopes_by(rays, places_m)
        size = len(self._covariance)
        added, by_error, own = [], [np.eye(size)], []
        for n in np.flatnonzero(np.isfinite(places_m).all(axis=1) & (off < HUBER)):
            count = int(rays.seen[n].sum())
            # Least squares: derivatives of the position by the errors of the rays and of the clones.
            by_slopes = np.linalg.pinv(by_place[n, :count].reshape(-1, 3))
            by_error.append(-by_slopes @ by_state[n, :count].reshape(-1, size))
            own.append(rays.sigma[n] ** 2 * by_slopes @ by_slopes.T)
            added.append(Place(names[n], places_m[n], places_m[n]))
        grow = np.concatenate(by_error)
        covariance = grow @ self._covariance @ grow.T
        for k, square in enumerate(own):
            at = slice(size + PLACE_SIZE * k, size + PLACE_SIZE * (k + 1))
            covariance[at, at] += square
        # Positions come before clones.
        at_clones = self._clone_at(0)
        order = np.r_[0:at_clones, size : len(covariance), at_clones:size]
        self._covariance = covariance[np.ix_(order, order)]
        self._places += added

    # --- measurements of corners

    def _rays(self, names: list[Name]) -> Rays:
        """Returns the sights of corners."""
        at = {clone.key: index for index, clone in enumerate(self._clones)}
        most = max(len(self._sights[name]) for name in names)
        seen = np.zeros((len(names), most), bool)
        clone = np.zeros((len(names), most), int)
        slopes = np.zeros((len(names), most, 2))
        for row, name in enumerate(names):
            sights = self._sights[name]
            seen[row, : len(sights)] = True
            clone[row, : len(sights)] = [at[sight.key] for sight in sights]
            slopes[row, : len(sights)] = [sight.slope for sight in sights]
        views = [self._views[camera] for camera, _ in names]
        body_from_cam = np.array([view.body_from_cam for view in views])[:, None]
        camera_m = np.array([view.camera_m for view in views])[:, None, :, None]
        sigma = SIGMA_PX / np.array([view.focal_px.mean() for view in views])
        return Rays(seen, clone, slopes, body_from_cam, camera_m, sigma)

    def _meet(self, rays: Rays) -> tuple[F64, F64, F64]:
        """Returns intersections of rays (M, 3), NaN if there is none [m, odom]; residuals (M, N, 2); residuals in
        sigmas (M,)."""
        rotations = np.array([one.rotation for one in self._clones])[rays.clone]
        bodies_m = np.array([one.p_m for one in self._clones])[rays.clone]
        from_m = bodies_m + (rotations @ rays.camera_m)[..., 0]
        places_m, residual = triangulate(rotations @ rays.body_from_cam, from_m, rays.slopes, rays.seen)
        off = np.sqrt((residual**2).sum(axis=(1, 2)) / (2 * rays.seen.sum(axis=1) - 3)) / rays.sigma
        far = np.linalg.norm(places_m - from_m[:, 0], axis=1) > FARTHEST_M
        places_m[far | (off > DROPPED)] = np.nan
        return places_m, residual, off

    def _slopes_by(self, rays: Rays, places_m: F64) -> tuple[F64, F64]:
        """Returns derivatives of residuals by the error state (M, N, 2, S) and the corner's position (M, N, 2, 3)."""
        rotations = np.array([one.first_rotation for one in self._clones])[rays.clone]
        bodies_m = np.array([one.first_m for one in self._clones])[rays.clone]
        from_m = bodies_m + (rotations @ rays.camera_m)[..., 0]
        _, by_place = _look(rotations @ rays.body_from_cam, from_m, rays.slopes, rays.seen, places_m)
        in_body_m = np.einsum("mnji,mnj->mni", rotations, places_m[:, None] - bodies_m)
        by_clone = np.concatenate([by_place @ rotations @ skew(in_body_m), -by_place], axis=3)
        by_state = np.zeros((*rays.seen.shape, 2, len(self._covariance)))
        row, column = np.indices(rays.seen.shape)
        for k in range(CLONE_SIZE):
            by_state[row, column, :, self._clone_at(0) + CLONE_SIZE * rays.clone + k] = by_clone[..., k]
        return by_state, by_place

    def _use(self, names: list[Name], looks: dict[Name, F64]) -> None:
        """Updates the state with complete corners, and with the current sights of corners in the state."""
        size = len(self._covariance)
        information, vector = np.zeros((size, size)), np.zeros(size)
        names = [name for name in names if len(self._sights[name]) >= FEWEST_SEEN]
        if names:
            self._take_rays(self._rays(names), information, vector)
        lost = self._take_looks(looks, information, vector)
        # Kalman update in information form, because there are many measurements and a small state.
        covariance = self._covariance @ np.linalg.inv(np.eye(size) + information @ self._covariance)
        self._covariance = (covariance + covariance.T) / 2
        self._change(self._covariance @ vector)
        self._forget_places(lost)

    def _take_rays(self, rays: Rays, information: F64, vector: F64) -> None:
        """Adds the constraints of rays that intersect, independent of the corner's position."""
        places_m, residual, off = self._meet(rays)
        weight = np.minimum(1.0, HUBER / np.maximum(off, 1e-9)) / rays.sigma**2
        by_state, by_place = self._slopes_by(rays, places_m)
        for n in np.flatnonzero(np.isfinite(places_m).all(axis=1)):
            count = int(rays.seen[n].sum())
            slope = by_state[n, :count].reshape(-1, len(vector))
            own, lack = by_place[n, :count].reshape(-1, 3), -residual[n, :count].reshape(-1)
            # Project out the corner's position.
            left = np.linalg.qr(own, mode="complete")[0][:, 3:].T
            rows, lack = left @ slope, left @ lack
            # Reject very unlikely measurements, which are of moving objects (Mahalanobis distance).
            expected = rows @ self._covariance @ rows.T + np.eye(len(rows)) / weight[n]
            if lack @ np.linalg.solve(expected, lack) > chi_square(len(rows)):
                continue
            information += weight[n] * rows.T @ rows
            vector += weight[n] * rows.T @ lack

    def _take_looks(self, looks: dict[Name, F64], information: F64, vector: F64) -> set[Name]:
        """Adds the current sights of corners in the state. Returns corners with too large residuals."""
        clone, at_clone = self._clones[-1], self._clone_at(len(self._clones) - 1)
        there = np.ones((1, 1), bool)
        lost = set()
        for n, place in enumerate(self._places):
            if place.name not in looks:
                continue
            view = self._views[place.name[0]]
            camera = (clone.rotation @ view.body_from_cam)[None, None], clone.p_m + clone.rotation @ view.camera_m
            residual, _ = _look(*camera, looks[place.name], there, place.p_m[None])
            _, by_place = _look(*camera, looks[place.name], there, place.first_m[None])
            lack, by_place = -residual[0, 0], by_place[0, 0]
            by_turn = by_place @ clone.rotation @ skew(clone.rotation.T @ (place.first_m - clone.p_m))
            rows = np.concatenate([by_place, by_turn, -by_place], axis=1)
            at = IMU_SIZE + PLACE_SIZE * n
            columns = np.r_[at : at + PLACE_SIZE, at_clone : at_clone + CLONE_SIZE]
            block = np.ix_(columns, columns)
            sigma = PLACE_SIGMA_PX / view.focal_px.mean()
            expected = rows @ self._covariance[block] @ rows.T + np.eye(2) * sigma**2
            off = np.sqrt(lack @ np.linalg.solve(expected, lack) / 2)
            if off > LOST:
                lost.add(place.name)
                continue
            weight = min(1.0, HUBER / max(off, 1e-9)) / sigma**2
            information[block] += weight * rows.T @ rows
            vector[columns] += weight * rows.T @ lack
        return lost

    def _change(self, change: F64) -> None:
        """Applies a correction to the complete state."""
        motion = self._motion
        self._motion = motion._replace(
            rotation=motion.rotation @ exp_so3(change[TURN]),
            v_mps=motion.v_mps + change[V],
            p_m=motion.p_m + change[P],
            gyro_bias=motion.gyro_bias + change[GYRO],
            accel_bias=motion.accel_bias + change[ACCEL],
        )
        for index, place in enumerate(self._places):
            part = change[IMU_SIZE + PLACE_SIZE * index :][:PLACE_SIZE]
            self._places[index] = place._replace(p_m=place.p_m + part)
        for index, old in enumerate(self._clones):
            part = change[self._clone_at(index) :][:CLONE_SIZE]
            rotation, p_m = old.rotation @ exp_so3(part[:3]), old.p_m + part[3:]
            self._clones[index] = old._replace(rotation=rotation, p_m=p_m)


class Inertial(OdometryPlugin):
    """Visual-inertial odometry: flies square, spiral or lemniscate without depth, or runs on a data set."""

    make_estimator = InertialOdometry


if __name__ == "__main__":
    main(Inertial)
