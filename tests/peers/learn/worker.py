"""Runs one simulator and steps it on request; compare.py starts it with that simulator's Python.

    worker.py MAKER VEHICLES CORES

Each line of standard input is a number of seconds to step for. The answer is a line: steps of one vehicle, seconds,
processor seconds of this process and its child processes. The first line describes the simulator.
"""

import json
import os
import sys
import time
import warnings
from pathlib import Path
from typing import Any

MAKER, VEHICLES, CORES = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
# Before any library starts threads: their number follows from the affinity.
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"
warnings.simplefilter("ignore")
# Output of the simulators must not mix with the answers.
ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

import numpy as np  # noqa: E402, as all that starts threads

SIZE_PX = (64, 48)
RANDOM = np.random.default_rng(1)


def small(shape):
    """Returns small random actions that keep a vehicle near its position."""
    return (0.1 * RANDOM.standard_normal(shape)).clip(-1, 1).astype(np.float32)


def many(make, action, async_envs):
    """Makes a Gymnasium vector of single environments: sequential, or one process each."""
    import gymnasium

    kind: Any = gymnasium.vector.AsyncVectorEnv if async_envs else gymnasium.vector.SyncVectorEnv
    envs = kind([make] * VEHICLES)
    envs.reset(seed=1)
    return lambda: envs.step(np.stack([action() for _ in range(VEHICLES)]))


def one(make, action):
    env = make()
    env.reset(seed=1)

    def step():
        *_, terminated, truncated, _ = env.step(action())
        if terminated or truncated:
            env.reset()

    return step


def alone_or_many(make, action, async_envs):
    return one(make, action) if VEHICLES == 1 else many(make, action, async_envs)


def vizflyt(name, layer=None):
    import gymnasium

    how: dict[str, Any] = dict(observation=("state", layer), camera=SIZE_PX) if layer else {}
    name = f"vizflyt.gym:vizflyt/{name}-v0"
    if VEHICLES == 1:
        return one(lambda: gymnasium.make(name, **how), lambda: small(4))
    envs = gymnasium.make_vec(name, num_envs=VEHICLES, **how)
    envs.reset(seed=1)
    return lambda: envs.step(small((VEHICLES, 4)))


def pybullet_drones(act="vel", obs="kin", hz=40, async_envs=False):
    from gym_pybullet_drones.envs.HoverAviary import HoverAviary
    from gym_pybullet_drones.utils.enums import ActionType, ObservationType

    class Hover(HoverAviary):
        """HoverAviary with images of the type declared in its observation space, which vectors require."""

        def _computeObs(self):
            return super()._computeObs().astype(self.observation_space.dtype)

    # In the air, but not at 1 m height, where an episode is over.
    how = dict(initial_xyzs=np.array([[0.0, 0.0, 0.7]]), ctrl_freq=hz, pyb_freq=240)
    make = lambda: Hover(act=ActionType(act), obs=ObservationType(obs), **how)
    return alone_or_many(make, lambda: small((1, 4)), async_envs)


def pyflyt(with_camera=False, async_envs=False):
    from gymnasium import spaces
    from PyFlyt.gym_envs.quadx_envs.quadx_hover_env import QuadXHoverEnv

    class Seeing(QuadXHoverEnv):
        """QuadXHoverEnv with an image of its own camera in each step."""

        observation_space: Any
        state: Any

        def __init__(self, **how):
            super().__init__(**how)
            image = spaces.Box(0, 255, (SIZE_PX[1], SIZE_PX[0], 4), np.uint8)
            self.observation_space = spaces.Dict({"state": self.observation_space, "rgba": image})

        def reset(self, *, seed=None, options=None):
            self.begin_reset(seed, options, dict(use_camera=True, camera_resolution=(SIZE_PX[1], SIZE_PX[0])))
            self.end_reset(seed, options)
            return self.state, self.info

        def compute_state(self):
            super().compute_state()
            self.state = {"state": self.state, "rgba": self.env.drones[0].rgbaImg}

    # Flight mode 6: velocities and a yaw rate.
    make = lambda: (Seeing if with_camera else QuadXHoverEnv)(flight_mode=6, agent_hz=40)
    return alone_or_many(make, lambda: np.append(small(3), 0.0), async_envs)


def crazyflow(dynamics, with_camera=False):
    import jax
    from crazyflow.dynamics import Dynamics
    from crazyflow.envs import ReachVelEnv

    envs = ReachVelEnv(num_envs=VEHICLES, dynamics=Dynamics(dynamics), freq=50)
    envs.reset(seed=1)
    low, high = envs.action_space.low, envs.action_space.high
    hover = np.zeros_like(low)
    # Thrust is last in its attitude actions.
    hover[..., -1] = (low + high)[..., -1] / 2
    fly = lambda: envs.step(hover + small(hover.shape) * (high - hover) * 0.1)[:4]
    if not with_camera:
        return lambda: jax.block_until_ready(fly())
    import mujoco
    from crazyflow.sim.sensors.depth import build_render_depth_fn

    camera = mujoco.mj_name2id(envs.sim.mj_model, mujoco.mjtObj.mjOBJ_CAMERA, "fpv_cam:0")
    depth = build_render_depth_fn(envs.sim.mjx_model, camera, SIZE_PX)
    return lambda: jax.block_until_ready((fly(), depth(envs.sim)))


MAKERS = {
    "vizflyt race": lambda: vizflyt("Race"),
    "vizflyt forest": lambda: vizflyt("Forest"),
    "vizflyt race depth": lambda: vizflyt("Race", "depth"),
    "vizflyt forest depth": lambda: vizflyt("Forest", "depth"),
    "vizflyt race rgb": lambda: vizflyt("Race", "rgb"),
    "vizflyt forest rgb": lambda: vizflyt("Forest", "rgb"),
    "gym-pybullet-drones velocity": pybullet_drones,
    "gym-pybullet-drones velocity async": lambda: pybullet_drones(async_envs=True),
    "gym-pybullet-drones rpm": lambda: pybullet_drones("rpm"),
    "gym-pybullet-drones rpm async": lambda: pybullet_drones("rpm", async_envs=True),
    # It takes images at 24 Hz: at 24 steps a second it renders one image per step.
    "gym-pybullet-drones image": lambda: pybullet_drones(obs="rgb", hz=24),
    "gym-pybullet-drones image async": lambda: pybullet_drones(obs="rgb", hz=24, async_envs=True),
    "pyflyt velocity": pyflyt,
    "pyflyt velocity async": lambda: pyflyt(async_envs=True),
    "pyflyt image": lambda: pyflyt(with_camera=True),
    "pyflyt image async": lambda: pyflyt(with_camera=True, async_envs=True),
    "crazyflow first_principles": lambda: crazyflow("first_principles"),
    "crazyflow so_rpy": lambda: crazyflow("so_rpy"),
    "crazyflow depth": lambda: crazyflow("first_principles", with_camera=True),
}


def processor_s():
    """Returns the processor time of this process and all its running descendants. [s]"""
    parents, spent = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rsplit(")")[-1].split()
        except OSError:
            continue
        parents[int(path.parent.name)] = int(words[1])
        spent[int(path.parent.name)] = int(words[11]) + int(words[12])
    ours, total = {os.getpid()}, 0
    while ours:
        total += sum(spent.pop(pid, 0) for pid in ours)
        ours = {pid for pid, parent in parents.items() if parent in ours and pid in spent}
    return total / os.sysconf("SC_CLK_TCK")


step = MAKERS[MAKER]()
for _ in range(3):
    step()
print(json.dumps({"maker": MAKER, "vehicles": VEHICLES}), file=ANSWERS)
for line in sys.stdin:
    steps, spent_s, begun = 0, processor_s(), time.monotonic()
    while (elapsed_s := time.monotonic() - begun) < float(line):
        step()
        steps += VEHICLES
    print(json.dumps([steps, elapsed_s, processor_s() - spent_s]), file=ANSWERS)
# Exit at once: the shutdown of the simulators is not measured.
ANSWERS.flush()
os._exit(0)
