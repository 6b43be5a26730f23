"""Feeds a vehicle what it needs to fly in a net: an EKF origin once, and its motion-capture pose 50 times a second as
external navigation. A vehicle with GPS, or one simulated by ArduPilot, does not need it.

Usage: feed.py VICON_PORT CONNECTION
    VICON_PORT  UDP port that receives the motion capture's object stream; 0 takes a free port
                and prints its address
    CONNECTION  the vehicle, in pymavlink's notation; read from standard input if it is "-"
"""

import sys
import time

from lab import ORIGIN, Vicon, matrix, mavlink, mavutil, ned_euler

# An onboard companion computer, so that its heartbeats do not count as a ground station's.
SYSTEM, COMPONENT = 1, mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    vicon = Vicon(int(sys.argv[1]))
    print(vicon.address, flush=True)
    connection = sys.stdin.readline().strip() if sys.argv[2] == "-" else sys.argv[2]
    link = mavutil.mavlink_connection(
        connection, source_system=SYSTEM, source_component=COMPONENT
    )
    sent = asked = 0.0
    origin = False
    while True:
        now = time.monotonic()
        # The packet also gives a vehicle that waits for datagrams the address of this process.
        if now - asked > 1:
            asked = now
            link.mav.heartbeat_send(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4
            )
            if not origin:
                link.mav.set_gps_global_origin_send(1, *ORIGIN)
        if vicon.read() and now - sent >= 0.018:
            sent = now
            x, y, z, rx, ry, rz = vicon.pose
            roll, pitch, yaw = ned_euler(matrix(rx, ry, rz))
            link.mav.vision_position_estimate_send(int(now * 1e6), y, x, -z, roll, pitch, yaw)
        message = link.recv_match(blocking=True, timeout=0.004)
        while message:
            origin |= message.get_type() == "GPS_GLOBAL_ORIGIN"
            message = link.recv_match(blocking=False)


if __name__ == "__main__":
    main()
