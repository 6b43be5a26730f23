"""Courses as reinforcement-learning environments: Gymnasium's API for many simulated vehicles on a virtual clock.

    import gymnasium, vizflyt.gym                                          # needs Gymnasium
    env = gymnasium.make("vizflyt/Forest-v0")                              # the state
    envs = gymnasium.make_vec("vizflyt/Race-v0", num_envs=16, camera=(64, 48), observation=("state", "depth"))

``"vizflyt.gym:vizflyt/Forest-v0"`` imports this module if necessary, for example in the processes of Ray's RLlib.

The simulated airframe flies under the controllers of the simulated autopilot, with the true state. Openings, obstacles
and fence are judged as in a graded flight. There is no estimator, no guard, and no delay except ``delay``. The same
seeds and actions give the same observations, bit for bit, on the same kind of processor.

``state`` has 22 numbers: velocity (3, [m/s, heading]), the world's up direction (3, [body]), angular velocity (3,
[rad/s, body]), vector to the next stage or the goal (3, [m, heading]), direction in which to pass it (3, 0 for a goal),
position (3, [m, world]), sine and cosine of the heading, remaining stages and goal, remaining fraction of the time.
Heading axes: x along the nose, y left, z up. ``depth`` is height x width, float32: 0 at the camera, 1 at ``far_m`` and
without a return. ``rgb`` is height x width x 3, uint8.

An action has four numbers from -1 to 1. ``velocity`` and ``acceleration``: forward, left and up as fractions of the
course's limit, and a turn to the left, where 1 is 2 rad/s. ``body-rates``: roll, pitch and yaw, where 1 is 6, 6 and 3
rad/s, and thrust, where -1 is zero, 0 the weight and 1 twice the weight.

An episode ends with a contact, outside the fence or at the finish (terminated), or after ``seconds`` (truncated).

Keywords of both classes: ``project`` (a name or a FILE.toml), ``courses`` (seeds; the seed of an episode chooses one),
``action``, ``observation`` (one of state, depth, rgb, or several as a ``Dict``), ``camera`` (width, height),
``fov_deg``, ``far_m``, ``error_px`` (maximum position error of rendered splats; 0 is exact but slower), ``rate_hz``,
``delay`` (steps until an action takes effect), ``seconds``, ``variant`` (light and weather), ``reward`` (function of a
`Step`), ``program``.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("vizflyt.gym needs Gymnasium: pip install gymnasium") from error

FLYING, CRASHED, LEFT_FENCE, FINISHED, TIME_UP = range(5)
_ENDS = ("flying", "crashed", "left the fence", "finished", "time is up")
_ACTION, _STATE, _FIGURES = 4, 22, 4


@dataclass(frozen=True)
class Step:
    """Input of a reward function, with one entry for each environment."""

    progress_m: np.ndarray
    """Decrease of the distance to the target of the previous step. [m]"""
    passed: np.ndarray
    """Stages passed in this step."""
    clearance_m: np.ndarray
    """Distance from the body's surface to the nearest obstacle, at most 10. [m]"""
    end: np.ndarray
    """FLYING, CRASHED, LEFT_FENCE, FINISHED or TIME_UP."""
    time_s: np.ndarray
    """Time since the start of the episode. [s]"""
    action: np.ndarray
    """N x 4."""
    state: np.ndarray
    """N x 22."""


def default_reward(step: Step) -> np.ndarray:
    """Rewards: 2 for each metre closer, 5 for a stage, 10 for the finish, -4 for a crash or the fence, -0.02 a step."""
    lost = (step.end == CRASHED) | (step.end == LEFT_FENCE)
    return 2.0 * step.progress_m + 5.0 * step.passed + 10.0 * (step.end == FINISHED) - 4.0 * lost - 0.02


def _program() -> str:
    """Returns the program that pip installed with this Python, otherwise the one on PATH."""
    beside = Path(sys.executable).with_name("vizflyt")
    found = str(beside) if beside.exists() else shutil.which("vizflyt")
    if found is None:
        raise FileNotFoundError("the program vizflyt is neither next to this Python nor on PATH; give program=")
    return found


class _Flights:
    """`vizflyt gym`: vehicles that fly in a separate process."""

    def __init__(
        self,
        *,
        count: int,
        project: str,
        courses: Sequence[int] = (1,),
        action: str = "velocity",
        observation: str | Sequence[str] = "state",
        camera: tuple[int, int] | None = None,
        fov_deg: float | None = None,
        far_m: float = 10.0,
        error_px: float = 0.7,
        rate_hz: int = 40,
        delay: int = 0,
        seconds: float = 30.0,
        variant: str = "day",
        reward: Callable[[Step], np.ndarray] | None = None,
        program: str | None = None,
    ) -> None:
        self.count = count
        self.far_m = far_m
        self.reward = reward or default_reward
        self.parts = (observation,) if isinstance(observation, str) else tuple(observation)
        layers = [part for part in self.parts if part != "state"]
        if unknown := set(layers) - {"depth", "rgb"} or (set() if self.parts else {"nothing"}):
            raise ValueError(f"observation: {sorted(unknown)}; give one or several of state, depth, rgb")
        if layers and camera is None:
            raise ValueError(f"observation {layers} needs a camera; give camera=(width, height)")
        command = [
            program or _program(), "gym", "--project", project, "--envs", str(count), "--action", action,
            "--courses", ",".join(map(str, courses)), "--rate", str(rate_hz), "--delay", str(delay),
            "--seconds", str(seconds), "--variant", variant,
        ]  # fmt: skip
        if layers and camera is not None:
            command += ["--camera", f"{camera[0]}x{camera[1]}", "--layers", ",".join(layers)]
            command += ["--error-px", str(error_px)]
            command += [] if fov_deg is None else ["--fov", str(fov_deg)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        head = bytearray()
        while not head.endswith(b"\n"):
            byte = self._out.read(1)
            if not byte:
                self.close()
                raise RuntimeError(f"vizflyt gym ended with status {self._process.wait()}; see its error above")
            head += byte
        self.about = json.loads(head)
        if (self.about["action"], self.about["state"], self.about["figures"]) != (_ACTION, _STATE, _FIGURES):
            raise RuntimeError(f"{command[0]} is of another version than this package; install both from one wheel")
        height, width = self.about["image"] or (0, 0)
        self._order = np.zeros(count * (1 + 8 + 4 * _ACTION), np.uint8)
        self._resets, seeds, actions = np.split(self._order, [count, 9 * count])
        # Misaligned, so written as bytes.
        self._seeds, self._actions = seeds, actions
        lengths = {"state": 4 * _STATE, "figures": 4 * _FIGURES, "end": 1}
        lengths |= {"depth": 2 * height * width} if self.about["depth"] else {}
        lengths |= {"rgb": 3 * height * width} if self.about["rgb"] else {}
        self._ranges, end = {}, 0
        for name, length in lengths.items():
            self._ranges[name] = slice(end, end + count * length)
            end += count * length
        self._answer = bytearray(end)
        self._shape = (count, height, width)
        self._passed = np.zeros(count)
        spaces_of: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(-np.inf, np.inf, (_STATE,), np.float32),
            "depth": spaces.Box(0.0, 1.0, (height, width), np.float32),
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
        }
        chosen = {part: spaces_of[part] for part in self.parts}
        self.observation_space: spaces.Space[Any] = spaces.Dict(chosen)
        if len(chosen) == 1:
            self.observation_space = chosen[self.parts[0]]
        self.action_space = spaces.Box(-1.0, 1.0, (_ACTION,), np.float32)

    @property
    def _out(self) -> Any:
        return self._process.stdout

    def fly(self, resets: np.ndarray, seeds: np.ndarray, actions: np.ndarray) -> tuple[Any, Step]:
        """Starts episodes or flies one step; returns all observations, and the input of rewards."""
        self._resets[:] = resets
        self._seeds[:] = np.ascontiguousarray(seeds, "<u8").view(np.uint8)
        self._actions[:] = np.ascontiguousarray(actions, "<f4").reshape(-1).view(np.uint8)
        self._exchange()
        state = self._part("state", "<f4").reshape(self.count, _STATE).copy()
        progress_m, clearance_m, stages, time_s = self._part("figures", "<f4").reshape(self.count, _FIGURES).T.copy()
        passed = np.where(resets, 0, stages - self._passed)
        self._passed = stages
        end = self._part("end", np.uint8).copy()
        step = Step(progress_m, passed, clearance_m, end, time_s, np.asarray(actions), state)
        seen = {part: state if part == "state" else self._image(part) for part in self.parts}
        return (seen[self.parts[0]] if len(seen) == 1 else seen), step

    def _exchange(self) -> None:
        unsent = memoryview(self._order.data)
        unread = memoryview(self._answer)
        try:
            while unsent:
                unsent = unsent[self._process.stdin.write(unsent) :]  # type: ignore[union-attr]
            while unread:
                read = self._out.readinto(unread)
                if not read:
                    raise BrokenPipeError
                unread = unread[read:]
        except (BrokenPipeError, ValueError) as error:
            raise RuntimeError(f"vizflyt gym has ended (status {self._process.poll()})") from error

    def _part(self, name: str, dtype: Any) -> np.ndarray:
        return np.frombuffer(self._answer, np.uint8)[self._ranges[name]].view(dtype)

    def _image(self, name: str) -> np.ndarray:
        if name == "rgb":
            return self._part("rgb", np.uint8).reshape(*self._shape, 3).copy()
        depth_mm = self._part("depth", "<u2").reshape(self._shape)
        depth = depth_mm * np.float32(1e-3 / self.far_m)
        depth[depth_mm == 0] = 1.0
        return np.minimum(depth, np.float32(1.0), out=depth)

    def close(self) -> None:
        # The process ends when its input ends.
        self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._out.close()


class Env(gymnasium.Env):
    """One vehicle in a course. Keywords: see the module's documentation."""

    metadata = {"render_modes": []}  # noqa: RUF012, as Gymnasium declares it

    def __init__(self, project: str = "forest", render_mode: str | None = None, **how: Any) -> None:
        self.render_mode = render_mode
        self._flights = _Flights(count=1, project=project, **how)
        self.observation_space = self._flights.observation_space
        self.action_space = self._flights.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode. The seed determines course and start."""
        super().reset(seed=seed)
        drawn = self.np_random.integers(0, 2**63, 1) if seed is None else np.array([seed])
        seen, step = self._flights.fly(np.ones(1, bool), drawn, np.zeros((1, _ACTION)))
        return _first(seen), _info(step)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies one step."""
        seen, step = self._flights.fly(np.zeros(1, bool), np.zeros(1), np.asarray(action)[None])
        end = step.end[0]
        is_over = end in (CRASHED, LEFT_FENCE, FINISHED)
        return _first(seen), float(self._flights.reward(step)[0]), bool(is_over), bool(end == TIME_UP), _info(step)

    def close(self) -> None:
        """Ends the process of the flight."""
        self._flights.close()


def _first(seen: Any) -> Any:
    return {part: values[0] for part, values in seen.items()} if isinstance(seen, dict) else seen[0]


def _info(step: Step) -> dict[str, Any]:
    return {
        "end": _ENDS[step.end[0]],
        "clearance_m": float(step.clearance_m[0]),
        "passed": int(step.passed[0]),
        "time_s": float(step.time_s[0]),
    }


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many vehicles, each in a separate episode, simulated and rendered together."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, project: str = "forest", render_mode: str | None = None, **how: Any) -> None:
        self.render_mode = render_mode
        self.num_envs = num_envs
        # Nothing to close before the process has started.
        self.closed = True
        self._flights = _Flights(count=num_envs, project=project, **how)
        self.closed = False
        self.single_observation_space = self._flights.observation_space
        self.single_action_space = self._flights.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._is_over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins all episodes. One seed gives seed, seed + 1, and so on. Later episodes follow from these seeds."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        if seed is None:
            seeds = self._draw()
        elif isinstance(seed, int):
            seeds = np.arange(self.num_envs) + seed
        else:
            seeds = np.asarray(seed)
            self.np_random = np.random.default_rng(seeds)
        self._is_over[:] = False
        seen, step = self._flights.fly(np.ones(self.num_envs, bool), seeds, np.zeros((self.num_envs, _ACTION)))
        return seen, self._infos(step)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Flies one step. An environment whose episode has ended begins the next one instead."""
        began = self._is_over.copy()
        seen, step = self._flights.fly(began, self._draw(), np.asarray(actions))
        rewards = np.where(began, 0.0, self._flights.reward(step))
        terminated = (step.end == CRASHED) | (step.end == LEFT_FENCE) | (step.end == FINISHED)
        truncated = step.end == TIME_UP
        self._is_over = terminated | truncated
        return seen, rewards, terminated, truncated, self._infos(step)

    def close_extras(self, **_: Any) -> None:
        """Ends the process of the flights."""
        self._flights.close()

    def _draw(self) -> np.ndarray:
        return self.np_random.integers(0, 2**63, self.num_envs)

    @staticmethod
    def _infos(step: Step) -> dict[str, Any]:
        return {"end": step.end, "clearance_m": step.clearance_m, "passed": step.passed, "time_s": step.time_s}


# Project of each environment.
for _name, _project in {"Forest": "forest", "Windows": "p3", "Gap": "p4", "Race": "p5", "Pillars": "p2"}.items():
    gymnasium.register(
        id=f"vizflyt/{_name}-v0",
        entry_point="vizflyt.gym:Env",
        vector_entry_point="vizflyt.gym:VectorEnv",
        kwargs={"project": _project},
    )
