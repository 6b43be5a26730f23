"""Project 5: the turning hand: its angle, its speed, and the times at which a point is free.

In the hand's plane a point is (right, up) relative to the axle [m], in the direction of passage; angles count from
right towards up [rad].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# Distance from the axle to the free end, and half of the width. [m]
LENGTH_M, HALF_WIDTH_M = 0.95, 0.035
# Step of the search for a start. [s]
STEP_S = 0.02


class Turning(NamedTuple):
    """A uniform rotation: theta(t) = theta_rad + omega_radps (t - at_s)."""

    at_s: float
    theta_rad: float
    omega_radps: float

    def at(self, t_s: float) -> float:
        """Returns the angle at a time [s], not wrapped. [rad]"""
        return self.theta_rad + self.omega_radps * (t_s - self.at_s)


def wrapped(angle_rad: float) -> float:
    """Returns an angle in [-pi, pi). [rad]"""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def in_plane(rays: F64, axle_m: F64, facing_rad: float) -> F64:
    """Returns the intersections of rays with the hand's plane, (N, 2) [m].

    `rays` (N, 3) begin at the camera, in level axes: x forward, y left, z up, like the axle (3,) [m]. The plane is
    vertical; the direction of passage is `facing_rad`, from x towards y. No ray is parallel to the plane.
    """
    normal = np.array([np.cos(facing_rad), np.sin(facing_rad), 0.0])
    right = np.array([np.sin(facing_rad), -np.cos(facing_rad), 0.0])
    off_m = rays * (normal @ axle_m / (rays @ normal))[:, None] - axle_m
    return np.stack([off_m @ right, off_m[:, 2]], axis=1)


def angle_rad(points_m: F64) -> float:
    """Returns the hand's angle from points (N, 2) on it, in the direction from the axle to the free end."""
    right_m, up_m = points_m.mean(axis=0)
    return float(np.arctan2(up_m, right_m))


def follow(at_s: F64, theta_rad: F64) -> Turning:
    """Returns the rotation by (1), from two or more angles (N,) in [-pi, pi) at times (N,) in their order.

    Between two angles the hand turns by less than half a turn.
    """
    unwrapped = theta_rad[0] + np.concatenate([[0.0], np.cumsum([wrapped(step) for step in np.diff(theta_rad)])])
    middle_s, middle_rad = at_s.mean(), unwrapped.mean()
    since_s = at_s - middle_s
    omega_radps = since_s @ (unwrapped - middle_rad) / (since_s @ since_s)
    return Turning(float(middle_s), float(middle_rad), float(omega_radps))


def sigma_omega_radps(sigma_theta_rad: float, count: int, seconds: float) -> float:
    """Returns the standard deviation of omega by (2), from `count` angles with `sigma_theta_rad` over `seconds`."""
    return float(sigma_theta_rad * np.sqrt(12.0 / count) / seconds)


def blocked_rad(rho_m: float, room_m: float) -> float:
    """Returns beta of (3): angles between hand and point below this are blocked, on either side.

    The point is `rho_m` from the axle, and needs the distance `room_m` from the hand's middle line: r + w + m. Beyond
    the hand's length, its free end is nearest. Pi: always blocked; 0: never.
    """
    if rho_m <= room_m:
        return float(np.pi)
    if rho_m <= LENGTH_M:
        return float(np.arcsin(room_m / rho_m))
    if rho_m >= LENGTH_M + room_m:
        return 0.0
    # Three sides of a triangle: axle, free end, point.
    return float(np.arccos((rho_m**2 + LENGTH_M**2 - room_m**2) / (2 * rho_m * LENGTH_M)))


def is_away(turning: Turning, place_m: F64, room_m: float, from_s: float, to_s: float) -> bool:
    """Returns whether the hand does not block a point (2,) at any time from `from_s` to `to_s`."""
    beta_rad = blocked_rad(float(np.hypot(*place_m)), room_m)
    if beta_rad == 0.0:
        return True
    swept_rad = abs(turning.omega_radps) * (to_s - from_s) / 2
    off_rad = abs(wrapped(np.arctan2(place_m[1], place_m[0]) - turning.at((from_s + to_s) / 2)))
    return bool(off_rad > beta_rad + swept_rad)


def start_s(
    turning: Turning, place_m: F64, room_m: float, now_s: float, takes_s: float, early_s: float, late_s: float
) -> float | None:
    """Returns the earliest time to start, not before now; None if there is none within one turn of the hand.

    `takes_s` after its start the vehicle is in the hand's plane, at most `early_s` sooner or `late_s` later.
    """
    for start in np.arange(now_s, now_s + 2 * np.pi / abs(turning.omega_radps), STEP_S):
        there_s = start + takes_s
        if is_away(turning, place_m, room_m, there_s - early_s, there_s + late_s):
            return float(start)
    return None
