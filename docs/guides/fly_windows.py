"""Flies through windows by the policy that learn_windows.py has learnt: its network in numpy, its state from the pose.

python learn_windows.py --export wing              writes wing/policy.npz, and this plugin and its project beside it
vizflyt grade wing/fly_windows.py --project wing/windows.toml
"""

import json
import math
import os
from pathlib import Path

import numpy as np

import vizflyt
from vizflyt import Setpoint

# As an action of `vizflyt.gym` asks for it. [rad/s]
YAW_RATE_RADPS = 2.0


class Policy:
    """A network of tanh layers, its input scaled; `policy.npz` holds w0, b0, w1, ..., and what is read here."""

    def __init__(self, values):
        count = sum(name.startswith("w") for name in values)
        self.layers = [(values[f"w{n}"], values[f"b{n}"]) for n in range(count)]
        self.mean, self.deviation = values["mean"], values["deviation"]
        self.seconds, self.most_change = float(values["seconds"]), float(values["most_change"])

    def act(self, state):
        """Returns the action, shape (4,), from -1 to 1, for a state, shape (22,)."""
        x = np.clip((state - self.mean) / self.deviation, -10.0, 10.0)
        for weights, bias in self.layers[:-1]:
            x = np.tanh(weights @ x + bias)
        weights, bias = self.layers[-1]
        return np.clip(weights @ x + bias, -1.0, 1.0)


def towards(asked, wish, most):
    """Returns a velocity asked for, shape (3,), moved by at most `most` to the one wished for, within length 1."""
    wish = np.asarray(wish) / max(np.linalg.norm(wish), 1.0)
    change = wish - asked
    return asked + change * min(most / max(np.linalg.norm(change), 1e-9), 1.0)


def rotation(quaternion):
    """Returns the matrix, 3 x 3, of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def windows_of(volumes):
    """Finds windows in a course's map: where a bar lies straight above another of its size.

    volumes: as `VIZFLYT_MAP` lists them. Returns (middle, direction of passage) of each in the order of the flight,
    along x. [m, world]
    """
    bars = []
    for box in (volume["cuboid"] for volume in volumes if "cuboid" in volume):
        # A bar is wider than it is high, and higher than it is deep.
        depth, width, height = box["half_m"]
        if width > height > depth:
            bars.append((np.array(box["center_m"]), np.array(box["half_m"]), rotation(box["rotation"])[:, 0]))
    windows = []
    for upper_m, size_m, normal in bars:
        for lower_m, other_m, _ in bars:
            is_below = np.allclose(upper_m[:2], lower_m[:2], atol=1e-6) and upper_m[2] > lower_m[2]
            if is_below and np.allclose(size_m, other_m, atol=1e-6):
                windows.append(((upper_m + lower_m) / 2, normal))
    return sorted(windows, key=lambda window: window[0][0])


def state_of(vehicle, windows, passed, time_left):
    """Returns the state that `vizflyt.gym` explains, shape (22,), of a vehicle whose pose is known.

    windows: (middle, direction) of each [m, world]; passed: how many lie behind; time_left: its share, from 1 to 0.
    """
    yaw_rad = vehicle.yaw_rad
    sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
    heading_from_world = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    p_m = vehicle.p_world_m
    way_m = normal = np.zeros(3)
    if passed < len(windows):
        middle_m, normal = windows[passed]
        way_m = middle_m - p_m
    return np.concatenate([
        heading_from_world @ vehicle.v_world_mps,
        # The world's z, as the body sees it.
        rotation(vehicle.attitude_xyzw)[2],
        vehicle.omega_body_radps,
        heading_from_world @ way_m,
        heading_from_world @ normal,
        p_m,
        [sine, cosine, len(windows) - passed, time_left],
    ])  # fmt: skip


class Windows(vizflyt.Plugin):
    def on_start(self, info):
        with np.load(Path(__file__).with_name("policy.npz")) as values:
            self.policy = Policy(dict(values))
        self.windows = windows_of(json.loads(os.environ["VIZFLYT_MAP"]))
        self.speed_mps = info.limits.max_speed_mps
        self.passed, self.is_flying, self.began_ns = 0, False, None
        self.asked = np.zeros(3)

    def on_event(self, event):
        if event.kind == "stage":
            self.passed = event.details["index"] + 1
        elif event.kind == "phase":
            self.is_flying = event.details["phase"] == "flying"

    def on_image(self, obs):
        vehicle = obs.vehicle
        # Images come from the ground on: an episode begins where the runtime has climbed to.
        if vehicle is None or not self.is_flying:
            return Setpoint.hold()
        self.began_ns = self.began_ns or vehicle.stamp_ns
        time_left = max(1.0 - (vehicle.stamp_ns - self.began_ns) * 1e-9 / self.policy.seconds, 0.0)
        state = state_of(vehicle, self.windows, self.passed, time_left)
        action = self.policy.act(state)
        # Shares of the course's speed, changed as slowly as the policy has learnt with.
        self.asked = towards(self.asked, action[:3], self.policy.most_change)
        return Setpoint.velocity(self.asked * self.speed_mps, axes="heading", yaw_rate=action[3] * YAW_RATE_RADPS)


if __name__ == "__main__":
    vizflyt.run(Windows)
