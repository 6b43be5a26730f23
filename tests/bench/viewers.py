"""A running server with incoming poses and open pages: its resource usage per unit of work.

On a busy computer a server gets fewer poses and sends fewer pictures, so its time is given per hundred poses of each
vehicle, and per picture of each camera to each page.
"""

import base64
import json
import os
import selectors
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

import machine

BINARY = 2


class Taken(NamedTuple):
    """The server's processor time [ms] and resident memory [MB], with its work in this time: poses received for each
    vehicle, and pictures sent to all pages together."""

    processor_ms: float
    resident_mb: float
    poses: int
    pictures: int


class Sender:
    """Sends a hundred poses a second for each vehicle, which hovers at the start of the flight."""

    def __init__(self, address: str, names: list[str]) -> None:
        host, _, port = address.rpartition(":")
        self.address, self.names, self.poses = (host, int(port)), names, 0
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.send)

    def __enter__(self) -> "Sender":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join()

    def send(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            while not self.stop.wait(0.01):
                self.poses += 1
                for number, name in enumerate(self.names):
                    packet = {"vizflyt_pose": 1, "object": name, "seq": self.poses, "stamp_ns": time.monotonic_ns(),
                              "position_m": [1.0 + 1e-3 * (self.poses % 100), 0.5 * number - 2.0, 1.2],
                              "rotation_xyzw": [0.0, 0.0, 0.0, 1.0]}
                    udp.sendto(json.dumps(packet).encode(), self.address)


class Page:
    """A page's WebSocket (RFC 6455): counts the pictures received."""

    def __init__(self, address: str, vehicle: str) -> None:
        host, _, port = address.rpartition(":")
        self.socket = socket.create_connection((host, int(port)), timeout=10)
        self.buffer, self.pictures = b"", 0
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [f"GET /ws?vehicle={vehicle} HTTP/1.1", f"Host: {address}", f"Origin: http://{address}",
                 "Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}"]
        self.socket.sendall("\r\n".join([*lines, "", ""]).encode())
        while b"\r\n\r\n" not in self.buffer:
            self.receive()
        head, _, self.buffer = self.buffer.partition(b"\r\n\r\n")
        if not head.startswith(b"HTTP/1.1 101"):
            raise ConnectionError(f"the server declines a page: {head.decode(errors='replace')}")

    def receive(self) -> None:
        data = self.socket.recv(1 << 18)
        if not data:
            raise ConnectionError("the server has closed a page's connection")
        self.buffer += data

    def read(self) -> None:
        self.receive()
        pictures, self.buffer = frames(self.buffer)
        self.pictures += pictures


def frames(buffer: bytes) -> tuple[int, bytes]:
    """Returns the number of complete binary messages in the bytes of a server's WebSocket, and the bytes after the last
    complete one."""
    binary, at = 0, 0
    while len(buffer) - at >= 2:
        length, begin = buffer[at + 1] & 0x7F, at + 2
        if length >= 126:
            wide = 2 if length == 126 else 8
            length, begin = int.from_bytes(buffer[begin:begin + wide], "big"), begin + wide
        if len(buffer) < begin + length:
            break
        binary += buffer[at] & 0x0F == BINARY
        at = begin + length
    return binary, buffer[at:]


def serve(program: str, arena: Path, vehicles: int, pages: int, seconds: float) -> Taken:
    """Serves an arena with `vehicles` vehicles and `pages` open pages, distributed over the vehicles."""
    names = [f"v{number}" for number in range(vehicles)]
    command = [program, "serve", str(arena), "--quic", "127.0.0.1:0", "--http", "127.0.0.1:0", "--pose",
               "json:127.0.0.1:0", "--renderer", "cpu", "--lifeline", "--json"]
    command += [word for name in names for word in ("--vehicle", name)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            ready = json.loads(process.stdout.readline())
            with Sender(ready["pose"][0]["address"], names) as sender:
                address = ready["http"].removeprefix("http://")
                opened = [Page(address, names[number % vehicles]) for number in range(pages)]
                return watch(machine.Watched(process.pid), sender, opened, seconds)
        finally:
            process.stdin.close()


def watch(server: machine.Watched, sender: Sender, pages: list[Page], seconds: float) -> Taken:
    """Reads the data of all pages; skips the first second, in which caches fill."""
    with selectors.DefaultSelector() as selector:
        for page in pages:
            selector.register(page.socket, selectors.EVENT_READ, page)
        read(selector, 1.0)
        before = server.processor_s(), sender.poses, sum(page.pictures for page in pages)
        read(selector, seconds)
        after = server.processor_s(), sender.poses, sum(page.pictures for page in pages)
        taken = Taken((after[0] - before[0]) * 1e3, server.resident_mb(), after[1] - before[1], after[2] - before[2])
    for page in pages:
        page.socket.close()
    return taken


def read(selector: selectors.BaseSelector, seconds: float) -> None:
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        if not selector.get_map():
            time.sleep(left)
            continue
        for key, _ in selector.select(left):
            key.data.read()


def open_pages(address: str, vehicle: str, pages: int) -> None:
    """Opens pages on a server that may not have started yet, and reads until it ends."""
    deadline = time.monotonic() + 60
    while True:
        try:
            opened = [Page(address, vehicle)]
            break
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)
    opened += [Page(address, vehicle) for _ in range(pages - 1)]
    with selectors.DefaultSelector() as selector:
        for page in opened:
            selector.register(page.socket, selectors.EVENT_READ, page)
        try:
            while True:
                read(selector, 1.0)
        except ConnectionError:
            print(sum(page.pictures for page in opened))


if __name__ == "__main__":
    open_pages(sys.argv[1], sys.argv[2], int(sys.argv[3]))
