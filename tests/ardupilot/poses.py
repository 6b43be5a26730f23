"""The motion capture: receives the vehicle's true positions, records them, and sends them on as measured poses.

The truth arrives as the JSON packets that `vizflyt serve` reads poses from, at any rate; at most 100 a second are sent
on, each with noise of half a millimetre.
"""

import bisect
import itertools
import json
import math
import random
import socket
import threading
import time
from typing import NamedTuple

RATE_HZ = 100
NOISE_M = 0.0005
# A runtime holds after 150 ms without a pose.
UNSTEADY_S = 0.1


class Sight(NamedTuple):
    at: float # time of receipt, on this computer's clock [s]
    stamp_s: float # time of the position, on the vehicle's clock [s]
    p: tuple # position of the body [m, world]


class Poses(threading.Thread):
    def __init__(self):
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.address = "127.0.0.1:%d" % self.socket.getsockname()[1]
        self.server = None
        self.cut = False
        self.track = []
        self.random = random.Random(1)
        self.start()

    def run(self):
        while data := self.socket.recv(4096):
            packet = json.loads(data)
            stamp_s = packet["stamp_ns"] * 1e-9
            if self.track and stamp_s - self.track[-1].stamp_s < 0.9 / RATE_HZ:
                continue
            self.track.append(Sight(time.monotonic(), stamp_s, tuple(packet["position_m"])))
            if self.server and not self.cut:
                noisy = [self.random.gauss(x, NOISE_M) for x in packet["position_m"]]
                self.socket.sendto(json.dumps({**packet, "position_m": noisy}).encode(), self.server)

    def close(self):
        # An empty datagram ends the thread.
        self.socket.sendto(b"", self.socket.getsockname())
        self.join()
        self.socket.close()

    def now(self):
        return self.track[-1]

    def since(self, stamp_s):
        return self.track[bisect.bisect_left(self.track, stamp_s, key=lambda sight: sight.stamp_s) :]

    def stamp_s(self, at):
        """Returns the vehicle's time at the local time `at`. [s]"""
        index = bisect.bisect_left(self.track, at, key=lambda sight: sight.at)
        return self.track[min(index, len(self.track) - 1)].stamp_s

    def unsteady(self):
        """Returns how unevenly the vehicle's clock ran, if it did: then the machine was overloaded and the figures do
        not count."""
        if len(self.track) < RATE_HZ:
            return ""
        # Skip the first second, the start.
        track = self.track[RATE_HZ:]
        gap_s = max((b.at - a.at for a, b in itertools.pairwise(track)), default=0.0)
        ratio = (track[-1].stamp_s - track[0].stamp_s) / max(track[-1].at - track[0].at, 1e-3)
        if gap_s < UNSTEADY_S and ratio > 0.95:
            return ""
        note = "a busy machine: the vehicle's clock stood still for %.0f ms, and ran at %.2f of ours"
        return note % (gap_s * 1e3, ratio)

    def speed_mps(self):
        """Returns the horizontal speed over the last tenth of a second. [m/s]"""
        if len(self.track) <= RATE_HZ // 10:
            return 0.0
        before, now = self.track[-1 - RATE_HZ // 10], self.track[-1]
        return level_m(before.p, now.p) / max(now.stamp_s - before.stamp_s, 1e-3)


def level_m(a, b):
    return math.dist(a[:2], b[:2])
