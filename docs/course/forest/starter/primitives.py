"""Candidate paths from the current state, and the choice of the best one. Without images, without vizflyt.

Each path is two velocities, one after the other, simulated with the lag and the acceleration of this vehicle. The
vehicle and its paths are given; implement the choice.
"""

import math
from dataclasses import dataclass

import numpy as np

# --- the vehicle: hardware/airframe (WP_ACC 5, PSC_JERK_NE 20), with the autopilot's shaping of velocities
ACCELERATION_MPS2 = 5.0
JERK_MPS3 = 20.0
RATE_PER_S = JERK_MPS3 / ACCELERATION_MPS2
LAG_S = 0.2  # of tilt and drag, fitted to flight logs
GAIN_MPS2 = 2.5  # acceleration that the guard allows, because it assumes a slower vehicle; deceleration is free
# --- the fan
FIRST_DEG = np.arange(-60.0, 61.0, 6.0)
SECOND_DEG = np.arange(-50.0, 51.0, 10.0)
SWITCH_S = (0.4, 0.9)
SHARES = (0.97, 0.75, 0.5, 0.25)  # fractions of the current setpoint's speed, in addition to the maximum
STEP_S = 0.1
STEPS = 20
# --- until the choice is implemented
SLOW_MPS = 1.0


@dataclass
class Motion:
    """Planning state of the vehicle: arrays of shape (..., 2), from above. [world]"""

    p_m: np.ndarray
    v_mps: np.ndarray
    asked_mps: np.ndarray  # setpoint after the guard
    shaped_mps: np.ndarray  # setpoint after the autopilot's shaping
    a_mps2: np.ndarray

    @classmethod
    def seen(cls, p_m, v_mps, a_mps2):
        """Creates the state from measurements (2,): the velocity follows the setpoint after the shaping and the lag."""
        return cls(p_m, v_mps, v_mps + (LAG_S + 1 / RATE_PER_S) * a_mps2, v_mps + LAG_S * a_mps2, a_mps2)

    def after(self, wanted_mps, dt_s):
        """Returns the motion after `dt_s` with the setpoint `wanted_mps` (..., 2)."""
        slows = length(wanted_mps) < length(self.asked_mps)
        most_mps2 = np.where(slows, ACCELERATION_MPS2, GAIN_MPS2)
        asked = self.asked_mps + shortened(wanted_mps - self.asked_mps, most_mps2 * dt_s)
        wanted_mps2 = shortened((asked - self.shaped_mps) * RATE_PER_S, ACCELERATION_MPS2)
        a = self.a_mps2 + shortened(wanted_mps2 - self.a_mps2, JERK_MPS3 * dt_s)
        shaped = self.shaped_mps + a * dt_s
        v = self.v_mps + (shaped - self.v_mps) * (dt_s / (LAG_S + dt_s))
        return Motion(self.p_m + (self.v_mps + v) * (0.5 * dt_s), v, asked, shaped, a)


def length(vector):
    """Returns the lengths of vectors (..., 2): shape (..., 1)."""
    return np.sqrt(np.einsum("...i,...i", vector, vector))[..., None]


def shortened(vector, most):
    """Returns vectors (..., 2), shortened to at most `most`."""
    return vector * np.minimum(1.0, most / np.maximum(length(vector), 1e-9))


def fan(towards_rad, speeds_mps):
    """Returns pairs of velocities around the direction to the goal, as two arrays (K, 2) [m/s, world], and the time of
    the switch from first to second (K,) [s]."""
    first, second, switch_s, speed_mps = np.meshgrid(
        np.radians(FIRST_DEG), np.radians(SECOND_DEG), SWITCH_S, speeds_mps, indexing="ij"
    )

    def velocity(angle):
        angle = towards_rad + angle.ravel()
        return speed_mps.ravel()[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    return velocity(first), velocity(second), switch_s.ravel()


def fly_ahead(motion, first_mps, second_mps, switch_s):
    """Returns the paths (STEPS, K, 2) of the velocities of `fan`. [m, world]"""
    at = Motion(*(np.broadcast_to(x, first_mps.shape) for x in vars(motion).values()))
    ways = np.empty((STEPS, *first_mps.shape))
    for step in range(STEPS):
        is_first = step * STEP_S < switch_s[:, None] - 1e-9
        at = at.after(np.where(is_first, first_mps, second_mps), STEP_S)
        ways[step] = at.p_m
    return ways


def best(motion, goal_m, most_mps, room_m):
    """Returns the best velocity (2,) for now [m/s, world], and its path (STEPS, 2) [m, world].

    `room_m(p_m)` returns the clearance beside the body at points (..., 2) [m]; `goal_m` is (2,) [m, world].
    """
    to_goal_m = goal_m - motion.p_m
    # To do: the fan, the paths, the clearance and the progress of each. For now it flies straight and slowly.
    velocity_mps = to_goal_m / max(math.hypot(*to_goal_m), 1e-9) * min(SLOW_MPS, most_mps)
    return velocity_mps, motion.p_m + np.outer(np.arange(1, STEPS + 1) * STEP_S, velocity_mps)
