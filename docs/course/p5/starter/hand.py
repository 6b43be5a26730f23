"""Project 5: the hand that turns: its angle, its speed, and when a place is free of it. Yours to fill in.

In the hand's plane a point is (right, up) of the axle [m], as one sees it who flies through; angles count from right
towards up [rad].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# From the axle to its free end, and half its width. [m]
LENGTH_M, HALF_WIDTH_M = 0.95, 0.035


class Turning(NamedTuple):
    """An even turning: theta(t) = theta_rad + omega_radps (t - at_s)."""

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
    """Returns where rays meet the hand's plane, (N, 2) [m].

    `rays` (N, 3) begin in the camera, in level axes: x ahead, y left, z up. In these is the axle, (3,) [m]. The plane
    stands upright; one flies through it in the direction `facing_rad`, from x towards y. No ray is along the plane.
    """
    # So far: as if the camera were in the axle and looked along the normal.
    return np.stack([-rays[:, 1], rays[:, 2]], axis=1)


def angle_rad(points_m: F64) -> float:
    """Returns the hand's angle from points (N, 2) on it: it points from the axle to where it is free."""
    # So far: of one of them.
    return float(np.arctan2(points_m[0, 1], points_m[0, 0]))


def follow(at_s: F64, theta_rad: F64) -> Turning:
    """Returns the turning by (1), from two or more angles (N,) in [-pi, pi) at times (N,) in their order.

    Between two of them it turns by less than half a turn.
    """
    # So far: from the first to the last, as they come.
    omega_radps = (theta_rad[-1] - theta_rad[0]) / (at_s[-1] - at_s[0])
    return Turning(float(at_s[0]), float(theta_rad[0]), float(omega_radps))


def sigma_omega_radps(sigma_theta_rad: float, count: int, seconds: float) -> float:
    """Returns how well omega is known by (2): from `count` angles with `sigma_theta_rad`, evenly over `seconds`."""
    # So far: nothing is known.
    return float("inf")


def blocked_rad(rho_m: float, room_m: float) -> float:
    """Returns beta of (3): how near in angle the hand's direction is to that of a place it blocks, to either side.

    The place is `rho_m` from the axle, and has to be `room_m` from the hand's middle line: r + w + m. Beyond the
    hand's length its free end is what is near. Pi: it is always blocked; 0: never.
    """
    # So far: it is always blocked.
    return float(np.pi)


def is_away(turning: Turning, place_m: F64, room_m: float, from_s: float, to_s: float) -> bool:
    """Whether the hand does not block a place (2,) at any time from `from_s` to `to_s`."""
    # So far: never sure.
    return False


def start_s(
    turning: Turning, place_m: F64, room_m: float, now_s: float, takes_s: float, early_s: float, late_s: float
) -> float | None:
    """Returns when to start at the earliest, not before now; None if not within one turn of the hand.

    `takes_s` after its start the vehicle is in the hand's plane, `early_s` sooner or `late_s` later.
    """
    # So far: never.
    return None
