"""Tests `vizflyt bridge emulate` with a simulated vehicle: a serial line at a real baud rate on one side, ground
stations on the other, one of which never reads. Counts received and lost packets as a station does.

Usage: bridge.py [--soak SECONDS] VIZFLYT BAUD COMMAND...     COMMAND starts the simulator
    Without --soak: loads all parameters, sends a mission and reads it back while another client
    stalls. With --soak: runs for SECONDS; the bridge's memory must not grow.
"""

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time

from lab import mavlink, mavutil
from square import Checks, until

HERE = os.path.dirname(os.path.abspath(__file__))
# Below this free buffer a vehicle slows its streams (ArduPilot's GCS_MAVLINK::handle_radio_status: 20 and 50; back at
# 90).
ROOM = 90
# ATTITUDE and LOCAL_POSITION_NED at 50 Hz, which a companion computer needs to fly.
STREAMS = [30, 32]
# A client that reads nothing must be dropped before the listener has received this many more packets. The bridge's
# timeout is 5 s, about 500 packets; the rest covers the kernel's buffers and the client's heartbeat each second.
DROPPED_WITHIN = 6000
# Timeout for a connection that receives nothing. [s]
HANGS = 300
# Tolerance for a program in steady state, whose heap pages come and go. [KiB]
GROWTH_KIB = 512


class Watcher:
    """A ground station that only listens; pymavlink counts the lost packets."""

    def __init__(self, address):
        self.link = mavutil.mavlink_connection(
            "udpout:%s" % address, source_system=250, source_component=190
        )
        self.beat = 0.0
        self.rooms = []
        self.newest = {}
        self.is_over = False
        self.thread = threading.Thread(target=self.listen, daemon=True)
        self.thread.start()

    def listen(self):
        while not self.is_over:
            self.work()

    def work(self):
        if time.monotonic() - self.beat > 1:
            self.beat = time.monotonic()
            mav = self.link.mav
            mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4)
            for number in STREAMS:
                mav.command_long_send(
                    1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, 20000, 0, 0, 0, 0, 0
                )
        message = self.link.recv_match(blocking=True, timeout=0.02)
        while message:
            kind = message.get_type()
            self.newest[kind] = message
            if kind == "RADIO_STATUS":
                self.rooms.append(message.txbuf)
            message = self.link.recv_match(blocking=False)

    def close(self):
        self.is_over = True
        self.thread.join()

    def lost(self):
        return self.link.mav_loss


class Stalled:
    """A TCP client that sends a heartbeat every second, as every station does, and never reads."""

    def __init__(self, address):
        host, port = address.split(":")
        self.socket = socket.socket()
        # Keep the kernel's receive buffer small.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.socket.connect((host, int(port)))
        self.mav = mavlink.MAVLink(None, srcSystem=249, srcComponent=190)
        self.beat = 0.0
        self.dropped = False
        self.is_dropped()

    def is_dropped(self):
        """Returns whether the bridge has closed the connection, without reading. The RST may lie beyond this side's
        full receive window, and the kernel ignores such an RST (RFC 5961): a client notices it with its next send."""
        if self.dropped:
            return True
        if time.monotonic() - self.beat > 1:
            self.beat = time.monotonic()
            hello = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
            try:
                self.socket.sendall(hello.pack(self.mav))
            except ConnectionError:
                self.dropped = True
        poll = select.poll()
        poll.register(self.socket, 0)
        self.dropped = self.dropped or bool(poll.poll(0))
        return self.dropped


class Rig:
    """The bridge, the vehicle on its serial line, its pose feed, and a stalled client."""

    def __init__(self, vizflyt, baud, command, seed):
        self.folder = tempfile.TemporaryDirectory()
        self.processes = []
        uart = os.path.join(self.folder.name, "uart")
        self.bridge, ready = self.start(
            [vizflyt, "bridge", "emulate", "--json", "--lifeline", "--uart", "pty:" + uart,
             "--listen", "127.0.0.1:0", "--tcp", "127.0.0.1:0", "--baud", str(baud)]
        )
        self.udp, self.tcp = ready["udp"], ready["tcp"]
        feed = subprocess.Popen(
            [sys.executable, os.path.join(HERE, "feed.py"), "0", "udpout:" + self.udp],
            stdout=subprocess.PIPE,
            text=True,
        )
        self.processes.append(feed)
        vicon = feed.stdout.readline().strip()
        self.simulator, _ = self.start(
            [*command, "--json", "--lifeline", "--realistic-startup", "--serial", uart, "--baud", str(baud),
             "--vicon", vicon, "--seed", str(seed)]
        )
        self.watcher = Watcher(self.udp)
        self.stalled = Stalled(self.tcp)

    def start(self, command):
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.processes.append(process)
        return process, json.loads(process.stdout.readline())

    def judge(self, check):
        """Checks what every station must have received at the end."""
        watcher = self.watcher
        until(lambda: len(watcher.rooms) > 3, HANGS)
        # Measured in packets sent to others instead of time: a bridge without processor time sends and drops later.
        end = watcher.link.mav_count + DROPPED_WITHIN
        until(lambda: self.stalled.is_dropped() or watcher.link.mav_count > end, HANGS)
        check("the client that never reads was dropped", self.stalled.dropped)
        check("a listener lost none of %d packets" % watcher.link.mav_count, watcher.lost() == 0,
              watcher.lost())
        rooms = watcher.rooms
        check("nobody was throttled: room never below %d %%" % min(rooms), min(rooms) >= ROOM, rooms)

    def report(self):
        """Stops the simulator and the bridge; returns the report of each."""
        reports = []
        for process in (self.simulator, self.bridge):
            process.stdin.close()
            lines = [json.loads(line) for line in process.stdout]
            reports.append(lines[-1]["report"])
        return reports

    def close(self):
        self.watcher.close()
        for process in self.processes:
            process.kill()
            process.wait()
        self.folder.cleanup()


class Station:
    """A pymavlink station that sends requests."""

    def __init__(self, address):
        self.link = mavutil.mavlink_connection("udpout:%s" % address, source_system=251)
        self.params = {}
        self.requests = []
        self.acks = []
        self.items = {}
        self.beat = 0.0
        self.ftp = False

    def work(self):
        if time.monotonic() - self.beat > 1:
            self.beat = time.monotonic()
            self.link.mav.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4
            )
        message = self.link.recv_match(blocking=True, timeout=0.02)
        while message:
            kind = message.get_type()
            mine = getattr(message, "target_system", 251) == 251
            if message.get_srcComponent() == 1 and mine:
                if kind == "PARAM_VALUE":
                    self.params[message.param_index] = message.param_count
                elif kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
                    self.requests.append(message.seq)
                elif kind == "MISSION_ACK":
                    self.acks.append(message.type)
                elif kind == "MISSION_COUNT":
                    self.items["count"] = message.count
                elif kind == "MISSION_ITEM_INT":
                    self.items[message.seq] = (message.x, message.y)
                elif kind == "FILE_TRANSFER_PROTOCOL":
                    self.ftp = True
            message = self.link.recv_match(blocking=False)

    def until(self, done, seconds=30.0):
        return until(done, seconds, self.work)

    def load_params(self):
        """Loads the parameter list as every station does: missing parameters are requested again by index."""
        start = time.monotonic()
        self.link.mav.param_request_list_send(1, 1)
        whole = lambda: self.params and len(self.params) == next(iter(self.params.values()))
        self.until(whole, 60)
        return bool(whole()), len(self.params), time.monotonic() - start

    def asks_ftp(self):
        """Returns whether any component answers MAVLink FTP."""
        name = b"@PARAM/param.pck"
        payload = bytes([0, 0, 0, 4, len(name), 0, 0, 0, 0, 0, 0, 0]) + name
        self.link.mav.file_transfer_protocol_send(0, 1, 1, payload.ljust(251, b"\0"))
        return self.until(lambda: self.ftp, 3)

    def send_mission(self, points, kind, command):
        """Sends mission items one by one as they are requested; returns the acknowledgement."""
        self.requests.clear()
        self.acks.clear()
        mav = self.link.mav
        mav.mission_count_send(1, 1, len(points), kind)
        end = time.monotonic() + 60
        while not self.acks and time.monotonic() < end:
            self.until(lambda: self.requests or self.acks, 2)
            for seq in self.requests:
                x, y = points[seq]
                mav.mission_item_int_send(
                    1, 1, seq, mavlink.MAV_FRAME_GLOBAL, command, 0, 1, len(points), 0, 0, 0, x, y, 0, kind
                )
            self.requests.clear()
        return self.acks[0] if self.acks else None

    def read_mission(self, kind):
        """Requests the items one by one; returns their positions."""
        self.items.clear()
        mav = self.link.mav
        mav.mission_request_list_send(1, 1, kind)
        self.until(lambda: "count" in self.items)
        count = self.items.get("count", 0)
        for seq in range(count):
            for _ in range(5):
                mav.mission_request_int_send(1, 1, seq, kind)
                if self.until(lambda: seq in self.items, 2):
                    break
        mav.mission_ack_send(1, 1, mavlink.MAV_MISSION_ACCEPTED, kind)
        return [self.items.get(seq) for seq in range(count)]


def transfers(check, rig):
    """Transfers parameters and a mission as ground stations do."""
    station = Station(rig.udp)
    alive = lambda: "HEARTBEAT" in rig.watcher.newest
    check("connects", until(alive, 30))
    whole, count, seconds = station.load_params()
    check("all %d parameters come, in %.1f s" % (count, seconds), whole and count >= 30, count)
    if not station.asks_ftp():
        print("--    %s: files are not served by this vehicle; ArduCopter's are" % check.client)
    points = [(423000000 + 9000 * (i % 2), -718000000 + 300 * i) for i in range(20)]
    points += [(423009000 + 9000 * (i % 2), -717990000 - 300 * i) for i in range(20)]
    fence, corner = mavlink.MAV_MISSION_TYPE_FENCE, mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
    sent = station.send_mission(points, fence, corner)
    check("a mission of %d items is taken" % len(points), sent == mavlink.MAV_MISSION_ACCEPTED, sent)
    read = station.read_mission(fence)
    check("and comes back as it was", read == points, read[:3])
    # A station that pauses loses the packets of that time: only the listener's loss is checked.
    check("the station that asked lost none", station.link.mav_loss == 0, station.link.mav_loss)


def memory_kib(process):
    with open("/proc/%d/status" % process.pid, encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))


def soak(check, rig, seconds):
    """Runs for `seconds`; the bridge's memory must not grow after the first minute."""
    watcher = rig.watcher
    start = time.monotonic()
    time.sleep(min(60.0, seconds / 2))
    before = memory_kib(rig.bridge)
    time.sleep(seconds - (time.monotonic() - start))
    after = memory_kib(rig.bridge)
    took = time.monotonic() - start
    check("soaked for %d s, %d packets; memory %d -> %d KiB" % (took, watcher.link.mav_count, before, after),
          after - before <= GROWTH_KIB, after - before)


def main():
    args = sys.argv[1:]
    seconds = 0.0
    if args[:1] == ["--soak"] and len(args) > 1:
        seconds = float(args[1])
        args = args[2:]
    if len(args) < 3:
        sys.exit(__doc__)
    vizflyt, baud, command = args[0], int(args[1]), args[2:]
    check = Checks("bridge at %d" % baud)
    rig = Rig(vizflyt, baud, command, 21)
    try:
        if seconds:
            soak(check, rig, seconds)
        else:
            transfers(check, rig)
        rig.judge(check)
        _, bridge = rig.report()
        lost = {name: bridge[name] for name in ("uart_lost", "uart_bad_checksum", "net_lost")}
        check("the bridge itself lost none", not any(lost.values()), bridge)
        check("the bridge counts one dropped client", bridge["stalled_clients"] == 1, bridge["stalled_clients"])
    finally:
        rig.close()
    check.end()


if __name__ == "__main__":
    main()
