"""Project 5: the turning hand: its angle, its speed, and the times at which a point is free. Work in this file.

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
    # To do: for now as if the camera were in the axle and looked along the normal.
    return np.stack([-rays[:, 1], rays[:, 2]], axis=1)


def angle_rad(points_m: F64) -> float:
    """Returns the hand's angle from points (N, 2) on it, in the direction from the axle to the free end."""
    # To do: for now the angle of one point.
    return float(np.arctan2(points_m[0, 1], points_m[0, 0]))


def follow(at_s: F64, theta_rad: F64) -> Turning:
    """Returns the rotation by (1), from two or more angles (N,) in [-pi, pi) at times (N,) in their order.

    Between two angles the hand turns by less than half a turn.
    """
    # To do: for now from the first to the last angle, without unwrapping.
    omega_radps = (theta_rad[-1] - theta_rad[0]) / (at_s[-1] - at_s[0])
    return Turning(float(at_s[0]), float(theta_rad[0]), float(omega_radps))


def sigma_omega_radps(sigma_theta_rad: float, count: int, seconds: float) -> float:
    """Returns the standard deviation of omega by (2), from `count` angles with `sigma_theta_rad` over `seconds`."""
    # To do: for now infinite.
    return float("inf")


def blocked_rad(rho_m: float, room_m: float) -> float:
    """Returns beta of (3): angles between hand and point below this are blocked, on either side.

    The point is `rho_m` from the axle, and needs the distance `room_m` from the hand's middle line: r + w + m. Beyond
    the hand's length, its free end is nearest. Pi: always blocked; 0: never.
    """
    # To do: for now always blocked.
    return float(np.pi)


def is_away(turning: Turning, place_m: F64, room_m: float, from_s: float, to_s: float) -> bool:
    """Returns whether the hand does not block a point (2,) at any time from `from_s` to `to_s`."""
    # To do: for now always False.
    return False


def start_s(
    turning: Turning, place_m: F64, room_m: float, now_s: float, takes_s: float, early_s: float, late_s: float
) -> float | None:
    """Returns the earliest time to start, not before now; None if there is none within one turn of the hand.

    `takes_s` after its start the vehicle is in the hand's plane, at most `early_s` sooner or `late_s` later.
    """
    # To do: for now never.
    return None
