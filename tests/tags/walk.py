"""Complete setup of a lab with tags, from the printer to the pose, on independently rendered images (lab.py); then
common faults: clock offsets, a bumped camera, a shrunk print, a rolling shutter.

Usage: walk.py VIZFLYT [ROW ...]      rows by name; default: all
"""

import json
import pathlib
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass

import numpy as np
from lab import (
    Camera,
    Lens,
    Pose,
    Sensor,
    Tag,
    fixed,
    looking,
    quaternion_of,
    read_layout,
    rotation_of,
    scale_layout,
    turned,
    write_images,
    write_stamps,
)

EYES = {
    "left": looking(np.array([-3.1, -1.9, 2.5]), np.array([0.2, 0.1, 0.9]), 0.02),
    "right": looking(np.array([3.0, -2.1, 2.3]), np.array([-0.3, 0.2, 0.9]), -0.03),
}
RATE_HZ = 30.0
# Time of each camera's exposure within its interval: webcams are not synchronised.
PHASE = {"left": 0.0, "right": 0.45}
SECONDS = 6.0
BEGIN_S = 100.0


def path(speed_mps: float) -> Pose:
    """Returns a flight through the cage: a horizontal figure eight, with the vehicle banking into its turns and yawing.
    It stands for 0.3 s, then reaches its speed within a second."""

    def way(t_s: np.ndarray) -> np.ndarray:
        t = np.maximum(t_s - BEGIN_S - 0.3, 0)
        flown_m = speed_mps * np.where(t < 1, t * t / 2, t - 0.5)
        angle = flown_m / 1.15
        return np.stack(
            [1.5 * np.sin(angle), 1.4 * np.sin(angle) * np.cos(angle), 1.1 + 0.3 * np.sin(0.7 * angle)], axis=-1
        )

    def pose(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        h = 0.05
        position = way(t_s)
        lean = (way(t_s + h) + way(t_s - h) - 2 * position) / h**2 / 9.81
        seconds = np.maximum(t_s - BEGIN_S, 0)
        yaw = 0.5 * np.sin(0.9 * seconds) + 0.2 * seconds
        along = lean[:, 0] * np.cos(yaw) + lean[:, 1] * np.sin(yaw)
        across = -lean[:, 0] * np.sin(yaw) + lean[:, 1] * np.cos(yaw)
        return turned(yaw, np.arctan(along), -np.arctan(across)), position

    return pose


class Lab:
    """A folder in which a lab is set up with the program's own commands."""

    def __init__(self, vizflyt: str, home: pathlib.Path) -> None:
        self.vizflyt, self.home = vizflyt, home
        self.lens = Lens()

    def tags(self, *args: str, refused: bool = False) -> str:
        """Runs `vizflyt tags`; returns its output."""
        done = subprocess.run(
            [self.vizflyt, "tags", *args], cwd=self.home, capture_output=True, text=True, check=False
        )
        assert (done.returncode != 0) == refused, f"{args}: {done.stdout}{done.stderr}"
        return done.stdout + done.stderr

    def layout(self, name: str) -> list[Tag]:
        return read_layout(self.home / f"{name}.toml")

    def print_and_calibrate(self) -> None:
        self.tags("print", "board", "-o", "board.pdf")
        self.tags("print", "cube", "-o", "cube.pdf", "--paper", "a3", "--face-mm", "250", "--tag-mm", "200")
        mat = ["--tag-mm", "200", "--pitch-mm", "275", "--columns", "2", "--rows", "4"]
        self.tags("print", "mat", "-o", "mat.pdf", "--paper", "a3", *mat)
        self.wave_board("board", self.lens, 0.34, (0.44, 0.27))
        for name in EYES:
            out = self.tags("calibrate", "board", "--board", "board.toml", "-o", f"{name}.toml")
        print("calibrate:", *out.splitlines()[-3:-1], sep="\n  ", flush=True)
        focal = self.number(self.home / "left.toml", "fx_px")
        assert abs(focal / self.lens.matrix[0, 0] - 1) < 2e-3, focal
        # The file's pixels begin at the outer corner of the first.
        middle = self.number(self.home / "left.toml", "cx_px")
        assert abs(middle - 0.5 - self.lens.matrix[0, 2]) < 1.5, middle

    def wave_board(self, folder: str, lens: Lens, depth_m: float, reach: tuple[float, float]) -> None:
        """Renders the board in all parts of an image, tilted in all directions; its centre reaches these slopes."""
        board = self.layout("board")
        random = np.random.default_rng(1)
        camera = Camera(lens, fixed(np.eye(3), np.zeros(3)), Sensor(exposure_s=0), 2)
        images = []
        for index in range(36):
            depth = depth_m + 0.1 * random.random()
            side = np.array([(index % 3 - 1) * reach[0], (index // 3 % 3 - 1) * reach[1], 1.0])
            facing = np.diag([1.0, -1.0, -1.0])
            tilt = turned(*(np.array([x]) for x in random.uniform(-0.5, 0.5, 3)))[0]
            images.append(camera.image([(board, fixed(tilt @ facing, depth * side))], 0.0))
        write_images(self.home / folder, images, [index / 10 for index in range(len(images))])

    @staticmethod
    def number(file: pathlib.Path, key: str) -> float:
        (line,) = (line for line in file.read_text().splitlines() if line.startswith(f"{key} = "))
        return float(line.split(" = ")[1])

    def camera_pose(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose in a camera's file."""
        lines = (self.home / f"{name}.toml").read_text().split("[world_from_cam]")[1].splitlines()
        values = dict(line.split(" = ") for line in lines if line)
        return rotation_of(*json.loads(values["rotation_xyzw"])), np.array(json.loads(values["position_m"]))

    def survey(self) -> None:
        mat = self.layout("mat")
        room = fixed(np.eye(3), np.zeros(3))
        random = np.random.default_rng(3)
        images = []
        for index in range(24):
            over = np.array([*random.uniform(-0.35, 0.35, 2), 0.9])
            over[1] *= 2
            pose = looking(over, np.array([0.5 * over[0], 0.6 * over[1], 0]), random.uniform(-1, 1))
            images.append(Camera(self.lens, fixed(*pose), Sensor(exposure_s=0), index).image([(mat, room)], 0.0))
        write_images(self.home / "walk", images, [index / 10 for index in range(len(images))])
        out = self.tags("survey", "mat", "walk", "--camera", "left.toml", "--layout", "mat.toml", "-o", "room.toml")
        print("survey mat:", out.splitlines()[-2], sep="\n  ", flush=True)
        for tag, printed in zip(self.layout("room"), mat):
            assert np.linalg.norm(tag.position_m - printed.position_m) < 1e-3, (tag, printed)

        # The cube at ten places, the mat on the floor; each place is one image of each camera.
        places = [
            (np.array([x, y, z]), yaw)
            for x, y, z, yaw in np.stack([random.uniform(-1.5, 1.5, 10), random.uniform(-1.2, 1.3, 10),
                                          random.uniform(0.3, 1.9, 10), random.uniform(-3, 3, 10)], axis=1)
        ]
        cube = self.layout("cube")
        for index, (name, pose) in enumerate(EYES.items()):
            camera = Camera(self.lens, fixed(*pose), Sensor(exposure_s=0), 10 + index)
            stills = []
            for place, yaw in places:
                zero = np.zeros(1)
                body = fixed(turned(np.array([yaw]), zero, zero)[0], place)
                stills.append(camera.image([(mat, room), (cube, body)], 0.0))
            write_images(self.home / f"{name}-places", stills, [float(i) for i in range(len(stills))])
        out = self.survey_cameras("cube")
        print("survey cameras:", *out.splitlines(), sep="\n  ", flush=True)
        for name, (_, true_m) in EYES.items():
            off_mm = 1e3 * np.linalg.norm(self.camera_pose(name)[1] - true_m)
            print(f"  {name} is {off_mm:.1f} mm off", flush=True)
            assert off_mm < 10, name
        assert "of its layout's size" in out, out
        # A cube printed at 97 %: its layout states the nominal size.
        scale_layout(self.home / "cube.toml", 1 / 0.97, self.home / "large.toml")
        kept = {name: (self.home / f"{name}.toml").read_text() for name in EYES}
        shrunk = self.survey_cameras("large").splitlines()[-1]
        print(f"  {shrunk}")
        assert "cube: it has 97." in shrunk and "--bar-mm 97." in shrunk, shrunk
        for name, text in kept.items():
            (self.home / f"{name}.toml").write_text(text)

    def survey_cameras(self, cube: str) -> str:
        places = [f"{name}.toml={name}-places" for name in EYES]
        return self.tags("survey", "cameras", *places, "--mat", "room.toml", "--cube", f"{cube}.toml")

    def fly(self, name: str, speed_mps: float, sensor: Sensor) -> Pose:
        """Renders a flight: the images of both cameras with true stamps."""
        truth = path(speed_mps)
        cube = self.layout("cube")
        for index, (eye, pose) in enumerate(EYES.items()):
            camera = Camera(self.lens, fixed(*pose), sensor, 20 + index)
            camera.leave(self.layout("mat"), fixed(np.eye(3), np.zeros(3)))
            images = [camera.image([(cube, truth)], t_s) for t_s in self.stamps_s(eye)]
            write_images(self.home / name / eye, images, self.stamps_s(eye))
        return truth

    @staticmethod
    def stamps_s(eye: str) -> list[float]:
        return [BEGIN_S + (index + PHASE[eye]) / RATE_HZ for index in range(int(SECONDS * RATE_HZ))]

    def write_config(self, *layouts: str) -> None:
        files = json.dumps([f"{name}.toml" for name in layouts])
        cameras = json.dumps([f"{name}.toml" for name in EYES])
        (self.home / "lab.toml").write_text(f"cameras = {cameras}\nlayouts = {files}\n")

    def bump(self, name: str) -> None:
        """Moves the pose in a camera's file away from the true one: by 2.4 cm and 0.7 degrees."""
        file = self.home / f"{name}.toml"
        rotation, position = self.camera_pose(name)
        turned_by = turned(*(np.array([x]) for x in np.radians([0.5, 0.4, -0.3])))[0]
        place = (position + np.array([0.015, -0.016, 0.01])).tolist()
        head = file.read_text().split("[world_from_cam]")[0]
        pose = f"position_m = {place}\nrotation_xyzw = {quaternion_of(rotation @ turned_by)}"
        file.write_text(f"{head}[world_from_cam]\n{pose}\n")

    def locate(self, flight: str, cube: str = "cube", layouts: tuple[str, ...] = ()) -> list[dict]:
        """Runs `tags locate` on a flight; returns its lines."""
        self.write_config(cube, *layouts)
        sources = [f"--source={name}={flight}/{name}" for name in EYES]
        out = self.tags("locate", "lab.toml", "--poses", "--json", *sources)
        return [json.loads(line) for line in out.splitlines() if line.startswith("{")]


def figures(lines: list[dict], truth: Pose) -> dict[str, float]:
    """Returns the errors of located poses, and their size relative to the reported uncertainty."""
    poses = [line for line in lines if "vizflyt_pose" in line]
    stamps = np.array([pose["stamp_ns"] for pose in poses]) / 1e9
    assert (np.diff(stamps) > 0).all(), "stamps go back"
    rotations, positions = truth(stamps)
    off = np.array([pose["position_m"] for pose in poses]) - positions
    sigma = np.array([pose["position_sigma_m"] for pose in poses])
    turns = []
    for pose, rotation in zip(poses, rotations):
        q = np.array(quaternion_of(rotation.T @ rotation_of(*pose["rotation_xyzw"])))
        turns.append(2 * q[:3] * (1 if q[3] >= 0 else -1))
    turn = np.array(turns)
    turn_sigma = np.array([pose["rotation_sigma_rad"] for pose in poses])
    distance = np.linalg.norm(off, axis=1)
    (report,) = (line["report"] for line in lines if "report" in line)
    return {
        "poses": len(poses),
        "sets": report["sets"],
        "rms_mm": 1e3 * float(np.sqrt(np.mean(distance**2))),
        "p99_mm": 1e3 * float(np.quantile(distance, 0.99)),
        "rms_deg": float(np.degrees(np.sqrt(np.mean((turn**2).sum(1))))),
        "sigma_mm": 1e3 * float(np.median(np.linalg.norm(sigma, axis=1))),
        # Mean over the axes: NEES / 3.
        "nees": float(np.mean((off / sigma) ** 2)),
        "turn_nees": float(np.mean((turn / turn_sigma) ** 2)),
        "px": float(np.median([pose["quality"]["rms_px"] for pose in poses])),
        "gap_ms": 1e3 * float(np.diff(stamps).max()),
    }


def main() -> None:
    vizflyt = str(pathlib.Path(sys.argv[1]).resolve())
    wanted = sys.argv[2:]
    with tempfile.TemporaryDirectory() as folder:
        lab = Lab(vizflyt, pathlib.Path(folder))
        lab.print_and_calibrate()
        lab.survey()
        rows(lab, wanted)
        if not wanted or INSIDE_OUT in wanted:
            inside_out(lab)
        cameras_come_and_go(lab)


@dataclass
class Row:
    """A fault of a lab, and the required accuracy of its flight despite it."""

    flight: str = "slow"
    # Delay of the right camera's stamps, and the delay stated in its file.
    late_s: float = 0.0
    latency_ms: float = 0.0
    cube: str = "cube"
    layouts: tuple[str, ...] = ()
    bumped: str = ""
    rms_mm: float = 4.0
    rms_deg: float = 0.8
    # Expected findings; the beginning and the end of each.
    findings: tuple[tuple[str, str], ...] = ()


LATE = ("right stamps images", "latency_ms in its file")
SCALE = ("the tags have 97.", "--bar-mm")
ROLLING = ("reads its rows over", "(corrected)")
SURVEY = "survey again"
ROWS = {
    "normal": Row(),
    "10 ms apart": Row(late_s=0.010, findings=(LATE,)),
    "30 ms apart": Row(late_s=0.030, rms_mm=10, findings=(LATE,)),
    "100 ms, known": Row(late_s=0.100, latency_ms=100),
    "tags at 97 %": Row(cube="large", rms_mm=20, findings=(SCALE,)),
    "rolling shutter": Row(flight="rolling", findings=(ROLLING, ROLLING)),
    "left bumped": Row(bumped="left", rms_mm=25, findings=(("left camera moved by", SURVEY),)),
    "left bumped, the mat is there": Row(
        bumped="left", layouts=("room",), rms_mm=25, findings=(("left camera moved by 2.", SURVEY),)
    ),
    "right bumped, the mat is there": Row(
        bumped="right", layouts=("room",), rms_mm=25, findings=(("right camera moved by 2.", SURVEY),)
    ),
}


def rows(lab: Lab, wanted: list[str]) -> None:
    flights = {"slow": lab.fly("slow", 1.0, Sensor()), "rolling": lab.fly("rolling", 2.0, Sensor(readout_s=0.02))}
    files = {name: (lab.home / f"{name}.toml").read_text() for name in EYES}
    for name, row in ROWS.items():
        if wanted and name not in wanted:
            continue
        write_stamps(lab.home / row.flight / "right", [stamp + row.late_s for stamp in lab.stamps_s("right")])
        if row.latency_ms:
            head, size = files["right"].split("width_px", 1)
            (lab.home / "right.toml").write_text(f"{head}latency_ms = {row.latency_ms}\nwidth_px{size}")
        if row.bumped:
            lab.bump(row.bumped)
        lines = lab.locate(row.flight, row.cube, row.layouts)
        for eye, text in files.items():
            (lab.home / f"{eye}.toml").write_text(text)
        write_stamps(lab.home / row.flight / "right", lab.stamps_s("right"))
        values = figures(lines, flights[row.flight])
        (report,) = (line["report"] for line in lines if "report" in line)
        words = "  ".join(f"{key} {value:.4g}" for key, value in values.items())
        print(f"{name}: {words}", report["findings"], flush=True)
        check(row, values, report)


def check(row: Row, values: dict[str, float], report: dict) -> None:
    assert values["rms_mm"] < row.rms_mm, "poses are off"
    assert values["rms_deg"] < row.rms_deg, "attitudes are off"
    # Squared errors in units of the reported sigma: 1 is exact.
    assert 0.3 < values["nees"] < 2.5, "sigma is not honest"
    assert 0.2 < values["turn_nees"] < 2.5, "sigma of the attitude is not honest"
    assert values["poses"] >= 0.98 * values["sets"], report
    found = report["findings"]
    assert len(found) == len(row.findings), found
    for text, (begin, end) in zip(found, row.findings):
        assert begin in text and end in text, (text, begin)


INSIDE_OUT = "under the vehicle"
# The camera looks straight down, the image's top towards the nose; its lens is 80 mm above the feet.
BODY_FROM_CAM = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
LENS_M = np.array([0.02, 0.0, 0.08])


def up_and_down(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns a flight from a pad and back: stands, climbs to 1.2 m, flies a circle, lands; yaws all the time."""

    def smooth(begin_s: float, end_s: float) -> np.ndarray:
        share = np.clip((t_s - BEGIN_S - begin_s) / (end_s - begin_s), 0, 1)
        return share**2 * (3 - 2 * share)

    height = 1.2 * (smooth(0.4, 1.9) - smooth(5.0, 7.0))
    angle = 2 * np.pi * smooth(1.5, 5.2)
    position = np.stack([0.7 * np.sin(angle), 0.5 * (1 - np.cos(angle)), height], axis=-1)
    yaw = 0.8 * smooth(0.4, 5.0)
    return turned(yaw, 0.08 * np.sin(angle), -0.08 * np.sin(angle)), position


def carried(body: Pose, rotation: np.ndarray, place_m: np.ndarray) -> Pose:
    """Returns the pose of a part mounted on a vehicle."""

    def pose(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, p = body(t_s)
        return r @ rotation, p + r @ place_m

    return pose


def inside_out(lab: Lab) -> None:
    """The camera is under the vehicle, above a mat laid with a tape measure: printed, calibrated, surveyed, located,
    from take-off to landing."""
    focal = 270.0
    lens = Lens(
        width=640,
        height=480,
        matrix=np.array([[focal, 0.0, 321.4], [0.0, focal - 0.4, 238.2], [0.0, 0.0, 1.0]]),
        distortion=np.array([-0.11, 0.025, 0.0006, -0.0005, 0.0]),
    )
    lab.tags("print", "mat", "-o", "floor.pdf", "--fly-over", "3x2.5", "--pad", "0,0", "--middle-m", "0,0,0")
    lab.wave_board("wide-board", lens, 0.16, (0.8, 0.55))
    lab.tags("calibrate", "wide-board", "--board", "board.toml", "-o", "belly.toml")
    print("calibrate:", lab.number(lab.home / "belly.toml", "fx_px"), "px", flush=True)

    random = np.random.default_rng(11)
    laid = lab.layout("floor")
    for tag in laid:
        # Large sheets are placed with a tape measure; small ones are printed together.
        if tag.size_m > 0.1:
            tag.position_m = tag.position_m + np.array([*random.normal(0, 0.004, 2), 0])
            tag.rotation = turned(*(np.array([x]) for x in (random.normal(0, 0.01), 0.0, 0.0)))[0]
    still = fixed(np.eye(3), np.zeros(3))
    # A walk over the whole mat, and at low height over the pad.
    places = [np.array([x, y, 0.9]) for x in np.linspace(-1.1, 1.1, 6) for y in np.linspace(-0.8, 0.8, 4)]
    places += [np.array([x, y, 0.35]) for x in (-0.15, 0.0, 0.15) for y in (-0.1, 0.1)]
    images = []
    for index, over in enumerate(places):
        aim = np.array([*(0.8 * over[:2] + random.uniform(-0.1, 0.1, 2)), 0])
        pose = looking(over, aim, random.uniform(-1, 1))
        images.append(Camera(lens, fixed(*pose), Sensor(exposure_s=0), index).image([(laid, still)], 0.0))
    write_images(lab.home / "floor-walk", images, [index / 10 for index in range(len(images))])
    survey = ["--camera", "belly.toml", "--layout", "floor.toml", "-o", "floor-room.toml"]
    out = lab.tags("survey", "mat", "floor-walk", *survey)
    print("survey mat:", out.splitlines()[-2], sep="\n  ", flush=True)

    # Mounted with a ruler and the mat's level: errors of 1.5 mm and 1.5 mrad along and about each axis.
    tilt = turned(*(np.array([x]) for x in (-0.0015, 0.0015, 0.0015)))[0]
    place_m = LENS_M + np.array([0.0015, -0.0015, -0.0015])
    camera = Camera(lens, carried(up_and_down, BODY_FROM_CAM @ tilt, place_m), Sensor(), 40)
    stamps = [BEGIN_S + index / RATE_HZ for index in range(int(7.5 * RATE_HZ))]
    write_images(lab.home / "belly", [camera.image([(laid, still)], t_s) for t_s in stamps], stamps)
    file = lab.home / "belly.toml"
    mount = f"position_m = {LENS_M.tolist()}\nrotation_xyzw = {quaternion_of(BODY_FROM_CAM)}\n"
    file.write_text(f"{file.read_text()}\n[body_from_cam]\n{mount}")
    (lab.home / "belly-lab.toml").write_text('cameras = ["belly.toml"]\nlayouts = ["floor-room.toml"]\n')
    out = lab.tags("locate", "belly-lab.toml", "--poses", "--json", "--source=belly=belly")
    lines = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    low = [line for line in lines if "vizflyt_pose" not in line or line["position_m"][2] < 0.4]
    (report,) = (line["report"] for line in lines if "report" in line)
    for what, part in (("all", lines), ("low", low)):
        values = figures(part, up_and_down)
        words = "  ".join(f"{key} {value:.4g}" for key, value in values.items())
        print(f"{INSIDE_OUT}, {what}: {words}", report["findings"], flush=True)
        assert values["rms_mm"] < 6 and values["p99_mm"] < 26, "poses are off"
        assert values["rms_deg"] < 0.5, "attitudes are off"
        assert 0.5 < values["nees"] < 2, "sigma is not honest"
    assert report["located"] >= 0.99 * report["sets"], report
    assert not report["findings"], report


class Server:
    """A render server that takes poses as JSON packets."""

    def __init__(self, lab: Lab) -> None:
        make = [lab.vizflyt, "scene", "generate", "room", "--seed", "3", "-o", "hall"]
        subprocess.run(make, cwd=lab.home, check=True, capture_output=True)
        anywhere = "127.0.0.1:0"
        command = [lab.vizflyt, "serve", "hall", "--pose", f"json:{anywhere}", "--keys", "keys", "--json"]
        self.log = lab.home / "server.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [*command, "--quic", anywhere, "--http", anywhere],
                cwd=lab.home,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert self.process.stdout
        ready = json.loads(self.process.stdout.readline())
        (source,) = ready["pose"]
        self.poses = source["address"]

    def end(self) -> str:
        """Stops it; returns its output."""
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=30)
        return self.log.read_text()


def cameras_come_and_go(lab: Lab) -> None:
    """A camera that hangs, repeats images, goes dark or is unplugged is reported, and used again afterwards; the other
    continues. A render server that gets the poses shows this to its users."""
    server = Server(lab)
    begin_ns = time.monotonic_ns() + 2 * 10**9
    faults = ["hang:1:1.7", "repeat:2.2:2.7", "dark:3.2:3.7", "end:4.2:4.3"]
    feed = f"{sys.executable} {pathlib.Path(__file__).with_name('feed.py')}"
    sources = [
        f"--source={name}=| exec {feed} slow/{name} {begin_ns} slow/end {' '.join(faults if name == 'right' else [])}"
        for name in EYES
    ]
    lab.write_config("cube")
    command = [lab.vizflyt, "tags", "locate", "lab.toml", "--poses", "--json", "--to", server.poses, *sources]
    with subprocess.Popen(command, cwd=lab.home, stdout=subprocess.PIPE, text=True) as located:
        events, alone, both, after = [], 0, 0, 0
        unplugged, again = False, False
        for line in located.stdout:
            said = json.loads(line)
            if "fault" in said:
                events.append((said["camera"], said["fault"]))
                print("  ", said, flush=True)
                unplugged = unplugged or "ended with" in str(said["fault"])
                again = again or (unplugged and events[-1] == ("right", None))
            if "vizflyt_pose" in said:
                alone += said["quality"]["cameras"] == 1
                both += said["quality"]["cameras"] == 2
                after += again
            if after == 10:
                (lab.home / "slow/end").touch()
            if events and events[-1] == ("left", "its images ended"):
                located.send_signal(signal.SIGINT)
                break
    right = [fault for camera, fault in events if camera == "right"]
    # Both are silent until the flight begins.
    while right and right[0] is not None:
        right.pop(0)
    right.pop(0)
    log = server.end()
    for part in ("no image", "repeats an image", "sees nothing", "ended with"):
        assert any("right" in line and part in line for line in log.splitlines()), (part, log)
        told = [index for index, fault in enumerate(right) if fault and part in fault]
        assert told and None in right[told[0] :], (part, events)
    assert alone > 0 and both > 0 and after > 0, (alone, both, after)
    print(f"cameras come and go: {both} poses by two cameras, {alone} by one", flush=True)


if __name__ == "__main__":
    main()
