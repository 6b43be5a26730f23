#!/usr/bin/env python3
"""Flies square, spiral or lemniscate by visual-inertial odometry: colour images and the IMU, no depth.

A multi-state constraint Kalman filter (A. Mourikis and S. Roumeliotis, "A multi-state constraint Kalman filter for
vision-aided inertial navigation", ICRA 2007). Its state is the body's motion and the IMU's biases, and the body's poses
at the last key images. Between images the IMU carries it on; scale and up come from there. A corner that was seen in
several of those images says how they lie to each other: its own place is eliminated (Schur complement), so it needs no
room in the state. Corners that are followed for longer get a place in the state all the same (M. Li and A. Mourikis,
"Optimization-based estimator design for vision-aided inertial navigation", RSS 2012): they remember how large the world
is, when the images in which that was measured are long forgotten. Scale is known at once, as the vehicle stands before
it takes off: velocity is 0 there, gravity is what the accelerometer feels, and the gyroscope's mean is its bias.

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
# White noise and random walk of the IMU: an ICM-42688 class sensor on a small frame. A reading is off by 0.2 m/s^2 and
# 0.01 rad/s, and 100 come in a second: divided by the root of 100 Hz.
# [m/s^2/sqrt(Hz)], [rad/s/sqrt(Hz)], [m/s^3/sqrt(Hz)], [rad/s^2/sqrt(Hz)]
ACCEL_NOISE, GYRO_NOISE, ACCEL_WALK, GYRO_WALK = 0.02, 0.001, 1e-3, 1e-4
# What is known where it stands: tilt [rad], velocity [m/s], biases [rad/s], [m/s^2]; and the mean force felt. [m/s^2]
TILT_SIGMA, V_SIGMA, GYRO_SIGMA, ACCEL_SIGMA, STANDING_SIGMA = 0.05, 0.003, 0.001, 0.05, 0.01
# Heading and place are the frame's own, by definition.
OWN_SIGMA = 1e-4
# Key images are so far apart, and so many are remembered. [s]
KEY_S, KEYS = 0.09, 20
# An image shows where the vehicle was predicted to be at its instant, not where it then was: how far the two are apart.
# [rad], [m]
PREDICTED_RAD, PREDICTED_M = 0.0015, 0.001
# Corners of each camera, and how far they are apart at least. [px]
CORNERS, APART_PX = 220, 10
# How far a followed corner is off. [px]
SIGMA_PX = 0.5
# So many corners have their places in the state; and how far such a corner is off, which drifts as it is followed. [px]
PLACES, PLACE_SIGMA_PX = 50, 1.5
# Corners whose residuals are beyond so many sigmas count less, or not at all; beyond the last, a place is forgotten.
HUBER, DROPPED, LOST = 1.5, 6.0, 4.0
# Seen in at least so many key images; and beyond this distance a corner's place is not believed. [m, cam]
FEWEST_SEEN, NEAREST_M, FARTHEST_M = 4, 0.1, 40.0
TRIANGULATIONS = 5

# The error state begins with turn of the body [rad, body], velocity, place, biases of gyroscope and accelerometer. Then
# come the places of corners, and turn and place of each clone.
TURN, V, P, GYRO, ACCEL = (slice(n, n + 3) for n in (0, 3, 6, 9, 12))
IMU_SIZE, PLACE_SIZE, CLONE_SIZE = 15, 3, 6


class Motion(NamedTuple):
    """The body's motion at an instant, in the frame `odom`, and what the IMU's readings are off by."""

    at_s: float
    rotation: F64
    v_mps: F64
    p_m: F64
    gyro_bias: F64
    accel_bias: F64


class Clone(NamedTuple):
    """Where the body was at a key image."""

    key: int
    rotation: F64
    p_m: F64
    first_rotation: F64
    """As it was first estimated: there all measurements are linearised, or the filter believes to know its heading (G.
    Huang, A. Mourikis and S. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators",
    IJRR 2010)."""
    first_m: F64


class Sight(NamedTuple):
    """A corner in a key image: the slopes x/z and y/z of its ray."""

    key: int
    slope: F64


# A corner's name: its camera, and its number there.
Name = tuple[str, int]


class Place(NamedTuple):
    """A corner whose place is in the state."""

    name: Name
    p_m: F64
    first_m: F64
    """As it was first estimated; see `Clone`."""


class Rays(NamedTuple):
    """The sights of M corners, of each in up to N key images."""

    seen: npt.NDArray[np.bool_]
    """Which of them there are, shape (M, N): in each row the first ones."""
    clone: npt.NDArray[np.int64]
    """Which clone saw it, shape (M, N)."""
    slopes: F64
    """Shape (M, N, 2)."""
    body_from_cam: F64
    """Rotation, shape (M, 1, 3, 3)."""
    camera_m: F64
    """Where the camera sits, shape (M, 1, 3, 1). [m, body]"""
    sigma: F64
    """How far slopes are off, shape (M,)."""


def moved(motion: Motion, accel_mps2: F64, gyro_radps: F64, dt_s: float) -> Motion:
    """Returns the motion `dt_s` later, with readings that hold for that time: exact for a constant turn, and a force
    that is constant in the axes of its middle."""
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
    """Returns how an error of the motion (15,) goes on over `dt_s`, shape (15, 15)."""
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
    """Returns the places (M, 3) that rays meet in [m, odom], and the residuals (M, N, 2) of their slopes.

    Cameras' axes (M, N, 3, 3) and places (M, N, 3), slopes (M, N, 2), and which of them there are (M, N). The midpoint
    of the rays, then Gauss-Newton (R. Hartley and A. Zisserman, "Multiple view geometry", 2nd ed., chapter 12). NaN
    where rays are parallel.
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
        # A little of its own size on the diagonal, or rays of one camera that stands leave it singular.
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
    """Returns residuals of slopes (M, N, 2), and how they change with the place, shape (M, N, 2, 3)."""
    in_cam_m = np.einsum("mnji,mnj->mni", axes, places_m[:, None] - from_m)
    z_m = np.maximum(in_cam_m[..., 2:], 1e-3)
    residual = (in_cam_m[..., :2] / z_m - slopes) * seen[..., None]
    by_cam = np.zeros((*seen.shape, 2, 3))
    by_cam[..., 0, 0] = by_cam[..., 1, 1] = 1 / z_m[..., 0]
    by_cam[..., 2] = -in_cam_m[..., :2] / z_m**2
    return residual, by_cam @ np.swapaxes(axes, 2, 3) * seen[..., None, None]


def chi_square(freedom: int) -> float:
    """Returns what 95 % of a chi-square variable's values are below, to 1 % (E. Wilson and M. Hilferty, PNAS 17(12),
    1931)."""
    spread = 2 / (9 * freedom)
    return freedom * (1 - spread + 1.645 * spread**0.5) ** 3


class InertialOdometry(Odometry):
    """Where the body is, from images and IMU."""

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
        """Begins at rest."""
        # Along the force felt the bias is known, as gravity is; across it, it cannot be told from tilt.
        accel_mps2 = standing.accel_mps2
        accel_bias = accel_mps2 * (1 + GRAVITY_MPS2[2] / float(np.linalg.norm(accel_mps2)))
        level, zero = level_from_body(accel_mps2), np.zeros(3)
        self._motion = Motion(standing.until_s, level, zero, zero, standing.gyro_bias, accel_bias)
        sigmas = [TILT_SIGMA, TILT_SIGMA, OWN_SIGMA]
        for sigma in (V_SIGMA, OWN_SIGMA, GYRO_SIGMA, ACCEL_SIGMA):
            sigmas += [sigma] * 3
        covariance = np.diag(np.square(sigmas))
        # What the standing accelerometer felt binds the two together.
        by_error = np.zeros((3, IMU_SIZE))
        by_error[:, TURN], by_error[:, ACCEL] = skew(level.T @ -GRAVITY_MPS2), np.eye(3)
        expected = by_error @ covariance @ by_error.T + np.eye(3) * STANDING_SIGMA**2
        self._covariance = covariance - covariance @ by_error.T @ np.linalg.solve(expected, by_error @ covariance)

    def see(self, at_ns: int, views: list[View]) -> Estimate:
        """Returns the estimate of an instant, from its images and the readings until then."""
        self._propagate(at_ns * 1e-9)
        self._follow(at_ns * 1e-9, views)
        return self._estimate(at_ns, self._motion)

    def now(self) -> Estimate | None:
        """Returns the motion at the newest reading, for steering; None while it stands."""
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
        """Carries the state on to an instant up to which there are readings."""
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
        """Follows corners into new images; at key images the filter takes what they say."""
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
        """Returns where a clone begins in the error state."""
        return IMU_SIZE + PLACE_SIZE * len(self._places) + CLONE_SIZE * index

    def _clone(self) -> None:
        """Remembers the present pose, and that the image shows it as it was predicted."""
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
        """Takes the places of corners into the state."""
        if not names:
            return
        rays = self._rays(names)
        places_m, _, off = self._meet(rays)
        by_state, by_place = self._slopes_by(rays, places_m)
        size = len(self._covariance)
        added, by_error, own = [], [np.eye(size)], []
        for n in np.flatnonzero(np.isfinite(places_m).all(axis=1) & (off < HUBER)):
            count = int(rays.seen[n].sum())
            # Least squares: how the place follows from what the rays are off by, and from what the clones are off by.
            by_slopes = np.linalg.pinv(by_place[n, :count].reshape(-1, 3))
            by_error.append(-by_slopes @ by_state[n, :count].reshape(-1, size))
            own.append(rays.sigma[n] ** 2 * by_slopes @ by_slopes.T)
            added.append(Place(names[n], places_m[n], places_m[n]))
        grow = np.concatenate(by_error)
        covariance = grow @ self._covariance @ grow.T
        for k, square in enumerate(own):
            at = slice(size + PLACE_SIZE * k, size + PLACE_SIZE * (k + 1))
            covariance[at, at] += square
        # Places come before clones.
        at_clones = self._clone_at(0)
        order = np.r_[0:at_clones, size : len(covariance), at_clones:size]
        self._covariance = covariance[np.ix_(order, order)]
        self._places += added

    # --- what corners say

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
        """Returns where rays meet (M, 3), NaN if nowhere [m, odom]; their residuals (M, N, 2); how many sigmas those
        are (M,)."""
        rotations = np.array([one.rotation for one in self._clones])[rays.clone]
        bodies_m = np.array([one.p_m for one in self._clones])[rays.clone]
        from_m = bodies_m + (rotations @ rays.camera_m)[..., 0]
        places_m, residual = triangulate(rotations @ rays.body_from_cam, from_m, rays.slopes, rays.seen)
        off = np.sqrt((residual**2).sum(axis=(1, 2)) / (2 * rays.seen.sum(axis=1) - 3)) / rays.sigma
        far = np.linalg.norm(places_m - from_m[:, 0], axis=1) > FARTHEST_M
        places_m[far | (off > DROPPED)] = np.nan
        return places_m, residual, off

    def _slopes_by(self, rays: Rays, places_m: F64) -> tuple[F64, F64]:
        """Returns how residuals change with the error state (M, N, 2, S), and with the corner's place (M, N, 2, 3)."""
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
        """Corrects the state by corners that are complete, and by where those are seen now whose places it has."""
        size = len(self._covariance)
        information, vector = np.zeros((size, size)), np.zeros(size)
        names = [name for name in names if len(self._sights[name]) >= FEWEST_SEEN]
        if names:
            self._take_rays(self._rays(names), information, vector)
        lost = self._take_looks(looks, information, vector)
        # The Kalman filter's update in its information form: the measurements are many, the state is small.
        covariance = self._covariance @ np.linalg.inv(np.eye(size) + information @ self._covariance)
        self._covariance = (covariance + covariance.T) / 2
        self._change(self._covariance @ vector)
        self._forget_places(lost)

    def _take_rays(self, rays: Rays, information: F64, vector: F64) -> None:
        """Adds what rays say that meet somewhere, wherever that is."""
        places_m, residual, off = self._meet(rays)
        weight = np.minimum(1.0, HUBER / np.maximum(off, 1e-9)) / rays.sigma**2
        by_state, by_place = self._slopes_by(rays, places_m)
        for n in np.flatnonzero(np.isfinite(places_m).all(axis=1)):
            count = int(rays.seen[n].sum())
            slope = by_state[n, :count].reshape(-1, len(vector))
            own, lack = by_place[n, :count].reshape(-1, 3), -residual[n, :count].reshape(-1)
            # What is left of the rows when the corner's own place is free.
            left = np.linalg.qr(own, mode="complete")[0][:, 3:].T
            rows, lack = left @ slope, left @ lack
            # What the state makes most unlikely is not of a place that stands still (Mahalanobis' distance).
            expected = rows @ self._covariance @ rows.T + np.eye(len(rows)) / weight[n]
            if lack @ np.linalg.solve(expected, lack) > chi_square(len(rows)):
                continue
            information += weight[n] * rows.T @ rows
            vector += weight[n] * rows.T @ lack

    def _take_looks(self, looks: dict[Name, F64], information: F64, vector: F64) -> set[Name]:
        """Adds where corners with a place are seen now; returns those that are too far from there."""
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
        """Corrects all that is in the state."""
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
    """Visual-inertial odometry: flies square, spiral or lemniscate without depth, or runs over a data set."""

    make_estimator = InertialOdometry


if __name__ == "__main__":
    main(Inertial)
