"""Flies a square with pymavlink.

Usage: square_pymavlink.py CONNECTION [--lossless]
    CONNECTION  for example tcp:127.0.0.1:5760, udpin:0.0.0.0:14550
    --lossless  also check that pymavlink counts no lost packet
"""

import math
import sys
import time

from square import CORNERS, HEIGHT, Checks, reached, until

from pymavlink import mavutil

mavlink = mavutil.mavlink
GUIDED, LAND = 4, 9


class Vehicle:
    """Holds the newest message of each type, and sends a heartbeat once a second."""

    def __init__(self, connection):
        self.link = mavutil.mavlink_connection(connection, source_system=255)
        self.newest = {}
        self.acks = {}
        self.texts = []
        self.beat = 0.0

    def work(self):
        if time.monotonic() - self.beat > 1:
            self.beat = time.monotonic()
            self.link.mav.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4
            )
        message = self.link.recv_match(blocking=True, timeout=0.05)
        if message is None or message.get_srcComponent() != 1:
            return
        kind = message.get_type()
        self.newest[kind] = message
        if kind == "COMMAND_ACK":
            self.acks[message.command] = message.result
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)

    def until(self, done, seconds=120.0):
        return until(done, seconds, self.work)

    def command(self, number, *params):
        """Sends a command until it is acknowledged; returns the result."""
        self.acks.pop(number, None)
        padded = [*params, *[0] * (7 - len(params))]
        system = self.newest["HEARTBEAT"].get_srcSystem()
        for confirmation in range(5):
            self.link.mav.command_long_send(system, 1, number, confirmation, *padded)
            if self.until(lambda: number in self.acks, 2):
                return self.acks[number]
        return None

    def has(self, *kinds):
        return all(kind in self.newest for kind in kinds)

    def ready(self):
        """Returns whether the estimator has a position and the pre-arm checks passed."""
        if not self.has("EKF_STATUS_REPORT", "SYS_STATUS", "LOCAL_POSITION_NED"):
            return False
        flags = self.newest["EKF_STATUS_REPORT"].flags
        health = self.newest["SYS_STATUS"].onboard_control_sensors_health
        return flags & 0x18 == 0x18 and not flags & 0x80 and bool(health & 0x10000000)

    def armed(self):
        return bool(self.newest["HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def position(self):
        """Returns north, east and height. [m]"""
        m = self.newest["LOCAL_POSITION_NED"]
        return m.x, m.y, -m.z

    def speed(self):
        m = self.newest["LOCAL_POSITION_NED"]
        return math.hypot(m.vx, m.vy, m.vz)

    def goto(self, target, yaw):
        x, y, height = target
        system = self.newest["HEARTBEAT"].get_srcSystem()
        self.link.mav.set_position_target_local_ned_send(
            0, system, 1, mavlink.MAV_FRAME_LOCAL_NED, 0x9F8, x, y, -height, 0, 0, 0, 0, 0, 0, yaw, 0
        )


def main():
    lossless = sys.argv[2:] == ["--lossless"]
    if len(sys.argv) != 2 + lossless:
        sys.exit(__doc__)
    check = Checks("pymavlink")
    vehicle = Vehicle(sys.argv[1])
    check("connects", vehicle.until(lambda: vehicle.has("HEARTBEAT")))
    # The default streams of telemetry ports differ, so request them explicitly.
    for number in (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 193, 1):
        vehicle.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 100000)
    check("becomes ready", vehicle.until(vehicle.ready), vehicle.texts[-5:])
    accepted = mavlink.MAV_RESULT_ACCEPTED
    check("GUIDED", vehicle.command(mavlink.MAV_CMD_DO_SET_MODE, 1, GUIDED) == accepted)
    arming = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    check("arms", vehicle.command(arming, 1) == accepted, vehicle.texts[-5:])
    north, east, ground = vehicle.position()
    takeoff = vehicle.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT)
    check("takes off", takeoff == accepted, vehicle.texts[-5:])
    up = lambda: abs(vehicle.position()[2] - ground - HEIGHT) < 0.2
    check("climbs", vehicle.until(up), vehicle.position())
    yaw = vehicle.newest["ATTITUDE"].yaw if vehicle.has("ATTITUDE") else 0.0
    for number, (dx, dy) in enumerate(CORNERS, 1):
        target = (north + dx, east + dy, ground + HEIGHT)

        def there():
            vehicle.goto(target, yaw)
            return reached(vehicle.position(), vehicle.speed(), target)

        check("corner %d" % number, vehicle.until(there), (vehicle.position(), target))
    check("LAND", vehicle.command(mavlink.MAV_CMD_NAV_LAND) == accepted)
    check("lands and disarms", vehicle.until(lambda: not vehicle.armed()), vehicle.texts[-5:])
    height = vehicle.position()[2] - ground
    check("stands on the ground", abs(height) < 0.3, height)
    if lossless:
        loss = vehicle.link.mav_loss
        check("lost none of %d packets" % vehicle.link.mav_count, loss == 0, loss)
    check.end()


if __name__ == "__main__":
    main()
