"""The lab as an independent client sees it: one MAVLink link, one Vicon stream.

World axes are x east, y north, z up; MAVLink's are north-east-down. The conversions are implemented here independently
of the code under test.
"""

import json
import math
import os
import socket
import struct
import subprocess
import threading
import time
from collections import Counter

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil # reads MAVLINK20 at import

mavlink = mavutil.mavlink

# An EKF origin: latitude, longitude [1e-7 deg], altitude [mm]. The value is arbitrary.
ORIGIN = (423000000, -718000000, 100000)

# u32 frame, u8 items; per item u8 id, u16 size, char[24] name, f64 x y z [mm], f64 rx ry rz [rad].
VICON_HEAD = struct.Struct("<IB")
VICON_ITEM = struct.Struct("<BH24s6d")


def matrix(rx, ry, rz):
    """Returns Rz(rz) Ry(ry) Rx(rx): rotations about fixed x, then fixed y, then fixed z."""
    cx, sx, cy, sy, cz, sz = (f(a) for a in (rx, ry, rz) for f in (math.cos, math.sin))
    return [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]


def ned_euler(r):
    """Returns roll, pitch, yaw of forward-right-down axes in north-east-down, from the rotation of
    forward-left-up axes in east-north-up."""
    swapped = [r[1], r[0], [-v for v in r[2]]]
    n = [[row[0], -row[1], -row[2]] for row in swapped]
    return math.atan2(n[2][1], n[2][2]), -math.asin(n[2][0]), math.atan2(n[1][0], n[0][0])


class Vicon:
    """Listens to the UDP object stream."""

    def __init__(self, port=0):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # A given port belongs to the lab's motion capture, which sends from another computer.
        self.socket.bind(("0.0.0.0" if port else "127.0.0.1", port))
        self.socket.setblocking(False)
        self.address = "127.0.0.1:%d" % self.socket.getsockname()[1]
        self.frames = []
        self.lengths = Counter()
        self.names = Counter()
        self.pose = None

    def read(self):
        """Reads the received packets; returns whether there is a new pose."""
        new = False
        while True:
            try:
                data = self.socket.recv(2048)
            except BlockingIOError:
                return new
            frame, items = VICON_HEAD.unpack_from(data)
            item, size, name, x, y, z, rx, ry, rz = VICON_ITEM.unpack_from(data, VICON_HEAD.size)
            assert (items, item, size) == (1, 0, 72), (items, item, size)
            self.frames.append(frame)
            self.lengths[len(data)] += 1
            self.names[name.rstrip(b"\0")] += 1
            self.pose = (x / 1e3, y / 1e3, z / 1e3, rx, ry, rz)
            new = True


class Lab:
    """A running simulator with the background tasks of a companion computer."""

    def __init__(self, command, endpoint, *options):
        """Starts `command`; `endpoint` is "udpout" (the simulator sends first) or "tcpin"."""
        self.vicon = Vicon()
        if endpoint == "udpout":
            self.link = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255)
            address = "udpout:127.0.0.1:%d" % self.link.port.getsockname()[1]
        else:
            address = endpoint + ":127.0.0.1:0"
        self.process = subprocess.Popen(
            [*command, "--json", "--lifeline", "--realistic-startup", "--mavlink", address,
             "--vicon", self.vicon.address, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        # Kill a simulator that hangs, so that the test ends.
        self.watchdog = threading.Timer(300, self.process.kill)
        self.watchdog.start()
        self.ready = json.loads(self.process.stdout.readline())
        if endpoint != "udpout":
            scheme = {"tcpin": "tcp", "udpin": "udpout"}[endpoint]
            self.link = mavutil.mavlink_connection(
                "%s:%s" % (scheme, self.ready["mavlink"]), source_system=255
            )
        self.vision = False
        self.setpoint = None
        self.newest = {}
        self.counts = Counter()
        self.texts = []
        self.params = {}
        self.acks = []
        self.local_times = []
        self.due = {"vision": 0.0, "heartbeat": 0.0, "setpoint": 0.0}

    def is_due(self, what, period_s):
        now = time.monotonic()
        if now < self.due[what]:
            return False
        self.due[what] = now + period_s
        return True

    def work(self):
        """Sends what is due, then waits at most 5 ms for the next message."""
        mav = self.link.mav
        if self.vicon.read() and self.vision and self.is_due("vision", 0.02):
            x, y, z, rx, ry, rz = self.vicon.pose
            roll, pitch, yaw = ned_euler(matrix(rx, ry, rz))
            usec = int(time.monotonic() * 1e6)
            mav.vision_position_estimate_send(usec, y, x, -z, roll, pitch, yaw)
        if self.is_due("heartbeat", 1.0):
            mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4)
        if self.setpoint and self.is_due("setpoint", 0.05):
            self.send(self.setpoint)
        message = self.link.recv_match(blocking=True, timeout=0.005)
        while message:
            self.take(message)
            message = self.link.recv_match(blocking=False)

    def take(self, message):
        kind = message.get_type()
        self.newest[kind] = message
        self.counts[kind] += 1
        if kind == "STATUSTEXT":
            self.texts.append(message.text)
        elif kind == "PARAM_VALUE":
            self.params[message.param_id] = message
        elif kind == "COMMAND_ACK":
            self.acks.append(message)
        elif kind == "LOCAL_POSITION_NED":
            self.local_times.append(message.time_boot_ms)

    def until(self, seconds, done):
        """Works until `done()` is true or `seconds` have passed; returns whether it was true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if done():
                return True
            self.work()
        return bool(done())

    def boot_ms(self):
        """Returns the newest time of the autopilot's clock. [ms]"""
        return max(m.time_boot_ms for m in self.newest.values() if hasattr(m, "time_boot_ms"))

    def fly_for(self, seconds):
        """Works until the autopilot's clock has advanced by `seconds`."""
        start = self.boot_ms()
        return self.until(seconds * 4 + 5, lambda: self.boot_ms() - start >= seconds * 1000)

    def command(self, number, *params):
        """Sends COMMAND_LONG; returns the result in its acknowledgement, or None."""
        self.acks.clear()
        self.link.mav.command_long_send(1, 1, number, 0, *params, *[0] * (7 - len(params)))
        self.until(3, lambda: any(a.command == number for a in self.acks))
        return next((a.result for a in self.acks if a.command == number), None)

    def send(self, setpoint):
        mask, values = setpoint
        self.link.mav.set_position_target_local_ned_send(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, mask, *values
        )

    @staticmethod
    def position(x, y, z, yaw_ned):
        """Returns a position setpoint with yaw, from world axes."""
        return 0x9F8, (y, x, -z, 0, 0, 0, 0, 0, 0, yaw_ned, 0)

    @staticmethod
    def velocity(vx, vy, vz, yaw_ned):
        """Returns a velocity setpoint with yaw, from world axes."""
        return 0x9C7, (0, 0, 0, vy, vx, -vz, 0, 0, 0, yaw_ned, 0)

    def distance(self, x, y, z):
        """Returns the distance of the true position from a point. [m]"""
        return math.dist(self.vicon.pose[:3], (x, y, z))

    def local(self):
        """Returns the autopilot's position in world axes. [m]"""
        m = self.newest["LOCAL_POSITION_NED"]
        return m.y, m.x, -m.z

    def speed(self):
        """Returns the autopilot's horizontal speed. [m/s]"""
        m = self.newest["LOCAL_POSITION_NED"]
        return math.hypot(m.vx, m.vy)

    def armed(self):
        return bool(self.newest["HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def prearm_good(self):
        return bool(
            self.newest["SYS_STATUS"].onboard_control_sensors_health
            & mavlink.MAV_SYS_STATUS_PREARM_CHECK
        )

    def has_text(self, words):
        return any(words in text for text in self.texts)

    def close(self):
        """Stops the simulator by closing its standard input; returns its report and exit status."""
        self.process.stdin.close()
        lines = [json.loads(line) for line in self.process.stdout]
        status = self.process.wait()
        self.watchdog.cancel()
        self.link.close()
        return next((line["report"] for line in lines if "report" in line), None), status
