#!/usr/bin/env python3
"""Flies square, spiral or lemniscate with RGB-D visual odometry.

Corners are tracked from image to image. The depth at its first sighting gives each corner a position in the frame
`odom`. The pose of the body minimizes the reprojection error of all corners of all cameras: perspective-n-point with
depth, by Gauss-Newton with Huber weights (compare D. Nister, O. Naroditsky and J. Bergen, "Visual odometry", CVPR 2004;
R. Hartley and A. Zisserman, "Multiple view geometry", 2nd ed., section 7; P. Huber, Ann. Math. Statist. 35(1), 1964).
Before take-off, the accelerometer gives the direction of gravity. The gyroscope gives the rotation: otherwise common
errors of the corners would rotate the pose, in fog by degrees.

Fly:       vizflyt demo --project square --plugin jetson/plugins/python/rgbd_odometry.py
Data set:  rgbd_odometry.py --dataset DIR -o estimate.tum
"""

from __future__ import annotations

from collections.abc import Sequence

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

# Standard deviation of a tracked corner. [px]
SIGMA_PX = 0.5
# Standard deviation of depth: a fraction of it, and a constant. [1], [m]
SIGMA_DEPTH, SIGMA_DEPTH_M = 0.001, 0.004
# Residuals beyond HUBER sigmas get a lower weight; corners beyond DROPPED sigmas are dropped.
HUBER, DROPPED = 0.7, 5.0
ROUNDS = 10
# Range of new corners. [m, cam]
NEAREST_M, FARTHEST_M = 0.15, 15.0
# Depths that differ by more than this fraction within two pixels are an edge.
EDGE = 0.04
# Minimum number of corners for a pose.
FEWEST = 8
# Standard deviations of the gyroscope's rotation and of the predicted motion between two images. Errors of corners are
# correlated, so 100 corners constrain a rotation less than with independent errors. [rad], [m]
SIGMA_TURN_RAD, SIGMA_MOVE_M = 0.0001, 0.05


class RgbdOdometry(Odometry):
    """Pose of the body, from images with depth and the gyroscope."""

    def __init__(self) -> None:
        super().__init__()
        self._cameras: dict[str, tuple[Tracks, F64]] = {}
        self._rotation: F64 | None = None
        self._p_m, self._v_mps = np.zeros(3), np.zeros(3)
        self._gyro_bias = np.zeros(3)
        self._at_s = 0.0

    def begin(self, standing: Standing) -> None:
        """Starts at rest."""
        self._rotation, self._gyro_bias = level_from_body(standing.accel_mps2), standing.gyro_bias
        self._at_s = standing.until_s

    def now(self) -> Estimate | None:
        """Returns the newest image's estimate, extrapolated for steering; None before lift-off."""
        if self._rotation is None:
            return None
        rotation, at_s = self._rotation, self._at_s
        for one in self.readings:
            if one.at_s > at_s:
                rotation = rotation @ exp_so3((one.gyro_radps - self._gyro_bias) * (one.at_s - at_s))
                at_s = one.at_s
        return Estimate(round(at_s * 1e9), self._p_m + self._v_mps * (at_s - self._at_s), rotation, self._v_mps)

    def see(self, at_ns: int, views: list[View]) -> Estimate:
        """Returns the estimate at an instant, from its images and the samples until then."""
        dt_s = at_ns * 1e-9 - self._at_s
        # Prediction: rotation from the gyroscope, constant velocity.
        rotation, p_m = self._rotation, self._p_m + self._v_mps * dt_s
        for step_s, _, gyro_radps in self.between(self._at_s, at_ns * 1e-9):
            rotation = rotation @ exp_so3((gyro_radps - self._gyro_bias) * step_s)
        seen = []
        for view in views:
            tracks, places_m = self._cameras.setdefault(view.camera, (Tracks(), np.empty((0, 3))))
            ids = tracks.ids
            in_cam_m = (places_m - p_m) @ rotation
            in_cam_m = (in_cam_m - view.camera_m) @ view.body_from_cam
            before = in_cam_m[:, 2:] > 0.05
            guess_px = np.where(before, view.project(np.maximum(in_cam_m, [-1e3, -1e3, 0.05])), tracks.px)
            tracks.follow(view.grey, guess_px)
            places_m = places_m[np.isin(ids, tracks.ids)]
            self._cameras[view.camera] = (tracks, places_m)
            seen.append((view, tracks.px, places_m, depth_at(view.depth_m, tracks.px)[0]))
        rotation, p_m, offs = solve_pose(rotation, p_m, seen)
        # Smoothed a little, because the velocity is only used for prediction.
        self._v_mps = 0.5 * self._v_mps + 0.5 * (p_m - self._p_m) / dt_s
        self._rotation, self._p_m, self._at_s = rotation, p_m, at_ns * 1e-9
        for (view, *_), off in zip(seen, offs):
            self._renew(view, off)
        return Estimate(at_ns, p_m, rotation, self._v_mps)

    def _renew(self, view: View, off: F64) -> None:
        """Drops corners with large residuals, and adds new ones."""
        tracks, places_m = self._cameras[view.camera]
        good = off < DROPPED
        tracks.keep(good)
        places_m = places_m[good]
        added = tracks.add()
        if added:
            z_m, smooth = depth_at(view.depth_m, tracks.px[-added:])
            keep = np.concatenate([np.ones(len(places_m), bool), smooth & (z_m > NEAREST_M) & (z_m < FARTHEST_M)])
            in_cam_m = np.column_stack([view.slopes(tracks.px[-added:]), np.ones(added)]) * z_m[:, None]
            in_body_m = in_cam_m @ view.body_from_cam.T + view.camera_m
            places_m = np.concatenate([places_m, in_body_m @ self._rotation.T + self._p_m])[keep]
            tracks.keep(keep)
        self._cameras[view.camera] = (tracks, places_m)


def small_turn(rotation: F64) -> F64:
    """Returns the vector of a small rotation. [rad]"""
    off = rotation - rotation.T
    return np.array([off[2, 1], off[0, 2], off[1, 0]]) / 2


def depth_at(depth_m: npt.NDArray[np.float32] | None, px: F64) -> tuple[F64, npt.NDArray[np.bool_]]:
    """Returns the interpolated depth (N,) at pixels (N, 2), and whether the surface is smooth there; 0 and False
    without a return. [m, cam]"""
    if depth_m is None:
        return np.zeros(len(px)), np.zeros(len(px), bool)
    height, width = depth_m.shape
    x = np.clip(np.floor(px[:, 0]).astype(int), 1, width - 3)
    y = np.clip(np.floor(px[:, 1]).astype(int), 1, height - 3)
    around = np.stack([depth_m[y + dy, x + dx] for dy in (-1, 0, 1, 2) for dx in (-1, 0, 1, 2)]).astype(np.float64)
    low, high = around.min(axis=0), around.max(axis=0)
    smooth = (low > 0) & (high - low < EDGE * high)
    fx, fy = px[:, 0] - x, px[:, 1] - y
    a, b, c, d = around[5], around[6], around[9], around[10]
    z_m = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    return np.where(smooth, z_m, 0.0), smooth


def solve_pose(
    rotation: F64, p_m: F64, seen: Sequence[tuple[View, F64, F64, F64]]
) -> tuple[F64, F64, list[F64]]:
    """Returns the pose of the body that fits the observed corners best, from a first guess, and the residual of each
    corner in sigmas.

    `seen` has for each camera its view, pixels (N, 2), positions (N, 3) [m, odom] and depths (N,), 0 if unknown [m].
    """
    if sum(len(px) for _, px, _, _ in seen) < FEWEST:
        return rotation, p_m, [np.zeros(len(px)) for _, px, _, _ in seen]
    first, first_m = rotation, p_m
    offs: list[F64] = []
    for _ in range(ROUNDS):
        # The prediction counts as one measurement.
        turn = small_turn(first.T @ rotation)
        weight = np.array([SIGMA_TURN_RAD] * 3 + [SIGMA_MOVE_M] * 3) ** -2.0
        matrix, right = np.diag(weight), -weight * np.concatenate([turn, p_m - first_m])
        offs = []
        for view, px, places_m, depth_m in seen:
            in_body_m = (places_m - p_m) @ rotation
            in_cam_m = (in_body_m - view.camera_m) @ view.body_from_cam
            z_m = np.maximum(in_cam_m[:, 2], 0.05)
            # Derivatives of pixel and depth by the position in the camera, then by rotation and position of the body.
            residual = np.empty((len(px), 3))
            residual[:, :2] = (view.project(np.column_stack([in_cam_m[:, :2], z_m])) - px) / SIGMA_PX
            sigma_m = SIGMA_DEPTH_M + SIGMA_DEPTH * z_m
            known = depth_m > 0
            residual[:, 2] = np.where(known, (z_m - depth_m) / sigma_m, 0.0)
            by_cam = np.zeros((len(px), 3, 3))
            by_cam[:, 0, 0], by_cam[:, 1, 1] = view.focal_px[0] / z_m / SIGMA_PX, view.focal_px[1] / z_m / SIGMA_PX
            by_cam[:, :2, 2] = -in_cam_m[:, :2] * view.focal_px / z_m[:, None] ** 2 / SIGMA_PX
            by_cam[:, 2, 2] = np.where(known, 1 / sigma_m, 0.0)
            by_body = by_cam @ view.body_from_cam.T
            slope = np.concatenate([by_body @ skew(in_body_m), -by_body @ rotation.T], axis=2)
            in_px = np.linalg.norm(residual[:, :2], axis=1)
            off = np.stack([in_px, in_px, np.abs(residual[:, 2])], axis=1)
            huber = np.minimum(1.0, HUBER / np.maximum(off, 1e-9))
            huber[in_cam_m[:, 2] < 0.05] = 0.0
            matrix += np.einsum("nij,ni,nik->jk", slope, huber, slope)
            right -= np.einsum("nij,ni,ni->j", slope, huber, residual)
            offs.append(off.max(axis=1))
        change = np.linalg.solve(matrix, right)
        rotation, p_m = rotation @ exp_so3(change[:3]), p_m + change[3:]
        if np.abs(change).max() < 1e-6:
            break
    return rotation, p_m, offs


class Rgbd(OdometryPlugin):
    """RGB-D visual odometry: flies square, spiral or lemniscate, or runs on a data set."""

    make_estimator = RgbdOdometry
    needs_depth = True


if __name__ == "__main__":
    main(Rgbd)
