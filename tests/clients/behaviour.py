"""Flies the simulator as a companion computer would: refused commands, take-off, a square, setpoints that time out,
landing. Feeds external navigation from the simulator's Vicon stream with its own reader. Prints one line for each check
and a count at the end; the exit status is 0 only if all checks passed.

Usage: behaviour.py COMMAND...   (COMMAND starts the simulator)
"""

import math
import statistics
import sys
import time

from lab import ORIGIN, Lab, mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
FAILED = mavlink.MAV_RESULT_FAILED
SPAWN = (0.5, -0.3)
SPAWN_YAW_DEG = 30.0
HEIGHT = 1.2

passed = failed = 0


def check(name, good, detail=""):
    """Counts and prints one check."""
    global passed, failed
    passed += bool(good)
    failed += not good
    print("%s  %s%s" % ("ok  " if good else "FAIL", name, "" if good else "  (%s)" % (detail,)))
    sys.stdout.flush()


def arm(lab, on=1):
    return lab.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, on)


def set_mode(lab, number):
    return lab.command(mavlink.MAV_CMD_DO_SET_MODE, 1, number)


def wrap(angle):
    return math.remainder(angle, 2 * math.pi)


def before_flight(lab):
    received = lab.until(10, lambda: "HEARTBEAT" in lab.newest and lab.vicon.pose)
    check("heartbeat and mocap come", received)
    heartbeat = lab.newest["HEARTBEAT"]
    check(
        "heartbeat is an ArduCopter quadrotor in STABILIZE, disarmed",
        (heartbeat.type, heartbeat.autopilot, heartbeat.custom_mode, lab.armed())
        == (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, False),
        heartbeat,
    )
    x, y, z, rx, ry, rz = lab.vicon.pose
    check(
        "Vicon layout: 80 bytes, name, pose at the spawn",
        list(lab.vicon.lengths) == [80]
        and list(lab.vicon.names) == [b"vizflyt"]
        and math.dist((x, y, z), (*SPAWN, 0)) < 0.005
        and abs(rz - math.radians(SPAWN_YAW_DEG)) < 0.02
        and abs(rx) < 0.02
        and abs(ry) < 0.02,
        lab.vicon.pose,
    )
    lab.fly_for(3)
    frames = lab.vicon.frames
    rate = (frames[-1] - frames[0]) / max(lab.boot_ms() / 1000, 0.1)
    check("Vicon frames count up at 200 Hz", 150 < rate < 210 and frames == sorted(frames), rate)

    check("arming without vision is refused", arm(lab) == FAILED, lab.texts)
    check("and reports why", lab.has_text("PreArm: VisOdom: not healthy"), lab.texts)
    lab.vision = True
    lab.until(5, lab.prearm_good)
    check("LAND is no mode to arm in", set_mode(lab, 9) == ACCEPTED and arm(lab) == FAILED)
    check("an unknown mode is refused", set_mode(lab, 99) == FAILED)
    check("GUIDED is mode 4", set_mode(lab, 4) == ACCEPTED)
    check("take-off while disarmed is refused", take_off(lab) == FAILED, lab.texts)
    check("without an origin it arms", arm(lab) == ACCEPTED, lab.texts)
    check("and refuses to take off", take_off(lab) == FAILED and not airborne(lab), lab.texts)
    check("it disarms on command", arm(lab, 0) == ACCEPTED)
    check("no position is reported yet", "LOCAL_POSITION_NED" not in lab.newest)

    check(
        "an unsupported command is acknowledged as such",
        lab.command(mavlink.MAV_CMD_DO_PARACHUTE, 1) == mavlink.MAV_RESULT_UNSUPPORTED,
    )
    lab.link.mav.param_request_list_send(1, 1)
    complete = lab.until(
        5, lambda: lab.params and len(lab.params) == next(iter(lab.params.values())).param_count
    )
    check("the parameter list is complete", complete and len(lab.params) >= 30, len(lab.params))
    set_speed = b"WP_SPD"
    lab.params.clear()
    lab.link.mav.param_set_send(1, 1, set_speed, 1.5, mavlink.MAV_PARAM_TYPE_REAL32)
    lab.until(3, lambda: "WP_SPD" in lab.params)
    check("a parameter is set", lab.params["WP_SPD"].param_value == 1.5, lab.params)

    sent = time.monotonic_ns()
    lab.link.mav.timesync_send(0, sent)
    answered = lab.until(
        3, lambda: "TIMESYNC" in lab.newest and lab.newest["TIMESYNC"].ts1 == sent
    )
    timesync = lab.newest.get("TIMESYNC")
    check(
        "TIMESYNC is answered with the time since boot",
        answered and abs(timesync.tc1 / 1e6 - lab.boot_ms()) < 2000,
        timesync,
    )


def take_off(lab):
    return lab.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT)


def airborne(lab):
    return lab.vicon.pose[2] > 0.05


def position_comes(lab):
    lab.link.mav.set_gps_global_origin_send(1, *ORIGIN)
    lab.until(5, lambda: "GPS_GLOBAL_ORIGIN" in lab.newest)
    origin = lab.newest.get("GPS_GLOBAL_ORIGIN")
    check(
        "the origin comes back",
        origin and (origin.latitude, origin.longitude, origin.altitude) == ORIGIN,
        origin,
    )
    good = lab.until(
        10,
        lambda: lab.newest["EKF_STATUS_REPORT"].flags & 0x18 == 0x18
        and not lab.newest["EKF_STATUS_REPORT"].flags & 0x80
        and lab.prearm_good(),
    )
    check("the estimator and the checks turn good", good, lab.newest["EKF_STATUS_REPORT"])
    check("the height datum is announced", lab.until(5, lambda: lab.has_text("Field Elevation Set")))
    lab.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32, 20000)
    lab.local_times.clear()
    lab.until(10, lambda: len(lab.local_times) > 60)
    gaps = [b - a for a, b in zip(lab.local_times[5:], lab.local_times[6:])]
    check("LOCAL_POSITION_NED comes at 50 Hz", statistics.median(gaps) in (18, 20, 22), gaps)
    where = lab.local()
    check("and is where the vehicle is", math.dist(where, lab.vicon.pose[:3]) < 0.05, where)


def fly_square(lab):
    check("GUIDED, armed", set_mode(lab, 4) == ACCEPTED and arm(lab) == ACCEPTED, lab.texts)
    check("take-off is accepted", take_off(lab) == ACCEPTED, lab.texts)
    high = lab.until(20, lambda: abs(lab.vicon.pose[2] - HEIGHT) < 0.1)
    check("it climbs to the height", high, lab.vicon.pose)
    lab.until(3, lab.armed)
    check("the heartbeat has armed, GUIDED", lab.armed() and lab.newest["HEARTBEAT"].custom_mode == 4)
    x0, y0 = SPAWN
    yaw_ned = math.pi / 2 - math.radians(SPAWN_YAW_DEG)
    for corner, (dx, dy) in enumerate([(2, 0), (2, 2), (0, 2), (0, 0)], 1):
        x, y = x0 + dx, y0 + dy
        lab.setpoint = lab.position(x, y, HEIGHT, yaw_ned)
        near = lab.until(20, lambda: lab.distance(x, y, HEIGHT) < 0.15 and lab.speed() < 0.2)
        check("corner %d of the square is reached" % corner, near, lab.vicon.pose)
        check(
            "and truth and estimate agree there",
            math.dist(lab.local(), lab.vicon.pose[:3]) < 0.1,
            (lab.local(), lab.vicon.pose),
        )
    lab.setpoint = None
    lab.fly_for(4)
    check("a position is held without resending", lab.distance(x0, y0, HEIGHT) < 0.15)
    yaw = lab.newest["ATTITUDE"].yaw
    check("the nose kept the ordered heading", abs(wrap(yaw - yaw_ned)) < 0.1, yaw)


def fly_velocities(lab):
    lab.setpoint = lab.velocity(0, 1.5, 0, math.pi)
    lab.fly_for(2)
    velocity = lab.newest["LOCAL_POSITION_NED"]
    check(
        "1.5 m/s north is flown",
        abs(velocity.vx - 1.5) < 0.2 and abs(velocity.vy) < 0.2 and abs(velocity.vz) < 0.2,
        velocity,
    )
    yaw = lab.newest["ATTITUDE"].yaw
    check("with the nose south", abs(wrap(yaw - math.pi)) < 0.15, yaw)
    lab.setpoint = None
    start = lab.vicon.pose[:2]
    lab.fly_for(6)
    way = math.dist(start, lab.vicon.pose[:2])
    check("a setpoint dies after 3 s and the vehicle stops", lab.speed() < 0.15, lab.speed())
    check("having coasted on until then", 3.0 < way < 6.5, way)
    start = lab.vicon.pose[:3]
    lab.fly_for(3)
    check("and stays there", math.dist(start, lab.vicon.pose[:3]) < 0.15)
    # Yaw ignored: a common mistake of companion programs.
    lab.setpoint = 0xDC7, (0, 0, 0, -1.0, 0, 0, 0, 0, 0, 0, 0)
    lab.fly_for(1)
    lab.setpoint = 0xDC7, (0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0)
    lab.fly_for(3)
    yaw = lab.newest["ATTITUDE"].yaw
    check("with yaw ignored the nose turns into travel", abs(wrap(yaw)) < 0.3, yaw)
    lab.setpoint = None


def land(lab):
    check("disarming in the air is refused", arm(lab, 0) == FAILED)
    check("LAND is accepted", lab.command(mavlink.MAV_CMD_NAV_LAND) == ACCEPTED)
    check("it lands and disarms by itself", lab.until(20, lambda: not lab.armed()), lab.texts)
    check("in mode 9 on the floor", lab.newest["HEARTBEAT"].custom_mode == 9 and not airborne(lab))
    report, status = lab.close()
    check(
        "the simulator's own report agrees",
        status == 0 and report and report["landed"] and not report["collided"]
        and report["max_speed_mps"] > 1.4,
        report,
    )


def other_links(command):
    for endpoint in ("tcpin", "udpin"):
        lab = Lab(command, endpoint, "--param", "FS_GCS_ENABLE=0")
        received = lab.until(10, lambda: lab.counts["HEARTBEAT"] > 1)
        lab.link.mav.param_request_read_send(1, 1, b"FS_GCS_ENABLE", -1)
        lab.until(3, lambda: "FS_GCS_ENABLE" in lab.params)
        value = lab.params.get("FS_GCS_ENABLE")
        check("%s: a client is served" % endpoint, received and value and value.param_value == 0)
        _, status = lab.close()
        check("%s: ends when its parent lets go" % endpoint, status == 0, status)


def main():
    command = sys.argv[1:]
    if not command:
        sys.exit(__doc__)
    lab = Lab(
        command, "udpout", "--seed", "5", "--spawn", "%g,%g,0,%g" % (*SPAWN, SPAWN_YAW_DEG)
    )
    try:
        before_flight(lab)
        position_comes(lab)
        fly_square(lab)
        fly_velocities(lab)
        land(lab)
    finally:
        lab.process.kill()
        lab.watchdog.cancel()
    other_links(command)
    print("%d passed, %d failed" % (passed, failed))
    return failed != 0


if __name__ == "__main__":
    sys.exit(main())
