"""Cost of an image, a server and a log as a function of a size: splats, pixels, cameras, vehicles, pages, length.

Each curve is measured in one run and judged by its slope in logarithms: 1 is proportional growth, 0 is constant cost.
"""

import array
import json
import math
import re
from pathlib import Path
from typing import NamedTuple

import plot
import viewers
from document import markdown
from figures import Figures, count, time
from lab import Lab


class Curve(NamedTuple):
    """A curve: its quantity, its variable, and the maximum exponent at its end."""

    panel: str
    over: str
    name: str
    most: float


# Tolerance above 1 for curves that must be at most proportional: noise, and caches that overflow.
PROPORTIONAL = 1.15
CURVES = {
    "image, every splat": Curve("processor of a 640x480 image [ms]", "splats in the scene", "every splat",
                                PROPORTIONAL),
    "image, adaptive": Curve("processor of a 640x480 image [ms]", "splats in the scene", "adaptive", 0.9),
    "scene, memory": Curve("rendering a scene: memory [MB]", "splats in the scene", "greatest, while packed",
                           PROPORTIONAL),
    "scene, packing": Curve("reading and packing a scene [ms]", "splats in the scene", "processor", PROPORTIONAL),
    "pixels": Curve("processor of an image [ms]", "pixels", "the forest", PROPORTIONAL),
    "server, vehicles": Curve("a server: processor [ms]", "vehicles, cameras, pages", "vehicles: 100 poses of each",
                              PROPORTIONAL),
    "server, cameras": Curve("a server: processor [ms]", "vehicles, cameras, pages", "cameras: a picture of each",
                             PROPORTIONAL),
    "server, pages": Curve("a server: processor [ms]", "vehicles, cameras, pages", "pages: a picture to each",
                           PROPORTIONAL),
    "server, memory": Curve("a server: memory [MB]", "pages open", "resident", PROPORTIONAL),
    "gym": Curve("processor of a step of all [ms]", "vehicles of `vizflyt gym`", "states", PROPORTIONAL),
    "stats": Curve("`vizflyt stats` of a log [ms]", "flight, without its ends [s]", "processor", PROPORTIONAL),
    "stats, memory": Curve("memory of `vizflyt stats` [MB]", "flight, without its ends [s]", "greatest", 0.3),
}
SPLATS = (10_000, 100_000, 1_000_000, 10_000_000)
SIZES = ("80x60", "160x120", "320x240", "640x480", "1280x960", "2560x1920")


def measure(lab: Lab) -> Figures:
    out: Figures = {}

    def add(curve: str, over: float, figure: float) -> None:
        value = (time if "ms]" in CURVES[curve].panel else count)(figure, 3)
        out[f"{curve} | {over:g}"] = value

    splats(lab, add)
    pixels(lab, add)
    server(lab, add)
    for envs in (1, 4, 16, 64, 256, 1024):
        steps, processor_s = lab.fly("forest", envs, [], seconds=1.5)
        add("gym", envs, processor_s / steps * envs * 1e3)
    logs(lab, add)
    return out


def splats(lab: Lab, add) -> None:
    """Forests side by side, seen from the corner of the whole along one side."""
    camera = lab.camera("growth", 1.0, 0.0, 1.2)
    lab.scene("forest")
    for number in SPLATS:
        name = "growth.ply"
        write_splats(lab.folder / "forest/scene.ply", lab.folder / name, number)
        for curve, detail in (("image, every splat", "full"), ("image, adaptive", "adaptive")):
            used = lab.vizflyt("bench", "render", name, "--camera", camera, "--size", "640x480", "--renderer", "cpu",
                               "--detail", detail, "--images", "10", "--json")
            found = json.loads(used.output)
            add(curve, number, found["processor_ms"])
        add("scene, memory", number, used.peak_mb)
        # Processor time of the command besides its images: five before the counted ones, and these.
        add("scene, packing", number, used.processor_s * 1e3 - 15 * found["processor_ms"])
        (lab.folder / name).unlink()


def write_splats(source: Path, target: Path, number: int) -> None:
    """Writes a PLY with `number` splats: a subset of the forest, or several forests side by side."""
    head, _, body = source.read_bytes().partition(b"end_header\n")
    names = re.findall(rb"property float (\w+)", head)
    width, x, y = len(names), names.index(b"x"), names.index(b"y")
    there = len(body) // (4 * width)
    every = max(1, there // number)
    values = array.array("f", b"".join(body[4 * width * i:4 * width * (i + 1)] for i in range(0, there, every)))
    tile = len(values) // width
    side = math.ceil(math.sqrt(number / tile))
    with target.open("wb") as out:
        out.write(re.sub(rb"element vertex \d+", b"element vertex %d" % number, head) + b"end_header\n")
        written = 0
        while written < number:
            index = written // tile
            copy = values[:]
            for axis, step_m in ((x, 43.0 * (index // side)), (y, 15.0 * (index % side))):
                copy[axis::width] = array.array("f", [value + step_m for value in values[axis::width]])
            here = min(tile, number - written)
            copy[:here * width].tofile(out)
            written += here


def pixels(lab: Lab, add) -> None:
    arena, camera = lab.scene("forest"), lab.camera("growth", 1.0, 0.0, 1.2)
    for size in SIZES:
        wide, high = map(int, size.split("x"))
        found = lab.json("bench", "render", arena, "--camera", camera, "--size", size, "--renderer", "cpu", "--images",
                         "15")
        add("pixels", wide * high, found["processor_ms"])


def server(lab: Lab, add) -> None:
    arena = lab.folder / lab.scene("forest")
    for vehicles in (1, 2, 4, 8):
        taken = viewers.serve(lab.program, arena, vehicles, pages=0, seconds=4.0)
        add("server, vehicles", vehicles, taken.processor_ms / taken.poses * 100)
    text = arena.read_text()
    camera = re.search(r"\[\[cameras\]\]\n(?:[^\[\n].*\n)*", text)[0]
    for cameras in (1, 2, 4, 8):
        more = "".join(camera.replace('"front"', f'"c{number}"') + "rate_hz = 5.0\n" for number in range(cameras))
        arena.with_name(f"cameras-{cameras}.toml").write_text(text.replace(camera, more))
        taken = viewers.serve(lab.program, arena.with_name(f"cameras-{cameras}.toml"), 1, pages=1, seconds=4.0)
        add("server, cameras", cameras, taken.processor_ms / taken.pictures * cameras)
    for pages in (1, 8, 32):
        taken = viewers.serve(lab.program, arena.with_name("cameras-1.toml"), 1, pages, seconds=4.0)
        add("server, pages", pages, taken.processor_ms / taken.pictures * pages)
        add("server, memory", pages, taken.resident_mb)


def logs(lab: Lab, add) -> None:
    """Logs of flights through the forest at a third of its speed, landed after different times."""
    folder = lab.folder / "slow"
    folder.mkdir(exist_ok=True)
    arena = lab.folder / lab.scene("forest")
    (folder / "scene.ply").write_bytes(arena.with_name("scene.ply").read_bytes())
    (folder / "arena.toml").write_text(arena.read_text().replace("max_speed_mps = 6.0", "max_speed_mps = 1.0"))
    for seconds in (3, 12, 48):
        flown = lab.demo("slow.json", "--scene", str(folder / "arena.toml"), "--seconds", str(seconds))
        log = lab.folder / flown["log"]
        used = lab.vizflyt("stats", str(log), "--json")
        add("stats", seconds, used.processor_s * 1e3)
        add("stats, memory", seconds, used.peak_mb)
        log.unlink()


def points(figures: Figures, curve: str) -> list[tuple[float, float]]:
    """Returns the points of a curve, sorted."""
    start = f"{curve} | "
    return sorted((float(name.removeprefix(start)), figure.value) for name, figure in figures.items()
                  if name.startswith(start))


def exponent(curve: list[tuple[float, float]]) -> float:
    """Returns the slope of a curve's last step in logarithms: 1 is proportional growth."""
    (x0, y0), (x1, y1) = curve[-2:]
    return math.log(y1 / y0) / math.log(x1 / x0)


def table(figures: Figures) -> str:
    lines = []
    for name, curve in CURVES.items():
        found = points(figures, name)
        slope = exponent(found)
        verdict = "" if slope <= curve.most else " **more than it may**"
        lines.append([f"{curve.panel}: {curve.name}", curve.over, " to ".join(f"{found[i][0]:,.0f}" for i in (0, -1)),
                      " to ".join(f"{found[i][1]:.3g}" for i in (0, -1)), f"{slope:.2f}{verdict}", f"{curve.most:g}"])
    grid = markdown(["what", "over", "from, to", "takes", "exponent of the last step", "at most"], lines)
    return f"![Time or memory of each computation against the size of its input](growth.svg)\n\n{grid}"


def drawing(figures: Figures) -> str:
    """Returns the SVG, with one panel for each kind of figure."""
    panels: dict[tuple[str, str], list[plot.Curve]] = {}
    for name, curve in CURVES.items():
        panels.setdefault((curve.panel, curve.over), []).append(plot.Curve(curve.name, points(figures, name)))
    return plot.svg([plot.Panel(title.replace("`", ""), over.replace("`", ""), curves)
                     for (title, over), curves in panels.items()])
