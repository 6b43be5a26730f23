"""Flies a square with MAVSDK; the package mavsdk 4 contains its C++ library.

Usage: square_mavsdk.py CONNECTION [--lossless]      for example tcpout://127.0.0.1:5760, udpin://0.0.0.0:14540
"""

import math
import sys

from square import CORNERS, HEIGHT, Checks, reached, until

from mavsdk import Configuration, ConnectionResult, Mavsdk
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.offboard import Offboard, OffboardError, PositionNedYaw
from mavsdk.plugins.telemetry import Telemetry


def tried(act, *params):
    """Runs `act`; returns the error, or nothing."""
    try:
        act(*params)
        return ""
    except (ActionError, OffboardError) as error:
        return str(error)


def main():
    # MAVSDK counts no lost packets: a parallel listener does.
    if len(sys.argv) != 2 + (sys.argv[2:] == ["--lossless"]):
        sys.exit(__doc__)
    check = Checks("mavsdk")
    # A ground station, so that the autopilot counts its heartbeats.
    sdk = Mavsdk(Configuration.create_manual(255, 190, True))
    result = sdk.add_any_connection(sys.argv[1])
    check("opens %s" % sys.argv[1], result == ConnectionResult.SUCCESS, result)
    system = sdk.first_autopilot(120.0)
    check("connects", system is not None)
    action, offboard, telemetry = Action(system), Offboard(system), Telemetry(system)
    telemetry.set_rate_position_velocity_ned(10.0)

    def position():
        p = telemetry.position_velocity_ned().position
        return p.north_m, p.east_m, -p.down_m

    def speed():
        v = telemetry.position_velocity_ned().velocity
        return math.hypot(v.north_m_s, v.east_m_s, v.down_m_s)

    # MAVSDK's health check requires GPS; arming shows whether the vehicle is ready, as soon as it has a position.
    known = lambda: not any(math.isnan(v) for v in position())
    check("position comes", until(known))
    north, east, ground = position()
    offboard.set_position_ned(PositionNedYaw(north, east, -ground, 0.0))
    problem = ["not tried"]

    def does(act):
        def attempt():
            problem[0] = tried(act)
            return problem[0] == ""

        return attempt

    # For ArduPilot "offboard" is GUIDED.
    check("GUIDED", until(does(offboard.start), 60), problem[0])
    check("arms", until(does(action.arm), 60), problem[0])
    north, east, ground = position()
    heading = telemetry.heading().heading_deg
    yaw = 0.0 if math.isnan(heading) else heading
    action.set_takeoff_altitude(HEIGHT)
    tried(offboard.stop)
    check("takes off", until(does(action.takeoff), 30), problem[0])
    check("climbs", until(lambda: abs(position()[2] - ground - HEIGHT) < 0.2), position())
    for number, (dx, dy) in enumerate(CORNERS, 1):
        target = (north + dx, east + dy, ground + HEIGHT)
        offboard.set_position_ned(PositionNedYaw(target[0], target[1], -target[2], yaw))
        if number == 1:
            check("flies setpoints", until(does(offboard.start), 30), problem[0])
        there = lambda: reached(position(), speed(), target)
        check("corner %d" % number, until(there), (position(), target))
    check("lands", until(does(action.land), 30), problem[0])
    check("disarms by itself", until(lambda: not telemetry.armed()))
    check("stands on the ground", abs(position()[2] - ground) < 0.3, position())
    check.end()


if __name__ == "__main__":
    main()
