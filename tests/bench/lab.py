"""Environment of the measurements: the built program, and a folder for scenes and files."""

import json
import struct
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import machine


class Lab(NamedTuple):
    """The built program, and the working folder of its commands."""

    program: str
    folder: Path

    def vizflyt(self, *arguments: str, threads: int | None = None) -> machine.Used:
        env = {"RAYON_NUM_THREADS": str(threads)} if threads else {}
        return machine.run([self.program, *arguments], self.folder, env)

    def demo(self, report: str, *arguments: str) -> dict:
        """Flies the demo; returns its report. A flight that was landed before it finished has status 1."""
        machine.run([self.program, "demo", "--headless", "--report", report, *arguments], self.folder, most=1)
        return json.loads((self.folder / report).read_text())

    def json(self, *arguments: str, threads: int | None = None) -> dict:
        return json.loads(self.vizflyt(*arguments, "--json", threads=threads).output)

    def scene(self, kind: str) -> str:
        """Returns the arena of a generated scene of seed 7; generates it if it is missing."""
        if not (self.folder / kind / "arena.toml").exists():
            self.vizflyt("scene", "generate", kind, "--seed", "7", "-o", kind)
        return f"{kind}/arena.toml"

    def camera(self, name: str, x_m: float, y_m: float, z_m: float) -> str:
        """Returns the file of a camera that looks along x of the scene: 320x240, 90 degrees."""
        path = self.folder / f"{name}.json"
        path.write_text(json.dumps({
            "fx": 160, "fy": 160, "cx": 160, "cy": 120, "w": 320, "h": 240, "bg": [0, 0, 0],
            "w2c": [[0, -1, 0, y_m], [0, 0, -1, z_m], [1, 0, 0, -x_m], [0, 0, 0, 1]]}))
        return path.name

    def fly(self, project: str, envs: int, more: list[str], seconds: float) -> tuple[int, float]:
        """Steps the courses of `vizflyt gym` as the Python package does; returns the number of steps and the processor
        time. [s]"""
        command = [self.program, "gym", "--log-level", "error", "--project", project, "--envs", str(envs), *more]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            head = json.loads(process.stdout.readline())
            pixels = head["image"][0] * head["image"][1] if head["image"] else 0
            length = envs * (4 * (head["state"] + head["figures"]) + 1 + pixels * (2 * head["depth"] + 3 * head["rgb"]))

            seeds = struct.pack(f"<{envs}Q", *range(envs))
            actions = struct.pack(f"<{head['action']}f", 0.3, *[0.0] * (head["action"] - 1)) * envs
            ends = 4 * envs * (head["state"] + head["figures"])

            def step(resets: bytes) -> bytes:
                """Takes a step; returns a byte for each episode: whether it is over."""
                process.stdin.write(resets + seeds + actions)
                process.stdin.flush()
                return process.stdout.read(length)[ends:ends + envs]

            # Episodes that are over would cost no more time: reset them, as Gymnasium's vectors do.
            over = step(b"\x01" * envs)
            watched = machine.Watched(process.pid)
            steps, begun, before_s = 0, time.monotonic(), watched.processor_s()
            while time.monotonic() - begun < seconds:
                over = step(bytes(map(bool, over)))
                steps += envs
            return steps, watched.processor_s() - before_s
