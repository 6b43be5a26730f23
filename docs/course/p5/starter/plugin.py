#!/usr/bin/env python3
"""Project 5: goes through the states of the table. For now there is one, which looks around; then the vehicle lands."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from states import END, FIRST, TABLE, timed

import vizflyt
from vizflyt import Setpoint

# Stages in their order, with the names in `details["name"]` of their events.
STAGES = ("window 1", "window 2", "gap", "clock hand")
# For now: amplitude and duration of the look to both sides. [rad], [s]
SWEEP_RAD, SWEEP_S = 0.5, 4.0

# One setpoint for each image; None keeps the previous one. A state returns whether it succeeded.
Steps = Generator[Setpoint | None, None, bool]
Flight = Generator[Setpoint | None, None, None]


class Mine(vizflyt.Plugin):
    """One flight. Each state of the table is a method that yields one reply for each image."""

    def on_start(self, info: vizflyt.ArenaInfo) -> None:
        self.flying = False
        self.seen = -1
        self.passed = 0
        self.yaw_rad: float | None = None
        self.begun_s = 0.0
        self.steps = self._fly()

    def on_event(self, event: vizflyt.Event) -> None:
        self.flying |= event.details.get("phase") == "flying"
        if event.kind == "stage":
            self.passed = event.details["index"] + 1

    def on_image(self, obs: vizflyt.Observation) -> Setpoint | None:
        front, vehicle = obs.camera("front"), obs.vehicle
        # Each image of the downward camera also contains the front camera's previous image.
        if front is None or vehicle is None or front.seq == self.seen:
            return None
        self.seen = front.seq
        if not self.flying:
            return Setpoint.hold()
        self.front, self.vehicle = front, vehicle
        # Time of the image, not of this call, because the hand's position is of that time.
        self.now_s = front.shown_ns * 1e-9
        if self.yaw_rad is None:
            self.yaw_rad, self.begun_s = vehicle.yaw_rad, self.now_s
        return next(self.steps, Setpoint.land())

    def _fly(self) -> Flight:
        """Goes from state to state: `search` is the method `_search`, and so on. Ends at the table's final state."""
        state = FIRST
        while state != END:
            stage = STAGES[min(self.passed, len(STAGES) - 1)]
            print(f"{self.now_s - self.begun_s:.1f} s: {state}, before {stage}", flush=True)
            steps: Steps = getattr(self, f"_{state}")()
            well = yield from timed(steps, TABLE[state].most_s, lambda: self.now_s)
            state = TABLE[state].well if well else TABLE[state].otherwise

    def _search(self) -> Steps:
        """To do: for now it turns left, right and back, without any detection."""
        assert self.yaw_rad is not None
        begun_s = self.now_s
        while self.now_s < begun_s + SWEEP_S:
            turned_rad = SWEEP_RAD * np.sin(2 * np.pi * (self.now_s - begun_s) / SWEEP_S)
            yield Setpoint.velocity([0, 0, 0], axes="heading", yaw=self.yaw_rad + turned_rad)
        return False


if __name__ == "__main__":
    vizflyt.run(Mine)
