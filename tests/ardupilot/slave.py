"""Reads the true position of the vehicle from an ArduCopter in SITL, and sends it on.

With `--slave 1` SITL sends the state of each physics step to another program as JSON, and waits for an answer: this
interface is meant for a second flight controller, whose outputs SITL ignores. This program answers at once, and so gets
positions at full precision with their times; positions by MAVLink are rounded to centimetres. It is a separate process,
because SITL waits for it.

Usage: slave.py OUT X,Y,Z    OUT is the destination of the poses, as JSON packets; X,Y,Z the vehicle's start [m, world]
"""

import json
import math
import select
import socket
import struct
import sys

# Port on which SITL receives its first slave's outputs; fixed in SITL, so that only one SITL can run at a time.
PORT = 9012
# Magic, frame rate, frame count, 16 outputs.
ANSWER = struct.Struct("<HHI16H")
MAGIC = 18458
PERIOD_NS = 5_000_000
# Number of answers sent ahead, so that SITL does not wait until this process is scheduled.
AHEAD = 100
HALF = math.sqrt(0.5)


def body_to_world(w, x, y, z):
    """Converts a quaternion from forward-right-down in north-east-down, wxyz, to forward-left-up in east-north-up,
    xyzw."""
    w, x, y, z = -x, w, z, -y
    return HALF * (w + z), HALF * (w - z), HALF * (y - x), -HALF * (x + y)


def main():
    host, port = sys.argv[1].rsplit(":", 1)
    start = [float(number) for number in sys.argv[2].split(",")]
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.connect((host, int(port)))
    sitl = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sitl.bind(("127.0.0.1", 0))
    sitl.setblocking(False)
    count, sent_ns, first, parent = 0, -PERIOD_NS, None, sys.stdin.fileno()

    def answer():
        nonlocal count
        count += 1
        sitl.sendto(ANSWER.pack(MAGIC, 400, count, *[1000] * 16), ("127.0.0.1", PORT))

    while True:
        ready = select.select([sitl, parent], [], [], 0.1)[0]
        # Standard input closes when the parent ends.
        if parent in ready:
            return
        try:
            data = sitl.recv(2048)
        except BlockingIOError:
            # SITL has not started, or has lost count: send the answer again.
            answer()
            continue
        except ConnectionError:
            continue
        for _ in range(AHEAD if first is None else 1):
            answer()
        stamp_ns = int(float(data[data.index(b":") + 1 : data.index(b",")]) * 1e9)
        if first is not None and stamp_ns - sent_ns < PERIOD_NS:
            continue
        sent_ns = stamp_ns
        state = json.loads(data)
        north, east, down = state["position"]
        if first is None:
            first = north, east, down
        p = start[0] + east - first[1], start[1] + north - first[0], start[2] + first[2] - down
        packet = {"vizflyt_pose": 1, "object": "vizflyt", "stamp_ns": stamp_ns, "clock": "sender",
                  "position_m": p, "rotation_xyzw": body_to_world(*state["quaternion"])}
        try:
            out.send(json.dumps(packet).encode())
        except ConnectionError:
            return


if __name__ == "__main__":
    main()
