"""The tables of docs/BENCHMARKS.md: the command of each, how its rows are made, and the tables filled in by hand.

A table is measured in turns; each turn runs its command once and returns figures by "ROW | COLUMN". The text in the
document depends only on the figures, so it can be rebuilt without measuring.
"""

import json
import re
import tempfile
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import growth
import machine
from document import markdown, printed_tables
from figures import Figures, Taken, count, number, rate, rows, time
from lab import Lab

ROOT = Path(__file__).resolve().parents[2]


class Table(NamedTuple):
    """A measured table: the commands that a reader would type, and the function of one turn."""

    commands: list[str]
    measure: Callable[[Lab], Figures]
    # Head of the column of row names; several columns if a name has several parts.
    corner: str = ""
    # Reference kernel for its times.
    kernel: str = "computing"
    turns: int = 3
    # Markdown in place of the default grid.
    layout: Callable[[Figures], str] | None = None
    # A drawing for this table: its file name in docs/, and its function.
    drawing: tuple[str, Callable[[Figures], str]] | None = None


# View of each generated scene: the start, at flight height. [m]
VIEWS = {"forest": (1.0, 0.0, 1.2), "race": (0.9, 0.0, 1.2), "room": (0.9, 0.0, 1.2)}


def render(lab: Lab) -> Figures:
    out: Figures = {}
    for kind, at_m in VIEWS.items():
        arena, camera = lab.scene(kind), lab.camera(kind, *at_m)
        for size in ("320x240", "640x480"):
            found = lab.json("bench", "render", arena, "--camera", camera, "--renderer", "cpu", "--size", size)
            row = f"{kind}, {size}"
            out[f"{row} | splats in sight"] = count(found["workload"]["visible"])
            out[f"{row} | least [ms]"] = time(found["least_ms"], 1)
            out[f"{row} | processor [ms]"] = time(found["processor_ms"], 1)
    return out


def imaging(lab: Lab) -> Figures:
    arena, camera = lab.scene("forest"), lab.camera("forest", *VIEWS["forest"])
    found = lab.json("bench", "imaging", arena, "--camera", camera, "--size", "176x132", "--images", "15", "--renderer",
                     "cpu", threads=1)
    # An event camera's name contains the number of events.
    kinds = {kind["name"].partition(" (")[0]: kind["median_ms"] for kind in found["kinds"]}
    return {"rendering | ms": time(found["render_ms"]),
            **{f"{name} | ms": time(ms) for name, ms in kinds.items() if not name.startswith("perfect")}}


def shares(corner: str) -> Callable[[Figures], str]:
    """Returns a layout with a column of each row's share of the first row; both are the best of their turns."""
    def layout(figures: Figures) -> str:
        columns, lines = rows(figures)
        first = next(iter(figures.values())).value
        shown = [[*line, f"{figure.value / first:.2f}"] for line, figure in zip(lines, figures.values())]
        return markdown([corner, *columns, f"of {lines[0][0]}"], shown)
    return layout


def sensors(lab: Lab) -> Figures:
    out: Figures = {}
    arena, camera = lab.scene("forest"), lab.camera("lidar", 7.5, 0.8, 1.3)
    found = lab.json("bench", "sensors", arena, "--camera", camera, "--count", "30", threads=1)
    for kind in found["kinds"]:
        out[f"{kind['name']} | least [ms]"] = time(kind["least_ms"], 3)
        out[f"{kind['name']} | records"] = count(kind["records"])
    return out


def stream(lab: Lab) -> Figures:
    ways = {"packet": "handed to the transport -> plugin woken", "tcp": "the same bytes over raw TCP",
            "pixels": "pixels -> encode -> decode -> plugin woken"}
    out: Figures = {}
    for way in lab.json("bench", "stream", "--seconds", "5")["ways"]:
        row = ways[way["name"]]
        out[f"{row} | KB"] = count(way["bytes"] / 1e3)
        out[f"{row} | p50 [ms]"] = time(way["ms_p50"])
        out[f"{row} | p99 [ms]"] = time(way["ms_p99"])
    return out


def loop(lab: Lab) -> Figures:
    found = lab.demo("loop.json", "--seed", "7", "--seconds", "90")
    return {
        "flights that finished, of a turn | ": count(found["outcome"] == "finished"),
        "images given to the plugin, 320x240 RGB-D [Hz] | ": rate(found["image_hz"]),
        "pose to plugin, p50 [ms] | ": time(found["age_ms_p50"], 1),
        "pose to plugin, p99 [ms] | ": time(found["age_ms_p99"], 1),
        "drawing, p50 [ms] | ": time(found["render_ms_p50"], 1),
        "memory of all processes, peak [MB] | ": count(found["peak_rss_mb"]),
        "mean speed by the truth [m/s] | ": count(found["mean_speed_mps"], 2),
        "top speed by the truth [m/s] | ": count(found["max_speed_mps"], 2),
        "least clearance by the truth [m] | ": count(found["min_clearance_m"], 2),
    }


def race(lab: Lab) -> Figures:
    used = lab.vizflyt("grade", "race", "--project", "p5", "--seeds", "10", "--log", "none", "--json")
    runs = json.loads(used.output)["runs"]
    times_s = [run["seconds"] for run in runs if run["outcome"] == "finished"]
    flown_s = sum(run["seconds"] for run in runs)
    return {
        "flights that finished, of 10 | ": count(len(times_s)),
        "from take-off to the end, least [s] | ": count(min(times_s), 1),
        "from take-off to the end, greatest [s] | ": count(max(times_s), 1),
        "least clearance [m] | ": count(min(run["min_clearance_m"] for run in runs), 2),
        "processor of a second of flight [ms] | ": time(used.processor_s / flown_s * 1e3, 1),
    }


def dataset(lab: Lab) -> Figures:
    out: Figures = {}
    for layers in ("rgb", "rgb,depth,normals,instances,classes,flow"):
        used = lab.vizflyt("dataset", "--project", "forest", "--seed", "7", "--images", "60", "--threads", "1",
                           "--layers", layers, "-o", f"set-{clock.monotonic_ns()}")
        said = re.search(r"(\d+) a second of processor", used.output)
        out[f"{layers} | images a second of processor"] = rate(float(said[1]), 0)
    return out


def gym(lab: Lab) -> Figures:
    out: Figures = {}
    for course in ("forest", "race"):
        for what, envs, more in (("state", 1, []), ("state", 16, []),
                                 ("state, depth 64x48", 16, ["--camera", "64x48"])):
            project = {"forest": "forest", "race": "p5"}[course]
            steps, processor_s = lab.fly(project, envs, more, seconds=2.0)
            row = f"{course}, {what}, {envs} at once"
            out[f"{row} | processor a step [ms]"] = time(processor_s / steps * 1e3, 3)
    return out


def cargo(arguments: list[str], env: dict[str, str] | None = None) -> str:
    """Returns the output of a crate's benchmark, which is built first."""
    return machine.run(["cargo", "bench", "--locked", "--quiet", *arguments], ROOT, env=env).output


def printed(lines: str, timed: tuple[str, ...] = (), columns: tuple[str, ...] = (), head: int = 1) -> Figures:
    """Returns the figures of the last table that a benchmark printed: a row's name is its first `head` cells; `columns`
    replaces the column names."""
    names, *rest = printed_tables(lines)[-1]
    out: Figures = {}
    for cells in rest:
        for column, cell in zip(columns or names[head:], cells[head:]):
            figure = number(cell, "time" if column in timed else "count")
            if figure:
                out[f"{', '.join(cells[:head])} | {column}"] = figure
    return out


def rules(_: Lab) -> Figures:
    shown = {"bake/130000 splats, 5 cm, 43 x 15 x 4.5 m": ("bake, 130 k splats, 43 x 15 x 4.5 m at 5 cm", "ms"),
             "bake/1000000 splats, 5 cm, 43 x 15 x 4.5 m": ("bake, 1 M splats (aim 3000)", "ms"),
             "query": ("query (aim 1000)", "ns"),
             "swept tick, sphere, 6 m/s at 200 Hz": ("swept tick at 6 m/s and 200 Hz, a sphere (aim 10 000)", "ns"),
             "swept tick, two arms and a hub, 6 m/s at 200 Hz": ("the same, two arms and a hub (37 balls)", "ns"),
             "swept tick beside a turning hand, sphere": ("beside a turning hand, a sphere", "ns"),
             "swept tick beside a turning hand, two arms and a hub": ("beside a turning hand, arms and hub", "ns")}
    found = criterion_ns("rules", "vizflyt-arena", "--warm-up-time", "0.5", "--measurement-time", "2")
    return {f"{name} [{unit}] | ": time(found[key] / {"ms": 1e6, "ns": 1.0}[unit], {"ms": 0, "ns": 0}[unit])
            for key, (name, unit) in shown.items()}


def criterion_ns(bench: str, package: str, *arguments: str) -> dict[str, float]:
    """Runs a benchmark; returns the minimum sample of each part, because other processes disturb wall-clock times.
    [ns]"""
    with tempfile.TemporaryDirectory() as folder:
        cargo(["-p", package, "--bench", bench, "--", "--noplot", *arguments], {"CRITERION_HOME": folder})
        return {json.loads(path.read_text())["full_id"]: least_sample_ns(path.with_name("sample.json").read_text())
                for path in Path(folder).glob("**/new/benchmark.json")}


def least_sample_ns(text: str) -> float:
    """Returns the minimum time of an iteration in criterion's samples. [ns]"""
    sample = json.loads(text)
    return min(time_ns / iterations for iterations, time_ns in zip(sample["iters"], sample["times"]))


def pose(_: Lab) -> Figures:
    columns = ("as measured mm", "predicted mm", "times less", "times less, with IMU", "as measured deg",
               "predicted deg", "with IMU deg", "accepted %")
    # Print only the table: no timing has this name.
    return printed(cargo(["-p", "vizflyt-arena", "--bench", "pose", "--", "the table alone"]), columns=columns, head=6)


def codec(_: Lab) -> Figures:
    text = cargo(["-p", "vizflyt-rgbd", "--features", "turbo", "--bench", "codec"])
    (forest,) = re.findall(r"^demo forest.*\n.*\n((?:.+\n)+)", text, re.MULTILINE)
    out: Figures = {}
    for name, encode, decode, bits, error in re.findall(
            r"^(.+?) +(\d+\.\d\d) +(\d+\.\d\d) +(\d+\.\d\d) +(\d+\.\d )?", forest, re.MULTILINE):
        out[f"{name} | encode [ms]"] = time(float(encode))
        out[f"{name} | decode [ms]"] = time(float(decode))
        out[f"{name} | bits a pixel"] = count(float(bits), 2)
        if error:
            out[f"{name} | colour [dB]"] = count(float(error), 1)
    return out


def simulator(_: Lab) -> Figures:
    (second_ns,) = criterion_ns("second", "vizflyt-simulator").values()
    return {"a simulated second: 800 Hz physics, 400 Hz autopilot [ms] | ": time(second_ns / 1e6)}


MEASURED: dict[str, Table] = {
    "loop": Table(["vizflyt demo --headless --seed 7 --seconds 90 --report out.json"], loop, "the whole loop"),
    "race": Table(["vizflyt grade race --project p5 --seeds 10 --json"], race, "`grade`, lock-step", turns=1),
    "render": Table(
        ["vizflyt scene generate forest --seed 7 -o forest",
         "vizflyt bench render forest/arena.toml --camera cam.json --size 640x480 --renderer cpu"],
        render, "generated scene of seed 7, from its start"),
    "imaging": Table(
        ["RAYON_NUM_THREADS=1 vizflyt bench imaging forest/arena.toml --camera cam.json --size 176x132 --renderer cpu"],
        imaging, layout=shares("forest 7, 176x132, one thread")),
    "sensors": Table(["RAYON_NUM_THREADS=1 vizflyt bench sensors forest/arena.toml --camera cam.json"], sensors,
                     "sensor, one thread"),
    "codec": Table(["cargo bench -p vizflyt-rgbd --features turbo"], codec, "the demo's forest, 640x480, one core",
                   turns=1),
    "stream": Table(["vizflyt bench stream --seconds 5"], stream, "way", kernel="memory"),
    "dataset": Table(["vizflyt dataset --project forest --seed 7 --images 60 --threads 1 --layers LAYERS -o DIR"],
                     dataset, "layers"),
    "gym": Table(["vizflyt gym --project forest --envs 16 --camera 64x48"], gym, "course, observation"),
    "rules": Table(["cargo bench -p vizflyt-arena --bench rules"], rules, "collision rules", turns=1),
    "pose": Table(["cargo bench -p vizflyt-arena --bench pose"], pose,
                  "speed m/s | poses Hz | noise mm | noise deg | latency ms | lost %", turns=1),
    "simulator": Table(["cargo bench -p vizflyt-simulator --bench second"], simulator, "the simulator", turns=1),
    "growth": Table(["tests/bench/run --only growth"], growth.measure, layout=growth.table, turns=1,
                    drawing=("growth.svg", growth.drawing)),
}


class ByHand(NamedTuple):
    """A table filled in by hand: its name, its command, and its requirements beyond this program and some minutes."""

    section: str
    command: str
    needs: str


BY_HAND = [
    ByHand("The whole loop: seeds 1 to 20", "cargo test --release -p vizflyt-e2e --test flights -- over_many_seeds",
           "long flights"),
    ByHand("The forest, fast; projects 2 to 5", "vizflyt grade my-p2 --project p2 --seeds 20 --first-seed 100",
           "the Python package, long flights"),
    ByHand("Renderer", "cargo bench -p vizflyt-splat --bench render",
           "captured scenes, which are not part of the project"),
    ByHand("Renderer: peers", "", "brush, web-splat"),
    ByHand("Large scenes", "cargo bench -p vizflyt-splat --bench detail", "a long run"),
    ByHand("A city larger than memory", "tests/bench/city", "6 GB of disk, a long run"),
    ByHand("Weather: effects one by one", "cargo run --release -p vizflyt-splat --example weather", "a long run"),
    ByHand("On a graphics card", "tests/gpu/table; tests/gpu/train", "a graphics card"),
    ByHand("Training a twin", "cargo run --release -p vizflyt-twin --example hall", "a long run"),
    ByHand("Captures", "cargo run --release -p vizflyt-twin --example verdict -- IMAGES MODEL", "pycolmap, a long run"),
    ByHand("Collision rules against the truth", "cargo bench -p vizflyt-scenes --bench collision", "a long run"),
    ByHand("Pose filter: outliers", "tests/pose/run target/release/examples/trajectories", "evo"),
    ByHand("RGB-D codec: captured scenes", "cargo bench -p vizflyt-rgbd --features turbo",
           "captured scenes, which are not part of the project"),
    ByHand("Faults of the network", "VIZFLYT_FAULTS=write cargo test --release -p vizflyt-e2e --test tables faults",
           "nothing: a test holds the file that is shown"),
    ByHand("Many watchers", "VIZFLYT_STRESS_S=600 cargo test --release -p vizflyt-server --test server viewers",
           "a long run"),
    ByHand("Stream: zenoh", "cargo run --release --manifest-path tests/peers/stream/Cargo.toml", "zenoh"),
    ByHand("Bridge", "vizflyt bench bridge", "a computer on which nothing else runs"),
    ByHand("AprilTags", "cargo bench -p vizflyt-e2e --bench locate -- 3", "a long run"),
    ByHand("Visual odometry; attitude filters", "python3 tests/python/odometry.py *.json",
           "the Python package, long flights"),
    ByHand("Learning; other simulators", "tests/peers/learn/run WHEEL", "the Python package, those simulators"),
    ByHand("Build and tests", "tests/run", "an hour"),
]


def by_hand() -> str:
    return markdown(["by hand", "command", "not run here: needs"],
                    [[row.section, f"`{row.command}`" if row.command else "", row.needs] for row in BY_HAND])


def shown(name: str, taken: Taken) -> str:
    """Returns the text between the document's markers: commands, table, and the machine of the figures."""
    table = MEASURED[name]
    if table.layout:
        grid = table.layout(taken.figures)
    else:
        columns, lines = rows(taken.figures)
        corner = table.corner.split(" | ")
        lines = [[*(row.split(", ") if len(corner) > 1 else [row]), *cells] for row, *cells in lines]
        grid = markdown([*corner, *columns], lines)
    turns = "one turn" if taken.turns == 1 else f"the best of {taken.turns} turns"
    where = (f"`tests/bench/run --only {name}`, {taken.date}, {taken.processor}, load {taken.load} at first; "
             f"{turns}; reference: computing {taken.reference.computing_ms:.2f} ms, "
             f"memory {taken.reference.memory_ms:.1f} ms.")
    return "\n".join(["```", *table.commands, "```", "", grid, "", where])
