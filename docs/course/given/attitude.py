"""Quaternions, and the files that the projects read and write. Given; nothing is to be filled in here.

A quaternion is an array (4,) in the order x, y, z, w. It rotates vectors from body axes (x forward, y left, z up) to
the axes of the frame `odom` (z up, heading as at the beginning). All units are SI.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

GRAVITY_MPS2 = 9.80665
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def multiply(a: F64, b: F64) -> F64:
    """Returns the product a b: first rotation b, then a. Shapes (4,) or (N, 4)."""
    # Transposed, so that the components come first for both shapes, (4,) and (N, 4).
    (ax, ay, az, aw), (bx, by, bz, bw) = np.asarray(a, float).T, np.asarray(b, float).T
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    ).T


def conjugate(q: F64) -> F64:
    """Returns the inverse rotation. Shape (..., 4)."""
    return np.asarray(q, float) * [-1.0, -1.0, -1.0, 1.0]


def exp(turn_rad: F64) -> F64:
    """Returns the quaternion of a rotation vector: axis times angle [rad]. Shape (..., 3) gives (..., 4)."""
    turn_rad = np.asarray(turn_rad, float)
    half = np.linalg.norm(turn_rad, axis=-1, keepdims=True) / 2
    # sin(h) / 2h; numpy's sinc is sin(pi x) / (pi x), and is 1 at 0.
    return np.concatenate([turn_rad * np.sinc(half / np.pi) / 2, np.cos(half)], axis=-1)


def log(q: F64) -> F64:
    """Returns the rotation vector of a quaternion, at most pi: the inverse of `exp`. Shape (..., 4) gives (..., 3)."""
    q = np.asarray(q, float)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine < 1e-12, 2.0, angle / np.maximum(sine, 1e-12))


def rotate(q: F64, vector: F64) -> F64:
    """Converts a vector from body axes to `odom` axes. Shapes (..., 4) and (..., 3)."""
    xyz, w = q[..., :3], q[..., 3:]
    across = 2 * np.cross(xyz, vector)
    return vector + w * across + np.cross(xyz, across)


def up_in_body(q: F64) -> F64:
    """Returns the world's up direction in body axes, as an accelerometer at rest measures it. (N, 4) gives (N, 3)."""
    x, y, z, w = np.asarray(q, float).T
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]).T


def level(accel_mps2: F64) -> F64:
    """Returns the attitude of a body at rest from its specific force: roll and pitch from the force, heading zero."""
    x, y, z = accel_mps2
    roll_rad, pitch_rad = np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))
    return multiply(exp(np.array([0.0, pitch_rad, 0.0])), exp(np.array([roll_rad, 0.0, 0.0])))


def is_quiet(accel_mps2: F64, gyro_radps: F64) -> bool:
    """Returns whether the vehicle is at rest, from a few tenths of a second of samples, shapes (N, 3).

    It is at rest if it measures only gravity, turns no faster than a possible bias (3 deg/s), and neither changes. The
    means of four parts are compared, which removes the sensor's noise. The limits are about three times the values of
    the simulated sensors on the floor. A vehicle that flies straight in calm air may pass the test, so stop calling it
    after the first motion.
    """
    if len(gyro_radps) < 40:
        return False
    if np.linalg.norm(gyro_radps.mean(axis=0)) > 0.06:
        return False
    if abs(np.linalg.norm(accel_mps2.mean(axis=0)) - GRAVITY_MPS2) > 0.5:
        return False
    gyro, accel = (
        np.array([part.mean(axis=0) for part in np.array_split(readings, 4)]) for readings in (gyro_radps, accel_mps2)
    )
    return bool(np.ptp(gyro, axis=0).max() < 0.02 and np.ptp(accel, axis=0).max() < 0.3)


class Imu(NamedTuple):
    """IMU samples of a data set."""

    at_ns: npt.NDArray[np.int64]
    gyro_radps: F64
    """Shape (N, 3). [rad/s, body]"""
    accel_mps2: F64
    """Shape (N, 3): specific force, +9.8 along z at rest. [m/s^2, body]"""


def read_imu(folder: Path) -> Imu:
    """Returns the IMU samples of a data set in EuRoC format, as written by `vizflyt export --format euroc`."""
    with open(Path(folder) / "mav0/imu0/data.csv", newline="") as file:
        rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    at_ns = np.array([int(row[0]) for row in rows], np.int64)
    numbers = np.array([[float(one) for one in row[1:7]] for row in rows])
    return Imu(at_ns, numbers[:, :3], numbers[:, 3:])


def write_tum(path: Path, at_ns: npt.NDArray[np.int64], q_xyzw: F64) -> None:
    """Writes attitudes in TUM format: seconds, position (always zero), quaternion x y z w."""
    with open(path, "w") as file:
        for ns, q in zip(at_ns, q_xyzw):
            numbers = " ".join(f"{one:.9f}" for one in q)
            file.write(f"{ns // 10**9}.{ns % 10**9:09d} 0 0 0 {numbers}\n")
