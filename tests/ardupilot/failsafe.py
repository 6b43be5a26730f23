"""Losses in flight at three speeds: time until LAND, time until landed, and drift until then."""

import pathlib
import re
import signal
import time
from typing import NamedTuple

import promises
from checks import Failed, attempt, check, say
from lab import Flight
from poses import level_m

SPEEDS_MPS = (0.35, 1.0, 2.5)
LAND = 9
DOWN_M = 0.05
# Maximum run-up to reach the speed; the loss happens here even if the speed is not reached. [m]
RUN_UP_M = 4.5
# Maximum time of observation. [s]
WATCHED_S = 25.0
DOCUMENT = pathlib.Path(__file__).parents[2] / "docs/guides/failsafe.md"


def kill_runtime(flight):
    flight.runtime.send(signal.SIGKILL)


def stop_runtime(flight):
    flight.runtime.send(signal.SIGSTOP)


def kill_server(flight):
    flight.server.send(signal.SIGKILL)


def cut_poses(flight):
    flight.poses.cut = True


def cut_mavlink(flight):
    flight.wire.cut = True


LOSSES = {
    "runtime killed": kill_runtime,
    "runtime stopped (SIGSTOP)": stop_runtime,
    "server killed": kill_server,
    "poses stopped": cut_poses,
    "MAVLink cut": cut_mavlink,
}


class Row(NamedTuple):
    loss: str
    asked_mps: float
    speed_mps: float
    land_s: float
    down_s: float
    drift_m: float


def run(lab, quick):
    rows = []
    for loss in ("poses stopped", "runtime killed") if quick else LOSSES:
        for speed_mps in SPEEDS_MPS[:1] if quick else SPEEDS_MPS:
            with attempt(f"{loss} at {speed_mps:g} m/s"):
                rows.append(fly(lab, loss, speed_mps))
                judge(rows[-1])
    table(rows)


def fly(lab, loss, asked_mps):
    with Flight(lab, f"world:{asked_mps:g}:0") as flight:
        flight.until("the flight", lambda: flight.phase("flying"))
        start = flight.poses.now()
        fast = lambda: flight.poses.speed_mps() > 0.95 * asked_mps and level_m(flight.poses.now().p, start.p) > 0.4
        far = lambda: level_m(flight.poses.now().p, start.p) > RUN_UP_M
        flight.until("the speed", lambda: fast() or far(), 30)
        before, speed_mps, struck = flight.poses.now(), flight.poses.speed_mps(), time.monotonic()
        LOSSES[loss](flight)
        end_s = before.stamp_s + WATCHED_S
        down = lambda: next((s for s in flight.poses.since(before.stamp_s) if s.p[2] < DOWN_M), None)
        while not down() and flight.poses.now().stamp_s < end_s:
            time.sleep(0.02)
        landed = down()
        until_s = landed.stamp_s if landed else end_s
        way = [sight.p for sight in flight.poses.since(before.stamp_s) if sight.stamp_s <= until_s]
        lands = next((b for b in flight.wire.beats if b.at > struck and b.mode == LAND), None)
        return Row(loss, asked_mps, speed_mps,
                   flight.poses.stamp_s(lands.at) - before.stamp_s if lands else float("inf"),
                   landed.stamp_s - before.stamp_s if landed else float("inf"),
                   max(level_m(p, before.p) for p in way))


def judge(row):
    name = f"{row.loss} at {row.asked_mps:g} m/s"
    figures = f"LAND after {row.land_s:.1f} s, down after {row.down_s:.1f} s, drift {row.drift_m:.2f} m"
    if row.loss in promises.AUTOPILOT_ALONE:
        land, down, drift = written(promises.AUTOPILOT_ALONE[row.loss], row.asked_mps)
        check(name, row.down_s <= float(down.split()[0]) + promises.AS_WRITTEN_S,
              f"{figures}; failsafe.md: LAND after {land}, down after {down}, drift {drift}")
        return
    drift_m = promises.drift_m(row.speed_mps)
    good = row.down_s <= promises.DOWN_WITHIN_S and row.drift_m <= drift_m
    check(name, good, f"{figures}; promised {promises.DOWN_WITHIN_S:g} s, {drift_m:.2f} m")


def written(name, speed_mps):
    """Returns the last three cells of the row in docs/guides/failsafe.md."""
    cells = rf"\| {re.escape(name)} \|[^|]*\| {speed_mps:g} m/s \|.*\| ([^|]+) \| ([^|]+) \| ([^|]+) \|"
    row = re.search(rf"(?m)^{cells}$", DOCUMENT.read_text())
    if not row:
        raise Failed(f"{DOCUMENT.name} has no row '{name}' at {speed_mps:g} m/s")
    return row.groups()


def table(rows):
    say("\n| lost | asked, flown m/s | LAND s | down s | drift m |\n|---|---|---|---|---|")
    for row in rows:
        say("| %s | %.2f, %.2f | %.1f | %.1f | %.2f |" % row)
    say("")
