"""MAVLink between vehicle and runtime, forwarded here so that it can be cut; and a parallel ground station."""

import contextlib
import select
import socket
import threading
import time
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# Commands that change the mode. A runtime sends none of them after the pilot's takeover.
MODE_COMMANDS = {
    mavlink.MAV_CMD_DO_SET_MODE: "DO_SET_MODE",
    mavlink.MAV_CMD_NAV_LAND: "NAV_LAND",
    mavlink.MAV_CMD_NAV_TAKEOFF: "NAV_TAKEOFF",
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: "NAV_RETURN_TO_LAUNCH",
    mavlink.MAV_CMD_NAV_GUIDED_ENABLE: "NAV_GUIDED_ENABLE",
    mavlink.MAV_CMD_MISSION_START: "MISSION_START",
}
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


class Beat(NamedTuple):
    at: float  # [s]
    mode: int
    armed: bool


class Order(NamedTuple):
    at: float  # [s]
    name: str
    mode: int # of DO_SET_MODE and SET_MODE


def udp():
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.bind(("127.0.0.1", 0))
    return end


def parser():
    reader = mavlink.MAVLink(None)
    reader.robust_parsing = True
    return reader


class Wire(threading.Thread):
    """Forwards datagrams between the vehicle, which sends to `air`, and the runtime."""

    def __init__(self):
        super().__init__(daemon=True)
        self.sides = udp(), udp()
        self.air = "127.0.0.1:%d" % self.sides[0].getsockname()[1]
        self.vehicle = None
        self.runtime = None
        self.cut = False
        self.beats = []
        self.orders = []
        self.texts = []
        self.running = True
        self.start()

    def run(self):
        down, up = parser(), parser()
        while self.running:
            for side in select.select(self.sides, [], [], 0.2)[0]:
                try:
                    data, sender = side.recvfrom(4096)
                except ConnectionError:
                    continue # the runtime has ended
                is_vehicle = side is self.sides[0]
                for message in (down if is_vehicle else up).parse_buffer(data) or []:
                    (self.of_vehicle if is_vehicle else self.of_runtime)(message)
                if is_vehicle:
                    self.vehicle = sender
                target = self.runtime if is_vehicle else self.vehicle
                if target and not self.cut:
                    with contextlib.suppress(ConnectionError):
                        self.sides[is_vehicle].sendto(data, target)

    def of_vehicle(self, message):
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.get_srcComponent() == 1 and message.autopilot != 8:
            beat = Beat(time.monotonic(), message.custom_mode, bool(message.base_mode & ARMED))
            self.beats.append(beat)
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)

    def of_runtime(self, message):
        kind = message.get_type()
        if kind in ("COMMAND_LONG", "COMMAND_INT") and message.command in MODE_COMMANDS:
            self.orders.append(Order(time.monotonic(), MODE_COMMANDS[message.command], int(message.param2)))
        elif kind == "SET_MODE":
            self.orders.append(Order(time.monotonic(), kind, message.custom_mode))

    def mode(self):
        return self.beats[-1].mode if self.beats else None

    def armed(self):
        return bool(self.beats) and self.beats[-1].armed

    def tell_runtime(self, packet):
        """Sends the runtime a packet as if from the radio, but not from the vehicle."""
        if self.runtime and not self.cut:
            self.sides[1].sendto(packet, self.runtime)

    def close(self):
        self.running = False
        self.join()
        for side in self.sides:
            side.close()


class Station(threading.Thread):
    """A ground station on its own link with the id `system`; `heard` is called for its heartbeats as well."""

    def __init__(self, system=254, heard=None):
        super().__init__(daemon=True)
        self.socket = udp()
        self.address = "127.0.0.1:%d" % self.socket.getsockname()[1]
        self.vehicle, self.heard = None, heard
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
        self.newest = {}
        self.parameters = {}
        self.acks = {}
        self.texts = []
        self.running = True
        self.start()

    def run(self):
        reader, beaten = parser(), 0.0
        while self.running:
            if select.select([self.socket], [], [], 0.1)[0]:
                data, self.vehicle = self.socket.recvfrom(4096)
                for message in reader.parse_buffer(data) or []:
                    self.take(message)
            if self.vehicle and time.monotonic() - beaten > 1:
                beaten = time.monotonic()
                kind, none = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
                beat = self.mav.heartbeat_encode(kind, none, 0, 0, 4)
                self.send(beat)
                if self.heard:
                    self.heard(beat.pack(self.mav))

    def take(self, message):
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
            return
        self.newest[kind] = message
        if kind == "PARAM_VALUE":
            self.parameters[message.param_id] = message.param_value
        elif kind == "COMMAND_ACK":
            self.acks[message.command] = message.result
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)

    def send(self, message):
        self.socket.sendto(message.pack(self.mav), self.vehicle)

    def ask(self, done, message, within_s=5.0):
        """Sends a message until `done`; returns whether that happened in time."""
        end = time.monotonic() + within_s
        while not done() and time.monotonic() < end:
            self.send(message)
            again = time.monotonic() + 0.5
            while not done() and time.monotonic() < again:
                time.sleep(0.005)
        return done()

    def command(self, number, *params):
        """Sends a command; returns the result in its acknowledgement, or None."""
        self.acks.pop(number, None)
        all_seven = [*params, 0, 0, 0, 0, 0, 0, 0][:7]
        self.ask(lambda: number in self.acks, self.mav.command_long_encode(1, 1, number, 0, *all_seven))
        return self.acks.get(number)

    def set_mode(self, number):
        """Sends one command to change the mode, as a person does."""
        mode = mavlink.MAV_CMD_DO_SET_MODE
        self.send(self.mav.command_long_encode(1, 1, mode, 0, 1, number, 0, 0, 0, 0, 0))

    def set_parameter(self, name, value):
        """Sets a parameter; returns whether the vehicle confirmed the value."""
        self.parameters.pop(name, None)
        real = mavlink.MAV_PARAM_TYPE_REAL32
        message = self.mav.param_set_encode(1, 1, name.encode(), value, real)
        return self.ask(lambda: abs(self.parameters.get(name, 1e9) - value) < 1e-4, message)

    def all_parameters(self):
        """Returns all parameters by name."""
        self.send(self.mav.param_request_list_encode(1, 1))
        count, still = -1, time.monotonic()
        while time.monotonic() - still < 1.5:
            if len(self.parameters) != count:
                count, still = len(self.parameters), time.monotonic()
            time.sleep(0.05)
        return dict(self.parameters)

    def close(self):
        self.running = False
        self.join()
        self.socket.close()
