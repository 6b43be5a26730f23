#!/usr/bin/env python3
"""Flies square, spiral or lemniscate by visual-inertial odometry: colour images and the IMU, no depth.

A multi-state constraint Kalman filter (A. Mourikis and S. Roumeliotis, "A multi-state constraint Kalman filter for
vision-aided inertial navigation", ICRA 2007). Its state is the body's motion and the IMU's biases, and the body's poses
at the last key images. Between images the IMU carries it on; scale and up come from there. A corner that was seen in
several of those images says how they lie to each other: its own place is eliminated (Schur complement), so it needs no
room in the state. Scale is known at once, as the vehicle stands before it takes off: velocity is 0 there, gravity is
what the accelerometer feels, and the gyroscope's mean is its bias.

::

    IMU -> propagate -> clone at key images -> corners that end or grow old -> triangulate -> update

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
# White noise and random walk of the IMU: an ICM-42688 class sensor on a small frame, read 100 times a second.
# [m/s^2/sqrt(Hz)], [rad/s/sqrt(Hz)], [m/s^3/sqrt(Hz)], [rad/s^2/sqrt(Hz)]
ACCEL_NOISE, GYRO_NOISE, ACCEL_WALK, GYRO_WALK = 0.03, 0.001, 1e-3, 1e-4
# What is known where it stands: tilt [rad], velocity [m/s], biases [rad/s], [m/s^2]; and the mean force felt. [m/s^2]
TILT_SIGMA, V_SIGMA, GYRO_SIGMA, ACCEL_SIGMA, STANDING_SIGMA = 0.05, 0.02, 0.001, 0.05, 0.01
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
# Corners whose residuals are beyond so many sigmas count less, or not at all.
HUBER, DROPPED = 1.5, 6.0
# Seen in at least so many key images; and beyond this distance a corner's place is not believed. [m, cam]
FEWEST_SEEN, NEAREST_M, FARTHEST_M = 4, 0.1, 40.0
TRIANGULATIONS = 5

# Places in the error state: turn of the body [rad, body], velocity, place, biases of gyroscope and accelerometer.
TURN, V, P, GYRO, ACCEL = (slice(n, n + 3) for n in (0, 3, 6, 9, 12))
IMU_SIZE, CLONE_SIZE = 15, 6


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
        self._keys = 0
        self._tracks: dict[str, Tracks] = {}
        self._sights: dict[tuple[str, int], list[Sight]] = {}
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
        for view in key_views:
            tracks = self._tracks[view.camera]
            self._key_s[view.camera] = at_s
            for number, slope in zip(tracks.ids, view.slopes(tracks.px)):
                self._sights.setdefault((view.camera, int(number)), []).append(Sight(self._keys, slope))
        going_on = {(camera, int(number)) for camera, tracks in self._tracks.items() for number in tracks.ids}
        ended = [name for name in self._sights if name not in going_on]
        if len(self._clones) > KEYS:
            oldest = self._clones[0].key
            ended += [name for name in going_on if name in self._sights and self._sights[name][0].key == oldest]
        self._use(sorted(ended))
        for name in ended:
            del self._sights[name]
        if len(self._clones) > KEYS:
            self._forget_oldest()
        for view in key_views:
            tracks = self._tracks[view.camera]
            added = tracks.add()
            first = len(tracks.ids) - added
            for number, slope in zip(tracks.ids[first:], view.slopes(tracks.px[first:])):
                self._sights[view.camera, int(number)] = [Sight(self._keys, slope)]

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
        del self._clones[0]
        keep = np.r_[0:IMU_SIZE, IMU_SIZE + CLONE_SIZE : len(self._covariance)]
        self._covariance = self._covariance[np.ix_(keep, keep)]

    def _use(self, names: list[tuple[str, int]]) -> None:
        """Corrects the state by corners that are complete."""
        names = [name for name in names if len(self._sights[name]) >= FEWEST_SEEN]
        if not names:
            return
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

        def cameras(rotations: F64, bodies_m: F64) -> tuple[F64, F64]:
            return rotations[clone] @ body_from_cam, bodies_m[clone] + (rotations[clone] @ camera_m)[..., 0]

        axes, from_m = cameras(
            np.array([one.rotation for one in self._clones]), np.array([one.p_m for one in self._clones])
        )
        places_m, residual = triangulate(axes, from_m, slopes, seen)
        off = np.sqrt((residual**2).sum(axis=(1, 2)) / (2 * seen.sum(axis=1) - 3)) / sigma
        far = np.linalg.norm(places_m - from_m[:, 0], axis=1) > FARTHEST_M
        good = np.flatnonzero(np.isfinite(places_m).all(axis=1) & (off < DROPPED) & ~far)
        weight = np.minimum(1.0, HUBER / np.maximum(off, 1e-9)) / sigma**2
        # How residuals change with turn and place of the body, and with the corner's place.
        rotations = np.array([one.first_rotation for one in self._clones])
        bodies_m = np.array([one.first_m for one in self._clones])
        axes, from_m = cameras(rotations, bodies_m)
        _, by_place = _look(axes, from_m, slopes, seen, places_m)
        in_body_m = np.einsum("mnji,mnj->mni", rotations[clone], places_m[:, None] - bodies_m[clone])
        by_turn = by_place @ rotations[clone] @ skew(in_body_m)
        size = len(self._covariance)
        information, vector = np.zeros((size, size)), np.zeros(size)
        for n in good:
            count = int(seen[n].sum())
            slope = np.zeros((2 * count, size))
            for k in range(count):
                column = IMU_SIZE + CLONE_SIZE * int(clone[n, k])
                slope[2 * k : 2 * k + 2, column : column + 3] = by_turn[n, k]
                slope[2 * k : 2 * k + 2, column + 3 : column + 6] = -by_place[n, k]
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
        # The Kalman filter's update in its information form: the measurements are many, the state is small.
        covariance = self._covariance @ np.linalg.inv(np.eye(size) + information @ self._covariance)
        self._covariance = (covariance + covariance.T) / 2
        change = self._covariance @ vector
        motion = self._motion
        self._motion = motion._replace(
            rotation=motion.rotation @ exp_so3(change[TURN]),
            v_mps=motion.v_mps + change[V],
            p_m=motion.p_m + change[P],
            gyro_bias=motion.gyro_bias + change[GYRO],
            accel_bias=motion.accel_bias + change[ACCEL],
        )
        for index, old in enumerate(self._clones):
            part = change[IMU_SIZE + CLONE_SIZE * index :][:CLONE_SIZE]
            rotation, p_m = old.rotation @ exp_so3(part[:3]), old.p_m + part[3:]
            self._clones[index] = old._replace(rotation=rotation, p_m=p_m)


class Inertial(OdometryPlugin):
    """Visual-inertial odometry: flies square, spiral or lemniscate without depth, or runs over a data set."""

    make_estimator = InertialOdometry


if __name__ == "__main__":
    main(Inertial)
