"""Ways that the vehicle can fly from here, and which is the best. No images in it, no vizflyt.

Each way is two velocities, one after the other, flown ahead in the mind with the lag and the acceleration of this
vehicle. The vehicle and its ways are given; the choice is yours.
"""

import math
from dataclasses import dataclass

import numpy as np

# --- the vehicle: hardware/airframe (WP_ACC 5, PSC_JERK_NE 20), as its autopilot shapes a velocity
ACCELERATION_MPS2 = 5.0
JERK_MPS3 = 20.0
RATE_PER_S = JERK_MPS3 / ACCELERATION_MPS2
LAG_S = 0.2  # of tilt and against drag, fitted to logs of flights
GAIN_MPS2 = 2.5  # what the guard lets through: it counts on a slower vehicle than this one, unless that slows down
# --- the fan
FIRST_DEG = np.arange(-60.0, 61.0, 6.0)
SECOND_DEG = np.arange(-50.0, 51.0, 10.0)
SWITCH_S = (0.4, 0.9)
SHARES = (0.97, 0.75, 0.5, 0.25)  # of the speed asked for now; beside these the greatest
STEP_S = 0.1
STEPS = 20
# --- until there is a choice
SLOW_MPS = 1.0


@dataclass
class Motion:
    """The vehicle as it is planned with: arrays of shape (..., 2), from above. [world]"""

    p_m: np.ndarray
    v_mps: np.ndarray
    asked_mps: np.ndarray  # what the guard has let through of what was asked
    shaped_mps: np.ndarray  # what the autopilot makes of that
    a_mps2: np.ndarray

    @classmethod
    def seen(cls, p_m, v_mps, a_mps2):
        """Makes it of what is measured, all (2,): what is asked for is flown after the shaping and the lag."""
        return cls(p_m, v_mps, v_mps + (LAG_S + 1 / RATE_PER_S) * a_mps2, v_mps + LAG_S * a_mps2, a_mps2)

    def after(self, wanted_mps, dt_s):
        """Returns the motion `dt_s` later, where `wanted_mps` (..., 2) is asked for."""
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
    """Returns vectors (..., 2), none longer than `most`."""
    return vector * np.minimum(1.0, most / np.maximum(length(vector), 1e-9))


def fan(towards_rad, speeds_mps):
    """Returns pairs of velocities about the direction to the goal, as two arrays (K, 2) [m/s, world], and when the
    second follows the first (K,) [s]."""
    first, second, switch_s, speed_mps = np.meshgrid(
        np.radians(FIRST_DEG), np.radians(SECOND_DEG), SWITCH_S, speeds_mps, indexing="ij"
    )

    def velocity(angle):
        angle = towards_rad + angle.ravel()
        return speed_mps.ravel()[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    return velocity(first), velocity(second), switch_s.ravel()


def fly_ahead(motion, first_mps, second_mps, switch_s):
    """Returns the ways (STEPS, K, 2) that the velocities of `fan` lead to. [m, world]"""
    at = Motion(*(np.broadcast_to(x, first_mps.shape) for x in vars(motion).values()))
    ways = np.empty((STEPS, *first_mps.shape))
    for step in range(STEPS):
        is_first = step * STEP_S < switch_s[:, None] - 1e-9
        at = at.after(np.where(is_first, first_mps, second_mps), STEP_S)
        ways[step] = at.p_m
    return ways


def best(motion, goal_m, most_mps, room_m):
    """Returns the velocity (2,) to ask for now [m/s, world], and the way (STEPS, 2) that it begins [m, world].

    `room_m(p_m)` gives the room beside the body at points (..., 2) [m]; `goal_m` is (2,) [m, world].
    """
    to_goal_m = goal_m - motion.p_m
    # Yours: the fan, the ways, the room on each, how far each leads. So far it goes straight, and slowly.
    velocity_mps = to_goal_m / max(math.hypot(*to_goal_m), 1e-9) * min(SLOW_MPS, most_mps)
    return velocity_mps, motion.p_m + np.outer(np.arange(1, STEPS + 1) * STEP_S, velocity_mps)
