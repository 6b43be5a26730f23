"""Reads printed sheets with an independent build of the AprilTag library.

Usage: read_prints.py VIZFLYT
"""

import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from pupil_apriltags import Detector

DPI = 200
# Two pixels: tolerance of the detector's corners at this resolution.
TOLERANCE_M = 2 * 0.0254 / DPI

PRINTS = {
    "cube": ["cube"],
    "mat": ["mat", "--columns", "3", "--rows", "4", "--paper", "a3"],
    "board": ["board", "--paper", "letter"],
}


def layout(path):
    """Returns the tags of a layout file: id to size. Avoids tomllib, which some of the supported Python versions
    lack."""
    tags = {}
    for line in path.read_text().splitlines():
        key, _, value = line.partition(" = ")
        if key == "id":
            number = int(value)
        elif key == "size_m":
            tags[number] = float(value)
    return tags


def image(path):
    """Reads a binary PGM as written by pdftoppm."""
    magic, size, most, pixels = path.read_bytes().split(b"\n", 3)
    assert (magic, most) == (b"P5", b"255"), (magic, most)
    width, height = (int(n) for n in size.split())
    return np.frombuffer(pixels, np.uint8, width * height).reshape(height, width)


def check(detector, vizflyt, folder, name, args):
    pdf = folder / f"{name}.pdf"
    subprocess.run([vizflyt, "tags", "print", *args, "-o", pdf], check=True, stdout=subprocess.DEVNULL)
    subprocess.run(["pdftoppm", "-r", str(DPI), "-gray", pdf, folder / name], check=True)
    expected = layout(folder / f"{name}.toml")
    seen, worst = set(), 0.0
    for path in sorted(folder.glob(f"{name}-*.pgm")):
        for tag in detector.detect(image(path)):
            assert tag.tag_id in expected, f"{name}: tag {tag.tag_id} is not in the layout"
            assert tag.tag_id not in seen, f"{name}: tag {tag.tag_id} is printed twice"
            seen.add(tag.tag_id)
            corners = tag.corners
            # Lower left first, then counter-clockwise for the reader; rows of an image go down.
            assert corners[0][0] < corners[1][0] and corners[0][1] > corners[3][1], corners
            edges_m = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1) / DPI * 0.0254
            worst = max(worst, np.abs(edges_m - expected[tag.tag_id]).max())
    assert seen == set(expected), f"{name}: not read: {sorted(set(expected) - seen)}"
    assert worst < TOLERANCE_M, f"{name}: edges are {1e3 * worst:.2f} mm off"
    print(f"{name}: {len(seen)} tags, edges within {1e3 * worst:.2f} mm", flush=True)


def main():
    (vizflyt,) = sys.argv[1:]
    detector = Detector(families="tag36h11", quad_decimate=1.0)
    vizflyt = str(pathlib.Path(vizflyt).resolve())
    with tempfile.TemporaryDirectory() as folder:
        for name, args in PRINTS.items():
            check(detector, vizflyt, pathlib.Path(folder), name, args)


main()
# The package's detector sometimes frees memory twice when it is destroyed; all checks are done by now.
os._exit(0)
