#!/usr/bin/env python3
"""Sends a Crazyflie's own estimate (Loco, Lighthouse, flow deck) to VizFlyt. Needs `pip install cflib`.

    python3 crazyflie_pose.py radio://0/80/2M/E7E7E7E7E7 192.168.1.20:51002 vizflyt

The Crazyflie's world is z up, its body x forward, y left, z up, as VizFlyt's. Its log carries at most
26 bytes a packet: the compressed estimate, position in millimetres and the quaternion in 32 bits, fits, and
the variances of the position. A position with a standard deviation above 0.5 m is sent as not tracked.
"""
import json
import math
import socket
import sys

VARIANCES = ["kalman.var" + axis for axis in "XYZ"]
# The Crazyflie logs no variance of its attitude.
ROTATION_SIGMA_RAD = 0.02
MAX_SIGMA_M = 0.5


def unpacked(bits):
    """Returns x, y, z, w of stateEstimateZ.quat: index of the largest, then three of sign and 9 bits
    (quatcompress.h of the firmware)."""
    largest = bits >> 30
    q, squares = [0.0] * 4, 0.0
    for index in range(3, -1, -1):
        if index != largest:
            magnitude = bits & 0x1FF
            negative = (bits >> 9) & 1
            bits >>= 10
            q[index] = math.sqrt(0.5) * magnitude / 0x1FF * (-1 if negative else 1)
            squares += q[index] ** 2
    q[largest] = math.sqrt(max(0.0, 1.0 - squares))
    return q


def packet(object_name, seq, timestamp_ms, data):
    """Returns the bytes of a pose packet from one record of the log."""
    # stateEstimateZ counts millimetres.
    position = [data["stateEstimateZ." + axis] / 1000.0 for axis in "xyz"]
    pose = {
        "vizflyt_pose": 1,
        "object": object_name,
        "seq": seq,
        "stamp_ns": timestamp_ms * 1_000_000,
        "position_m": position,
        "rotation_xyzw": unpacked(data["stateEstimateZ.quat"]),
    }
    variances = [data[name] for name in VARIANCES if name in data]
    if variances:
        sigmas = [math.sqrt(value) if value >= 0 else math.inf for value in variances]
        pose["tracked"] = all(sigma <= MAX_SIGMA_M for sigma in sigmas)
        if pose["tracked"]:
            pose["position_sigma_m"] = [max(sigma, 1e-3) for sigma in sigmas]
            pose["rotation_sigma_rad"] = [ROTATION_SIGMA_RAD] * 3
    return json.dumps(pose).encode()


def main(uri, server, object_name="vizflyt"):
    import cflib.crtp
    from cflib.crazyflie import Crazyflie
    from cflib.crazyflie.log import LogConfig
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
    from cflib.crazyflie.syncLogger import SyncLogger

    host, _, port = server.rpartition(":")
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    log = LogConfig(name="pose", period_in_ms=10)
    for axis in "xyz":
        log.add_variable("stateEstimateZ." + axis, "int16_t")
    log.add_variable("stateEstimateZ.quat", "uint32_t")
    cflib.crtp.init_drivers()
    with SyncCrazyflie(uri, cf=Crazyflie(rw_cache="./cache")) as crazyflie:
        for name in VARIANCES:
            # Only the Kalman estimator has them.
            if crazyflie.cf.log.toc.get_element_by_complete_name(name) is not None:
                log.add_variable(name, "float")
        with SyncLogger(crazyflie, log) as records:
            for seq, (timestamp_ms, data, _) in enumerate(records):
                udp.sendto(packet(object_name, seq, timestamp_ms, data), (host, int(port)))


if __name__ == "__main__":
    main(*sys.argv[1:])
