"""Prints the table of docs/BENCHMARKS.md: steps per second of `vizflyt.gym`, and the processor time of one step.

    pip install vizflyt[gym]
    python tests/python/gym_speed.py
"""

import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import vizflyt.gym

DEPTH: dict[str, Any] = dict(observation=("state", "depth"), camera=(64, 48))
ROWS: list[tuple[str, int, dict[str, Any]]] = [
    ("state", 1, {}),
    ("state", 16, {}),
    ("state, depth 64x48", 16, DEPTH),
    ("state, depth 64x48, every splat", 16, {**DEPTH, "error_px": 0.0}),
    ("state, rgb 64x48", 16, {**DEPTH, "observation": ("state", "rgb")}),
]


def processor_s(envs: Any) -> float:
    """Returns the processor time of the simulating process. [s]"""
    words = Path(f"/proc/{envs.unwrapped._flights._process.pid}/stat").read_text().rsplit(")")[-1].split()
    return (int(words[11]) + int(words[12])) / 100


print(f"vizflyt {vizflyt.__version__}\n")
print("| observation | course | vehicles | steps a second | times real time | processor a step [ms] |")
print("|---|---|---|---|---|---|")
for name in ("Forest", "Race"):
    for observation, number, how in ROWS:
        envs = gymnasium.make_vec(f"vizflyt/{name}-v0", num_envs=number, **how)
        envs.reset(seed=1)
        random = np.random.default_rng(0)
        steps, begun, spent_s = 0, time.monotonic(), processor_s(envs)
        while (elapsed_s := time.monotonic() - begun) < 5.0:
            envs.step(0.3 * random.standard_normal((number, 4)))
            steps += number
        spent_s = (processor_s(envs) - spent_s) / steps
        rate = steps / elapsed_s
        print(f"| {observation} | {name} | {number} | {rate:.0f} | {rate / 40:.0f} | {1e3 * spent_s:.3f} |")
        envs.close()
