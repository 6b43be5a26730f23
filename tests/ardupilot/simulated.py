"""This project's simulator in place of the autopilot: tests the checks themselves, and shows differences."""

import json
import subprocess

from checks import wait
from sitl import doctor
from wire import Station


class Simulated:
    """The simulator, started once for each flight."""

    is_real = False

    def __init__(self, binary, folder, vizflyt, more):
        self.binary, self.folder, self.vizflyt, self.more = binary, folder, vizflyt, more
        self.parameters = []

    def prepare(self, arena):
        """Configures it with the doctor too; it loses its parameters at its end, so every flight starts with the same
        ones."""
        station = Station()
        with RunningSimulator(self, [f"--mavlink=udpout:{station.address}", "--mavlink=tcpin:127.0.0.1:0"]) as running:
            wait("the simulator's heartbeat", lambda: "HEARTBEAT" in station.newest, 30)
            before = station.all_parameters()
            doctor(self.vizflyt, f"tcpout:{running.ready['links'][1]}", self.folder, "--arena", arena)
            station.parameters.clear()
            after = station.all_parameters()
        station.close()
        self.parameters = [f"--param={name}={value:g}" for name, value in after.items() if before.get(name) != value]
        self.parameters += [f"--param={one}" for one in self.more]

    def start(self, poses, wire, station, spawn, yaw_deg):
        links = [f"--mavlink=udpout:{wire.air}", f"--mavlink=udpout:{station.address}"]
        place = "--spawn=%g,%g,%g,%g" % (*spawn, yaw_deg)
        return RunningSimulator(self, [*links, f"--truth-to={poses.address}", place, "--radio", *self.parameters])


class RunningSimulator:
    def __init__(self, simulator, arguments):
        with open(simulator.folder / "simulator.log", "w") as log:
            self.process = subprocess.Popen(
                [simulator.binary, "--json", "--lifeline", "--realistic-startup", *arguments], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=log, text=True)
        self.ready = json.loads(self.process.stdout.readline())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def lift(self):
        """Does nothing: the simulator has no transmitter."""

    def close(self):
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()
