"""A flight: the real render server and runtime, with a vehicle from another project."""

import contextlib
import json
import os
import pathlib
import re
import signal
import subprocess
import threading
import time

from checks import Failed, say, wait
from poses import Poses
from wire import Station, Wire

# Timeout of any step on a loaded machine. [s]
PATIENCE_S = 90
SPAWN = (0.9, 0.0, 0.0)


class Program:
    """A child process that prints JSON lines."""

    def __init__(self, log, arguments):
        self.lines, self.log = [], log
        with open(log, "w") as errors:
            self.process = subprocess.Popen(
                [str(argument) for argument in arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
                text=True, start_new_session=True, cwd=log.parent)
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        lines = open(self.log.with_suffix(".jsonl"), "w", buffering=1)
        for line in self.process.stdout:
            lines.write("%.3f %s" % (time.monotonic(), line))
            with contextlib.suppress(ValueError):
                self.lines.append((time.monotonic(), json.loads(line)))

    def line(self, key, within_s=PATIENCE_S):
        find = lambda: next((line for _, line in list(self.lines) if key in line), None)
        wait(f"a line with {key!r}", lambda: find() or self.process.poll() is not None, within_s)
        if not find():
            raise Failed(f"it ended without a line with {key!r}: {self.log.read_text()[-300:]}")
        return find()

    def has(self, words):
        return any(words in json.dumps(line, ensure_ascii=False) for _, line in list(self.lines))

    def send(self, number):
        self.process.send_signal(number)

    def close(self):
        # Including its remaining child processes.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class Lab:
    """Shared setup of all flights: a scene, keys of server and runtime, a configured vehicle."""

    def __init__(self, folder, vizflyt, plugin, vehicle):
        self.folder, self.vizflyt, self.plugin, self.vehicle = pathlib.Path(folder), vizflyt, plugin, vehicle
        # As root, the plugin runs as another user, who needs access to the folder.
        self.folder.chmod(0o755)
        subprocess.run([vizflyt, "scene", "generate", "room", "--force", "-o", self.folder / "room"], check=True,
                       stdout=subprocess.DEVNULL)
        self.plain = (self.folder / "room/arena.toml").read_text()
        self.arena(SPAWN)
        vehicle.prepare(self.folder / "room/arena.toml")
        server = self.serve("0", "--pair", "team:vizflyt")
        code = server.line("pairing")["pairing"]["code"].replace(" ", "")
        pair = [vizflyt, "pair", server.line("ready")["quic"], "--code", code, "--keys", self.folder / "jetson"]
        subprocess.run(pair, check=True, stdout=subprocess.DEVNULL)
        server.close()

    def arena(self, spawn, yaw_deg=0):
        """Writes the arena for a flight from `spawn`: small images, and a goal off the path."""
        values = {
            "width_px": 96, "height_px": 72,
            "position_m": [[*spawn], [0.5, 2.0, 3.2], None], "yaw_deg": yaw_deg, "radius_m": 0.01,
            "min_m": [None, [spawn[0] - 0.5, spawn[1] - 0.5, -0.5]],
            "max_m": [None, [spawn[0] + 0.5, spawn[1] + 0.5, 1.0]],
        }
        text = self.plain
        for key, value in values.items():
            each = iter(value if isinstance(value, list) else [value])
            # For a key that occurs several times: its values in order; None keeps the existing value.
            text = re.sub(rf"(?m)^{key} = .*$",
                          lambda m: m[0] if (new := next(each, None)) is None else f"{key} = {new}", text)
        (self.folder / "room/arena.toml").write_text(text)
        fence = re.search(r"\[geofence\]\nmin_m = (.*)\nmax_m = (.*)", text)
        return json.loads(fence[1]), json.loads(fence[2])

    def serve(self, port, *more):
        return Program(self.folder / "serve.log", [
            self.vizflyt, "serve", self.folder / "room/arena.toml", "--json", "--lifeline", f"--quic=127.0.0.1:{port}",
            "--http=127.0.0.1:0", "--pose=json:127.0.0.1:0", "--renderer=cpu", "--max-rate=20", "--leaderboard=none",
            "--keys", self.folder / "server", *more])


class Flight:
    """One flight with the plugin in its mode `how`."""

    def __init__(self, lab, how, spawn=SPAWN, system=254):
        self.spawn = spawn
        self.fence = lab.arena(spawn)
        self.poses, self.wire = Poses(), Wire()
        # An autopilot forwards a station's messages between its ports; the simulator does not.
        self.station = Station(system, None if lab.vehicle.is_real else self.wire.tell_runtime)
        self.vehicle = lab.vehicle.start(self.poses, self.wire, self.station, spawn, 0)
        self.server = lab.serve(0)
        ready = self.server.line("ready")
        host, port = ready["pose"][0]["address"].rsplit(":", 1)
        self.poses.server = (host, int(port))
        self.runtime = Program(lab.folder / "fly.log", [
            lab.vizflyt, "fly", "--json", "--mavlink=udpin:127.0.0.1:0", "--server", ready["quic"],
            "--fingerprint", ready["fingerprint"], "--keys", lab.folder / "jetson", "--no-config",
            "--ready-within=100", "--log-dir", lab.folder / "flights", lab.plugin, "--", how])
        host, port = self.runtime.line("mavlink")["mavlink"].rsplit(":", 1)
        self.wire.runtime = (host, int(port))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if note := self.poses.unsteady():
            say(f"note  {note}")
        for part in (self.runtime, self.server, self.vehicle, self.station, self.wire, self.poses):
            part.close()

    def until(self, what, done, within_s=PATIENCE_S):
        """Waits for a condition while the runtime runs."""
        seen = lambda: done() or self.runtime.process.poll() is not None
        wait(what, seen, within_s)
        if not done():
            raise Failed("the runtime ended before %s: %s" % (what, self.said()))

    def height_m(self):
        return self.poses.now().p[2] if self.poses.track else 0.0

    def phase(self, name):
        return self.runtime.has(f'"phase": "{name}"}}')

    def said(self):
        """Returns the runtime's latest event."""
        events = [line["event"]["text"] for _, line in list(self.runtime.lines) if "event" in line]
        return "; ".join(events[-3:]) or "nothing"
