"""Output that cannot be written: a full pipe, a full disk or a stopped terminal must not delay STOP, the guard or the
poses. See `run`."""

import contextlib
import json
import os
import pathlib
import socket
import subprocess
import tempfile
import termios
import time
import urllib.request

from checks import VIZFLYT, check, end, scene

# The goal is 50 ms; a loaded machine gets much longer. A blocked server did not answer for seconds.
STOP_WITHIN_S = 1.0
PRESSES = 20


class Running:
    """A running `vizflyt` with one descriptor as its standard output and standard error."""

    def __init__(self, arguments, output):
        self.process = subprocess.Popen([VIZFLYT, *map(str, arguments)], stdin=subprocess.PIPE, stdout=output,
                                        stderr=output)

    def end(self, within_s=20.0):
        """Asks the program to end; returns whether it does, with the pipe still full."""
        self.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(within_s)
            return True
        self.process.kill()
        self.process.wait()
        return False


class Unread(Running):
    """As [`Running`], with a pipe that is read only up to a line."""

    def __init__(self, *arguments):
        self.reader, self.writer = self.open()
        super().__init__(arguments, self.writer)
        self.text = ""

    @staticmethod
    def open():
        return os.pipe()

    def read_until(self, part, within_s=120.0):
        """Reads until `part` has been printed; returns its line."""
        until = time.monotonic() + within_s
        os.set_blocking(self.reader, False)
        while part not in self.text or "\n" not in self.text.split(part, 1)[1]:
            if time.monotonic() > until or self.process.poll() is not None:
                raise TimeoutError(f"'{part}' was not printed: {self.text[-2000:]}")
            with contextlib.suppress(BlockingIOError):
                self.text += os.read(self.reader, 65536).decode(errors="replace")
            time.sleep(0.01)
        before, after = self.text.split(part, 1)
        return before.rsplit("\n", 1)[-1] + part + after.split("\n", 1)[0]

    def fill(self):
        """Fills the pipe, so that the next write of the program blocks."""
        # Opened again: the program's end must stay a blocking one.
        full = os.open(f"/proc/self/fd/{self.writer}", os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(full, b"x" * 512)
        os.close(full)



def press(page):
    """Presses STOP; returns the time until the answer [s]."""
    request = urllib.request.Request(f"{page}/api/estop", data=b"", method="POST", headers={"Origin": page})
    began = time.monotonic()
    with contextlib.suppress(OSError), urllib.request.urlopen(request, timeout=10):
        pass
    return time.monotonic() - began


class Terminal(Unread):
    """As [`Unread`], at a terminal whose reader stops reading."""

    @staticmethod
    def open():
        return os.openpty()

    def fill(self):
        """Stops the terminal, as Ctrl-S does."""
        termios.tcflow(self.writer, termios.TCOOFF)


class FullDisk(Running):
    """As [`Running`], with a file on a full disk."""

    def __init__(self, *arguments):
        with open("/dev/full", "wb") as full:
            super().__init__(arguments, full)


def serves(page, within_s=120.0):
    """Waits until a page answers; returns whether it does."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        with contextlib.suppress(OSError), urllib.request.urlopen(page, timeout=10):
            return True
        time.sleep(0.05)
    return False


def serving_on_a_full_disk(folder, arena):
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = "{}:{}".format(*free.getsockname())
    page = f"http://{address}"
    server = FullDisk("serve", "--lifeline", "--renderer=cpu", "--quic=127.0.0.1:0", f"--http={address}",
                      "--vicon=127.0.0.1:0", "--leaderboard=none", "--keys", folder / "keys", arena)
    try:
        check("a server whose output is on a full disk serves", serves(page))
        took_s = sorted(press(page) for _ in range(PRESSES))
        print(f"      full disk: at most {took_s[-1] * 1e3:.1f} ms")
        check("STOP while the disk of the server's output is full", took_s[-1] < STOP_WITHIN_S,
              f"took {[round(s, 2) for s in took_s]} s")
    finally:
        has_ended = server.end()
    check("a server whose output is on a full disk ends on SIGTERM", has_ended)


def serving(folder, arena, kind, how):
    server = kind("serve", "--json", "--lifeline", "--renderer=cpu", "--quic=127.0.0.1:0", "--http=127.0.0.1:0",
                  "--vicon=127.0.0.1:0", "--leaderboard=none", "--keys", folder / "keys", arena)
    try:
        page = json.loads(server.read_until('"ready"'))["http"].rstrip("/")
        server.fill()
        took_s = sorted(press(page) for _ in range(PRESSES))
        print(f"      {how}: at most {took_s[-1] * 1e3:.1f} ms")
        check(f"STOP beside {how} of the server", took_s[-1] < STOP_WITHIN_S,
              f"took {[round(s, 2) for s in took_s]} s")
    finally:
        has_ended = server.end()
    check(f"a server ends on SIGTERM beside {how}", has_ended)


def flying(folder, kind, how):
    report = folder / "report.json"
    report.unlink(missing_ok=True)
    demo = kind("demo", "--headless", "--max-rate=40", "--seconds=8", "--log=none", "--report", report)
    try:
        if isinstance(demo, Unread):
            demo.read_until("the plugin flies")
            demo.fill()
        demo.process.wait(60)
    except subprocess.TimeoutExpired:
        check(f"a flight ends beside {how}", False)
    finally:
        demo.end()
    outcome = json.loads(report.read_text()) if report.exists() else {}
    check(f"a flight goes on to its end beside {how}", outcome.get("outcome") in ("landed", "finished"),
          f"{outcome.get('outcome')}: {outcome.get('reason')}")


with tempfile.TemporaryDirectory() as name:
    place = pathlib.Path(name)
    course = scene(place)
    for unread, how in ((Unread, "a full pipe"), (Terminal, "a stopped terminal")):
        serving(place, course, unread, how)
    serving_on_a_full_disk(place, course)
    outputs: list[tuple[type[Running], str]] = [
        (Unread, "a full pipe"), (Terminal, "a stopped terminal"), (FullDisk, "a full disk"),
    ]
    for output, how in outputs:
        flying(place, output, how)
end()
