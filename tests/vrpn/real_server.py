"""Reads a real VRPN server with `vizflyt doctor localization`; see `run` in this folder."""

import pathlib
import queue
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time

# A tracker with two sensors at the origin, and one that rotates about z.
TRACKERS = """vrpn_Tracker_NULL Tracker0 2 60.0
vrpn_Tracker_Spin wasp 1 100.0 0.0 0.0 1.0 0.25
"""
checks = 0


def check(condition: bool, what: str) -> None:
    """Counts a check that passed; ends the program at one that failed."""
    global checks
    if not condition:
        sys.exit(f"FAILED: {what}")
    checks += 1
    print(f"ok      {what}", flush=True)


class Server:
    """A running vrpn_server, only on loopback."""

    def __init__(self, program: str, config: pathlib.Path, port: int) -> None:
        command = [program, "-f", str(config), "-NIC", "127.0.0.1", str(port)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill(self) -> None:
        """Kills it, like a crash."""
        self.process.kill()
        self.process.wait()


class Doctor:
    """A running `vizflyt doctor localization --watch`, with its output as lines."""

    def __init__(self, program: str, pose: str) -> None:
        command = [program, "doctor", "localization", "--watch", "--pose", pose]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.rstrip())

    def until(self, pattern: str, within_s: float = 30.0) -> str:
        """Returns the next line that matches `pattern`, or an empty one after the timeout."""
        end = time.monotonic() + within_s
        while (left := end - time.monotonic()) > 0:
            try:
                line = self.lines.get(timeout=left)
            except queue.Empty:
                break
            if re.search(pattern, line):
                return line
        return ""

    def end(self) -> None:
        """Stops it."""
        self.process.terminate()
        self.process.wait()


def free_port() -> int:
    """Returns a free TCP port on loopback."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def main() -> None:
    vizflyt, program = sys.argv[1:3]
    port = free_port()
    at = f"vrpn:127.0.0.1:{port}"
    with tempfile.TemporaryDirectory() as folder:
        config = pathlib.Path(folder) / "vrpn.cfg"
        config.write_text(TRACKERS)

        doctor = Doctor(vizflyt, f"{at},objects.vizflyt=wasp")
        line = doctor.until(r"^note .*cannot connect to")
        check("refused" in line, "a missing server is named")
        server = Server(program, config, port)
        line = doctor.until(r"^pose ")
        check("at x 0.00, y 0.00" in line and "up is +z" in line, f"poses arrive: {line}")
        turned = {doctor.until(r"^pose ").split(",")[0] for _ in range(3)}
        check(len(turned) > 1, f"the tracker turns: {sorted(turned)}")
        server.kill()
        line = doctor.until(r"^note .*connection to .* was lost")
        check(line != "", f"a killed server is reported: {line}")
        server = Server(program, config, port)
        started = time.monotonic()
        line = doctor.until(r"^(pose|note) ")
        took_s = time.monotonic() - started
        check(line.startswith("pose"), f"reconnects {took_s:.1f} s after a restart: {line}")
        doctor.end()

        doctor = Doctor(vizflyt, at)
        line = doctor.until(r"^note .*asked for")
        check("'Tracker0', 'wasp' streams, but 'vizflyt' was asked for" in line, "other trackers are named")
        doctor.end()

        doctor = Doctor(vizflyt, f"{at},objects.vizflyt=Tracker0,sensor=7")
        line = doctor.until(r"^note .*set `sensor`")
        check("'Tracker0' reports sensor" in line, "another sensor is named")
        doctor.end()

        doctor = Doctor(vizflyt, f"{at},objects.vizflyt=Tracker0,sensor=1,units=mm,up=y")
        line = doctor.until(r"^pose ")
        check("up is" in line, f"a second sensor is read: {line}")
        doctor.end()
        server.kill()
    print(f"{checks} checks passed")


if __name__ == "__main__":
    main()
