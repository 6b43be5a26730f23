"""Flies a square with MAVProxy: types commands at its prompt, and monitors the vehicle over an output that MAVProxy
forwards to.

Usage: square_mavproxy.py CONNECTION [--lossless]
    CONNECTION  for example tcp:127.0.0.1:5760, udp:127.0.0.1:14550
    --lossless  also check that MAVProxy counts no lost packet
"""

import math
import os
import re
import subprocess
import sys
import tempfile
import threading
import time

from square import CORNERS, HEIGHT, Checks, reached, until

from pymavlink import mavutil


class Proxy:
    """A running MAVProxy."""

    def __init__(self, connection, folder):
        self.watch = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=254)
        port = self.watch.port.getsockname()[1]
        program = os.path.join(os.path.dirname(sys.executable), "mavproxy.py")
        self.process = subprocess.Popen(
            [sys.executable, "-u", program, "--master", connection,
             "--out", "udpout:127.0.0.1:%d" % port, "--state-basedir", folder,
             "--default-modules", "cmdlong,arm,mode,param,misc,link"],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.newest = {}
        self.lines = []
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def type(self, line):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def work(self):
        message = self.watch.recv_match(blocking=True, timeout=0.05)
        while message:
            if message.get_srcComponent() == 1:
                self.newest[message.get_type()] = message
            message = self.watch.recv_match(blocking=False)

    def until(self, done, line=None, seconds=120.0, every=3.0):
        """Works until `done()` is true, and types `line` every `every` seconds until then."""
        typed = [0.0]

        def work():
            if line and time.monotonic() - typed[0] > every:
                typed[0] = time.monotonic()
                self.type(line)
            self.work()

        return until(done, seconds, work)

    def ready(self):
        if not all(kind in self.newest for kind in ("EKF_STATUS_REPORT", "LOCAL_POSITION_NED")):
            return False
        flags = self.newest["EKF_STATUS_REPORT"].flags
        return flags & 0x18 == 0x18 and not flags & 0x80

    def mode(self):
        return self.newest["HEARTBEAT"].custom_mode

    def armed(self):
        return bool(self.newest["HEARTBEAT"].base_mode & 128)

    def position(self):
        m = self.newest["LOCAL_POSITION_NED"]
        return m.x, m.y, -m.z

    def speed(self):
        m = self.newest["LOCAL_POSITION_NED"]
        return math.hypot(m.vx, m.vy, m.vz)

    def yaw(self):
        return self.newest["ATTITUDE"].yaw


def fly(check, proxy):
    check("connects", proxy.until(lambda: "HEARTBEAT" in proxy.newest), proxy.lines[-5:])
    got_all = lambda: any("Received" in line and "parameters" in line for line in proxy.lines)
    check("reads the parameters", proxy.until(got_all), proxy.lines[-5:])
    check("becomes ready", proxy.until(proxy.ready), proxy.lines[-5:])
    # MAVProxy's `position` ignores yaw: the nose must not turn in the direction of travel (pitfall 4).
    proxy.type("param set WP_YAW_BEHAVIOR 0")
    check("GUIDED", proxy.until(lambda: proxy.mode() == 4, "mode GUIDED"), proxy.lines[-5:])
    check("arms", proxy.until(proxy.armed, "arm throttle"), proxy.lines[-5:])
    north, east, ground = proxy.position()
    proxy.type("takeoff %g" % HEIGHT)
    up = lambda: abs(proxy.position()[2] - ground - HEIGHT) < 0.2
    check("takes off", proxy.until(up), proxy.lines[-5:])
    sin, cos = math.sin(proxy.yaw()), math.cos(proxy.yaw())
    for number, (dx, dy) in enumerate(CORNERS, 1):
        target = (north + dx, east + dy, ground + HEIGHT)
        # `position` takes metres ahead, right and down, relative to the vehicle.
        x, y, z = (a - b for a, b in zip(target, proxy.position()))
        proxy.type("position %.3f %.3f %.3f" % (x * cos + y * sin, y * cos - x * sin, -z))
        there = lambda: reached(proxy.position(), proxy.speed(), target)
        check("corner %d" % number, proxy.until(there), (proxy.position(), target))
    check("LAND", proxy.until(lambda: proxy.mode() == 9, "mode LAND"), proxy.lines[-5:])
    check("lands and disarms", proxy.until(lambda: not proxy.armed()), proxy.lines[-5:])
    check("stands on the ground", abs(proxy.position()[2] - ground) < 0.3, proxy.position())


def lost(proxy):
    """Returns the lost packets that MAVProxy's `link` reports, or None without a report."""

    def found():
        lines = [re.search(r"(\d+) lost", line) for line in proxy.lines]
        return [int(match.group(1)) for match in lines if match]

    proxy.until(found, "link", 20)
    return found()[-1] if found() else None


def main():
    lossless = sys.argv[2:] == ["--lossless"]
    if len(sys.argv) != 2 + lossless:
        sys.exit(__doc__)
    check = Checks("MAVProxy")
    with tempfile.TemporaryDirectory() as folder:
        proxy = Proxy(sys.argv[1], folder)
        try:
            fly(check, proxy)
            if lossless:
                check("lost no packet", lost(proxy) == 0, proxy.lines[-5:])
        finally:
            proxy.process.kill()
            proxy.process.wait()
    check.end()


if __name__ == "__main__":
    main()
