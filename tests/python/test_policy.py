"""Live flight of a policy: the guide's plugin computes the gym's state and a network's action, and flies a course."""

import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import vizflyt
import vizflyt.gym

GUIDES = Path(__file__).resolve().parents[2] / "docs" / "guides"


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


plugin = load(GUIDES / "fly_windows.py")


def test_the_network_is_what_a_plain_loop_computes():
    random = np.random.default_rng(1)
    sizes = [(22, 7), (7, 5), (5, 4)]
    values = {"mean": random.normal(size=22), "deviation": random.uniform(0.5, 2, 22)}
    values |= {"seconds": np.array(9.0), "most_change": np.array(0.1)}
    for n, (inputs, outputs) in enumerate(sizes):
        values |= {f"w{n}": random.normal(0, 0.2, (outputs, inputs)), f"b{n}": random.normal(0, 0.2, outputs)}
    policy = plugin.Policy(values)
    assert (policy.seconds, policy.most_change) == (9.0, 0.1)
    for size in (1.0, 100.0):
        state = random.normal(0, size, 22)
        x = [min(max((s - m) / d, -10), 10) for s, m, d in zip(state, values["mean"], values["deviation"])]
        for n in range(3):
            rows = zip(values[f"w{n}"], values[f"b{n}"])
            x = [sum(w * v for w, v in zip(row, x)) + bias for row, bias in rows]
            x = [math.tanh(v) for v in x] if n < 2 else [min(max(v, -1), 1) for v in x]
        assert np.allclose(policy.act(state), x, atol=1e-12)


def test_a_velocity_changes_by_steps_and_stays_within_the_limit():
    asked = np.zeros(3)
    for step in range(40):
        before, asked = asked, plugin.towards(asked, [1.0, -1.0, 1.0], 0.05)
        change = np.linalg.norm(asked - before)
        assert change == pytest.approx(0.05) if step < 20 else change < 1e-9, step
    assert np.allclose(asked, np.array([1, -1, 1]) / math.sqrt(3))
    assert np.allclose(plugin.towards(asked, asked * 0.99, 0.05), asked * 0.99)


def vehicle_of(state):
    """Returns pose and motion of the vehicle behind a state of the gym."""
    sine, cosine = state[18:20]
    world_from_heading = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    up_body = state[3:6] / np.linalg.norm(state[3:6])
    # The nose lies over the heading, and rises by the first number of up.
    level = math.sqrt(1 - up_body[0] ** 2)
    nose, up = np.array([level * cosine, level * sine, up_body[0]]), np.array([0, 0, 1])
    world = np.column_stack([nose, up, np.cross(nose, up)])
    body = np.column_stack([[1, 0, 0], up_body, np.cross([1, 0, 0], up_body)])
    turned = world @ np.linalg.inv(body)
    w = math.sqrt(1 + np.trace(turned)) / 2
    x, y, z = (turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1])
    pose = vizflyt.Pose("world", "body", state[15:18], [x / (4 * w), y / (4 * w), z / (4 * w), w])
    return vizflyt.Vehicle(pose, world_from_heading @ state[0:3], state[6:9], attitude_xyzw=pose.rotation_xyzw)


def window_of(state):
    """Returns centre and direction of the next window in a state of the gym. [m, world]"""
    sine, cosine = state[18:20]
    world_from_heading = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return state[15:18] + world_from_heading @ state[9:12], world_from_heading @ state[12:15]


def test_the_state_is_the_gym_s(program):
    env = vizflyt.gym.Env("p3", courses=[3], rate_hz=20, program=program)
    random = np.random.default_rng(2)
    state, _ = env.reset(seed=1)
    # The position of the first window is constant on the way to it.
    windows = [window_of(state)] * 3
    most_tilted = 0.0
    for step in range(25):
        mine = plugin.state_of(vehicle_of(state.astype(float)), windows, 0, state[21])
        assert np.abs(mine - state).max() < 1e-4, (step, mine - state)
        most_tilted = max(most_tilted, np.abs(state[3:5]).max())
        state, _, is_over, _, _ = env.step(random.uniform(-1, 1, 4))
        assert not is_over, step
    env.close()
    assert most_tilted > 0.1, "it was not level all the time"


@pytest.fixture
def wing(tmp_path):
    """Returns the plugin with a hand-made policy: ahead, and sideways and up to the window's centre."""
    folder = tmp_path / "wing"
    folder.mkdir()
    for name in ("fly_windows.py", "windows.toml"):
        shutil.copy(GUIDES / name, folder)
    weights, bias = np.zeros((4, 22)), np.array([0.2, 0, 0, 0])
    weights[1, 10] = weights[2, 11] = 0.4
    # The nose to the east.
    weights[3, 18] = -1.0
    one = np.ones(22)
    np.savez(folder / "policy.npz", w0=weights, b0=bias, mean=0 * one, deviation=one, seconds=12.0, most_change=0.07)
    return folder


def grade(program, wing, *more):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [
            program, "grade", "fly_windows.py", "--project", "windows.toml", "--seeds", "1", "--first-seed", "1001",
            "--json", "--keys", "keys", *more,
        ],
        cwd=wing, env=os.environ | {"PATH": path}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


def test_a_policy_flies_through_the_windows_that_the_map_tells(program, wing):
    graded, _ = grade(program, wing)
    run = graded["runs"][0]
    assert (run["outcome"], run["stages_passed"]) == ("finished", 3), run


def test_the_windows_found_are_those_that_the_gym_flies_to(program, wing):
    """The plugin fails on purpose, and reports the windows it found in its last message."""
    code = (wing / "fly_windows.py").read_text()
    found = 'self.windows = windows_of(json.loads(os.environ["VIZFLYT_MAP"]))'
    assert found in code
    tell = "; raise ValueError(' '.join(f'{v:.3f}' for pair in self.windows for v in [*pair[0], *pair[1]]))"
    (wing / "fly_windows.py").write_text(code.replace(found, found + tell))
    _, said = grade(program, wing)
    numbers = re.search(r"ValueError: ((?:-?\d+\.\d+ ?)+)", said)[1].split()
    env = vizflyt.gym.Env("p3", courses=[1001], rate_hz=20, program=program)
    state, _ = env.reset(seed=1)
    env.close()
    assert len(numbers) == 18
    assert np.allclose([float(number) for number in numbers[:6]], np.concatenate(window_of(state)), atol=2e-3)
