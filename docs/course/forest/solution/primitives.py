"""Ways that the vehicle can fly from here, and which is the best. No images in it, no vizflyt.

Each way is two velocities, one after the other, flown ahead in the mind with the lag and the acceleration of this
vehicle. Sampled and scored by clearance and progress at every image, as the expert does of A. Loquercio, E. Kaufmann,
R. Ranftl, M. Mueller, V. Koltun and D. Scaramuzza, "Learning high-speed flight in the wild" (Science Robotics 6, 2021),
there on the true map, here on the seen one. A fixed fan of ways: J. Zhang, C. Hu, R. Chadha and S. Singh, "Falco: fast
likelihood-based collision avoidance with extension to human-guided navigation" (Journal of Field Robotics 37, 2020).
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
# --- the choice
TOUCH_M = 0.1  # beside the body: what a cell and a pose are off by
WANTED_M = 0.55  # room beside the body; the narrowest gap of 1.6 m leaves 0.68
NEAR_MPS = 4.0  # speed given up for not touching, on a way that is near all the time
HIT_MPS = 100.0
CHANGE = 0.06  # speed given up for going on as before, per m/s of change
ARRIVED_M = 0.8  # from the goal


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
    speed_mps = min(math.hypot(*motion.asked_mps), most_mps)
    speeds_mps = (most_mps, *(share * max(speed_mps, 1.0) for share in SHARES))
    first, second, switch_s = fan(math.atan2(to_goal_m[1], to_goal_m[0]), speeds_mps)
    ways = fly_ahead(motion, first, second, switch_s)
    left_m = length(ways - goal_m)[..., 0]
    arrived = np.logical_or.accumulate(left_m < ARRIVED_M, axis=0)
    room = np.where(arrived, np.inf, room_m(ways))  # behind the goal nothing counts
    hits = room < TOUCH_M
    hit = hits.any(axis=0)
    spare_s = arrived.sum(axis=0) * STEP_S
    gained_m = math.hypot(*to_goal_m) - np.maximum(left_m.min(axis=0), ARRIVED_M) + spare_s * most_mps
    near = np.square(np.maximum(1.0 - room / WANTED_M, 0.0))
    score = (
        gained_m / (STEPS * STEP_S)
        - NEAR_MPS * (near.max(axis=0) + near.mean(axis=0))
        - CHANGE * length(first - motion.asked_mps)[:, 0]
    )
    # Where nothing is free: what hits last, and slowest.
    until = np.where(hit, hits.argmax(axis=0), STEPS)
    score = np.where(hit, -HIT_MPS * (2.0 - until / STEPS) - length(second)[:, 0], score)
    chosen = score.argmax()
    return first[chosen], ways[:, chosen]
