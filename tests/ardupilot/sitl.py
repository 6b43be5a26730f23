"""ArduCopter in SITL as the vehicle: configured by `vizflyt doctor vehicle --apply`, with its true state, its
transmitter and its telemetry ports."""

import contextlib
import json
import pathlib
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time

from checks import Failed, say, wait
from wire import Station

HERE = pathlib.Path(__file__).parent
AIRFRAME = HERE.parents[1] / "hardware/airframe"

# Parameters that cannot be in an airframe file: SITL has other outputs, motors and a smaller battery, and is
# uncalibrated.
OVERRIDES = {
    "SERVO1_FUNCTION": 33, "SERVO2_FUNCTION": 34, "SERVO3_FUNCTION": 35, "SERVO4_FUNCTION": 36,
    "SERVO9_FUNCTION": 0, "SERVO10_FUNCTION": 0, "SERVO11_FUNCTION": 0, "SERVO12_FUNCTION": 0,
    "SERVO_BLH_AUTO": 0, "MOT_PWM_TYPE": 0, "MOT_THST_EXPO": 0.65, "MOT_THST_HOVER": 0.39,
    "MOT_SPIN_ARM": 0.1, "MOT_SPIN_MIN": 0.15, "INS_GYRO_FILTER": 20,
    "SIM_BATT_VOLTAGE": 16.8,
}
CALIBRATED = {f"INS_ACC{n}{what}_{axis}": value
              for n in ("", 2) for what, value in (("OFFS", 0.001), ("SCAL", 1.001)) for axis in "XYZ"}
# The pilot's switch, by PWM; the airframe file leaves three of its positions free.
SWITCH = {"FLTMODE2": 5, "FLTMODE3": 17, "FLTMODE5": 6}
PWM = {"STABILIZE": 1100, "LOITER": 1295, "BRAKE": 1425, "ALT_HOLD": 1555, "RTL": 1685, "LAND": 1900}

# Battery of the simulated frame: ArduCopter 4.8 refuses to arm below the airframe's BATT_ARM_VOLT, and takes the
# voltage at rest from here. [V]
FRAME = {"maxVoltage": 16.8}

PLACE = "42.3,-71.8,100"
BOOT_S = 60
# Offset that SITL adds to the port of a TCP link.
BASE_PORT = 5760


def doctor(vizflyt, address, folder, *more):
    """Configures an autopilot as a user does, with the project's airframe file."""
    command = [vizflyt, "doctor", "vehicle", "--mavlink", address, "--apply", *more]
    done = subprocess.run(command, text=True, capture_output=True, timeout=120)
    with open(folder / "doctor.log", "a") as log:
        log.write(done.stdout + done.stderr)
    # The status is 1 if a setting was dangerous, even if the doctor corrected it.
    if done.returncode not in (0, 1) or "parameters" not in done.stdout:
        raise Failed("the doctor gave up: %s" % (done.stdout + done.stderr)[-500:])


class Transmitter(threading.Thread):
    """The pilot's transmitter: throttle down until lifted, channel 5 is the mode switch, channel 6 enables the
    motors."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.to = ("127.0.0.1", port)
        self.switch, self.throttle = "STABILIZE", 1000
        self.running = True
        self.start()

    def run(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
            while self.running:
                channels = [1500, 1500, self.throttle, 1500, PWM[self.switch], 1000, 1000, 1000]
                with contextlib.suppress(ConnectionError):
                    radio.sendto(struct.pack("<16H", *channels, *[1000] * 8), self.to)
                time.sleep(0.02)


class Sitl:
    """The program, started once for each flight in its own folder."""

    is_real = True

    def __init__(self, binary, folder, vizflyt, more):
        self.binary, self.folder, self.vizflyt = binary, folder, vizflyt
        self.more = {name: float(value) for name, value in (one.split("=") for one in more)}
        self.eeprom = folder / "eeprom.bin"

    def prepare(self, arena):
        """Configures the vehicle as a user does, and restarts it: every flight starts with these parameters."""
        (self.folder / "calibrated.param").write_text("".join(f"{n},{v}\n" for n, v in CALIBRATED.items()))
        # A group of parameters appears only after its enabling parameter is set and the vehicle was restarted.
        self.session(lambda port, _: doctor(self.vizflyt, f"tcpout:127.0.0.1:{port}", self.folder))
        self.session(lambda port, station: self.finish(f"tcpout:127.0.0.1:{port}", arena, station))

    def finish(self, address, arena, station):
        # A build between two releases has names of both. The file for its version comes last.
        for file in sorted(AIRFRAME.glob("*.param")):
            doctor(self.vizflyt, address, self.folder, "--airframe", file)
        doctor(self.vizflyt, address, self.folder, "--arena", arena)
        for name, value in {**OVERRIDES, **SWITCH, **self.more}.items():
            if not station.set_parameter(name, value):
                say("note  this ArduCopter has no %s" % name)

    def session(self, work):
        """Runs `work` on a running vehicle, and saves its parameters."""
        station, port = Station(), BASE_PORT + 230
        with Running(self, "prepare", station, f"tcp:{port - BASE_PORT}") as running:
            wait("ArduCopter's heartbeat", lambda: "HEARTBEAT" in station.newest, BOOT_S)
            work(port, station)
            # SITL writes the parameters in the background.
            time.sleep(2)
            shutil.copy(running.folder / "eeprom.bin", self.eeprom)
        station.close()

    def start(self, poses, wire, station, spawn, yaw_deg):
        return Running(self, "flight", station, f"udpclient:{wire.air}", poses, spawn, yaw_deg)


class Running:
    """A running SITL; closes with all its child processes."""

    def __init__(self, sitl, name, station, jetson, poses=None, spawn=(0, 0, 0), yaw_deg=0):
        self.folder = sitl.folder / name
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        if sitl.eeprom.exists():
            shutil.copy(sitl.eeprom, self.folder)
        (self.folder / "frame.json").write_text(json.dumps(FRAME))
        self.log = open(self.folder / "log", "w")
        self.slave = poses and subprocess.Popen(
            [sys.executable, HERE / "slave.py", poses.address, "%g,%g,%g" % spawn], stdin=subprocess.PIPE)
        radio = free_port()
        self.transmitter = Transmitter(radio)
        # TELEM2 is the Jetson's, TELEM1 a ground station's. SERIAL0 waits for a client unless it is configured.
        arguments = [
            "--model", "x:frame.json", "--speedup", "1", "--home", f"{PLACE},{90 - yaw_deg:g}",
            "--defaults", sitl.folder / "calibrated.param", "--rc-in-port", str(radio),
            "--serial0", "udpclient:127.0.0.1:%d" % free_port(),
            "--serial1", f"udpclient:{station.address}", "--serial2", jetson,
            *(["--slave", "1"] if poses else []),
        ]
        self.process = subprocess.Popen(
            [sitl.binary, *arguments], cwd=self.folder, stdin=subprocess.DEVNULL, stdout=self.log,
            stderr=subprocess.STDOUT, start_new_session=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def switch(self, mode):
        self.transmitter.switch = mode

    def lift(self):
        self.transmitter.throttle = 1500

    def close(self):
        self.transmitter.running = False
        self.process.kill()
        self.process.wait()
        if self.slave:
            self.slave.stdin.close()
            self.slave.wait()
        self.log.close()


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]
