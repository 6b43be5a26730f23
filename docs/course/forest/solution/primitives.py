"""Candidate paths from the current state, and the choice of the best one. Without images, without vizflyt.

Each path is two velocities, one after the other, simulated with the lag and the acceleration of this vehicle. Sampled
and scored by clearance and progress at every image, like the expert of A. Loquercio, E. Kaufmann, R. Ranftl, M.
Mueller, V. Koltun and D. Scaramuzza, "Learning high-speed flight in the wild" (Science Robotics 6, 2021), which uses
the true map; this one uses the observed map. A fixed fan of paths: J. Zhang, C. Hu, R. Chadha and S. Singh, "Falco:
fast likelihood-based collision avoidance with extension to human-guided navigation" (Journal of Field Robotics 37,
2020).
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
# --- the choice
TOUCH_M = 0.1  # clearance for the errors of cell and pose
WANTED_M = 0.55  # desired clearance; the narrowest gap of 1.6 m leaves 0.68
NEAR_MPS = 4.0  # penalty of a path with low clearance everywhere, as a speed
HIT_MPS = 100.0
CHANGE = 0.06  # penalty of a change of velocity, per m/s
ARRIVED_M = 0.8  # distance to the goal


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
    speed_mps = min(math.hypot(*motion.asked_mps), most_mps)
    speeds_mps = (most_mps, *(share * max(speed_mps, 1.0) for share in SHARES))
    first, second, switch_s = fan(math.atan2(to_goal_m[1], to_goal_m[0]), speeds_mps)
    ways = fly_ahead(motion, first, second, switch_s)
    left_m = length(ways - goal_m)[..., 0]
    arrived = np.logical_or.accumulate(left_m < ARRIVED_M, axis=0)
    room = np.where(arrived, np.inf, room_m(ways))  # nothing counts behind the goal
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
    # If no path is free: the one that collides last and at the lowest speed.
    until = np.where(hit, hits.argmax(axis=0), STEPS)
    score = np.where(hit, -HIT_MPS * (2.0 - until / STEPS) - length(second)[:, 0], score)
    chosen = score.argmax()
    return first[chosen], ways[:, chosen]
