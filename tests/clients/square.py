"""The flight that the three clients share, and its checks.

A client connects, waits until the vehicle is ready, arms, takes off, flies a square and lands. The checks use the
vehicle's own telemetry, so that the same script runs against the simulator, ArduPilot's simulation, and a vehicle in a
net (without propellers for the first attempts).
"""

import math
import sys
import time

# Height above the ground, and side of the square. [m]
HEIGHT, SIDE = 1.2, 1.0
# Maximum distance and speed at which a corner counts as reached. [m], [m/s]
NEAR, SLOW = 0.2, 0.25
# Corners from the start: north and east. [m]
CORNERS = [(SIDE, 0), (SIDE, SIDE), (0, SIDE), (0, 0)]
# Timeout of each step; ArduCopter is ready after about 15 s without GPS, and after 45 s with GPS. [s]
PATIENCE = 120.0


class Checks:
    """Counts and prints checks."""

    def __init__(self, client, keeps_going=False):
        self.client = client
        self.keeps_going = keeps_going
        self.passed = self.failed = 0

    def __call__(self, name, good, detail=""):
        self.passed += bool(good)
        self.failed += not good
        more = "" if good or detail == "" else "  (%s)" % (detail,)
        print("%s  %s: %s%s" % ("ok  " if good else "FAIL", self.client, name, more), flush=True)
        if not good and not self.keeps_going:
            # The following checks would only fail for the same reason.
            self.end()

    def end(self):
        print("%s: %d passed, %d failed" % (self.client, self.passed, self.failed), flush=True)
        sys.exit(self.failed != 0)


def until(done, seconds=PATIENCE, work=lambda: time.sleep(0.02)):
    """Works until `done()` is true; returns whether it was true within `seconds`."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if done():
            return True
        work()
    return bool(done())


def reached(position, speed, target):
    """Returns whether the vehicle is stationary at a target (north, east, height)."""
    return math.dist(position, target) < NEAR and speed < SLOW
