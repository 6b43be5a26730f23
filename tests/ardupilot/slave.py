"""Asks an ArduCopter in SITL where its vehicle truly is, and sends that on.

With `--slave 1` SITL shows every turn of its physics to another program, as JSON, and waits for an answer: that is
meant for a second flight controller riding along, whose outputs nobody uses. So this one answers at once, and the
positions come to the last bit, with the time they are of; what SITL says by MAVLink is cut to centimetres. A process
of its own, as SITL waits for it.

Usage: slave.py OUT X,Y,Z    OUT is where poses go, as JSON packets; X,Y,Z where the vehicle starts [m, world]
"""

import json
import math
import select
import socket
import struct
import sys

# Where SITL takes its first slave's outputs; fixed in it, so that one SITL runs at a time.
PORT = 9012
# Magic, frame rate, frame count, 16 outputs.
ANSWER = struct.Struct("<HHI16H")
MAGIC = 18458
PERIOD_NS = 5_000_000
# Answers under way ahead of it, so that SITL does not wait for this process to be scheduled.
AHEAD = 100
HALF = math.sqrt(0.5)


def body_to_world(w, x, y, z):
    """A quaternion from forward-right-down in north-east-down, wxyz, to forward-left-up in east-north-up, xyzw."""
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
        # Standard input closes with the parent.
        if parent in ready:
            return
        try:
            data = sitl.recv(2048)
        except BlockingIOError:
            # SITL has not begun, or has lost count: once more.
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
