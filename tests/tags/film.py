"""Reads a capture made by `vizflyt scene generate --capture --tags`, with only pupil-apriltags and OpenCV.

The encoded video has the stated number and size of images, and the tags are at the true positions, row by row of the
rolling shutter.

Usage: film.py VIZFLYT
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import cv2
import numpy as np
from lab import read_layout, rotation_of
from pupil_apriltags import Detector

SECONDS, FRAMES = 40, 420


def poses(image: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns positions and quaternions at the exposure of the upper edge, the middle and the lower edge."""
    named = [image[key] for key in ("upper_edge", "world_from_cam", "lower_edge")]
    turns = np.array([pose["rotation_xyzw"] for pose in named])
    # Neighbouring quaternions in the same hemisphere.
    turns[0] *= np.sign(turns[0] @ turns[1])
    turns[2] *= np.sign(turns[2] @ turns[1])
    return np.array([pose["position_m"] for pose in named]), turns, np.array([0.0, 0.5, 1.0])


def corner_px(image: dict, camera: dict, corner_m: np.ndarray) -> np.ndarray | None:
    """Returns the pixel of a point in the row exposed at that moment; pixel centres at +0.5."""
    matrix = np.array([[camera["fx_px"], 0, camera["cx_px"]], [0, camera["fy_px"], camera["cy_px"]], [0, 0, 1]])
    lens = camera["distortion"]
    bend = np.array([lens[key] for key in ("k1", "k2", "p1", "p2", "k3")])
    positions, turns, shares = poses(image)
    share, pixel = 0.5, None
    for _ in range(6):
        # Lagrange's parabola through the three poses.
        weights = [
            np.prod([(share - other) / (mine - other) for other in shares if other != mine]) for mine in shares
        ]
        turn = weights @ turns
        world_from_cam = rotation_of(*(turn / np.linalg.norm(turn)).tolist())
        seen = world_from_cam.T @ (corner_m - weights @ positions)
        if seen[2] < 0.2:
            return None
        projected, _ = cv2.projectPoints(seen[None], np.zeros(3), np.zeros(3), matrix, bend)
        pixel = projected.reshape(2)
        share = float(pixel[1]) / camera["height_px"]
    return pixel


def main() -> None:
    vizflyt = sys.argv[1]
    with tempfile.TemporaryDirectory() as name:
        film = pathlib.Path(name) / "hall.mp4"
        options = ["--seed", "3", "--tags", "--seconds", str(SECONDS), "--frames", str(FRAMES)]
        subprocess.run(
            [vizflyt, "scene", "generate", "room", *options, "--capture", str(film)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        truth = json.loads(film.with_suffix(".truth.json").read_text())
        layout = read_layout(film.with_suffix(".tags.toml"))
        assert [tag.number for tag in layout] == [tag["id"] for tag in truth["tags"]]
        camera = truth["camera"]
        # ffmpeg decodes; OpenCV counts the images in its input.
        video = cv2.VideoCapture(str(film))
        detector = Detector(families="tag36h11", nthreads=2, quad_decimate=1.0, refine_edges=1)
        count, found, off, inward, false = 0, 0, [], [], 0
        seen: set[int] = set()
        while True:
            good, colours = video.read()
            if not good:
                break
            assert colours.shape == (camera["height_px"], camera["width_px"], 3), colours.shape
            image = truth["images"][count]
            assert abs(image["stamp_ns"] - count / camera["rate_hz"] * 1e9) < 2
            count += 1
            if count % 5:
                continue
            grey = cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)
            for tag in detector.detect(grey):
                if tag.hamming > 0 or tag.decision_margin < 30:
                    continue
                placed = next((known for known in layout if known.number == tag.tag_id), None)
                if placed is None:
                    false += 1
                    continue
                found += 1
                seen.add(tag.tag_id)
                half = placed.size_m / 2
                # Lower left first, counter-clockwise, in the detector's order.
                for (x, y), corner in zip([(-1, -1), (1, -1), (1, 1), (-1, 1)], tag.corners, strict=True):
                    corner_m = placed.position_m + placed.rotation @ np.array([x * half, y * half, 0.0])
                    expected = corner_px(image, camera, corner_m)
                    assert expected is not None, f"tag {tag.tag_id} was found behind the camera"
                    off.append(corner - expected)
                    toward = np.asarray(tag.center) - expected
                    inward.append(off[-1] @ toward / np.linalg.norm(toward))
    assert count == FRAMES == len(truth["images"]), f"{count} images of {FRAMES}"
    distances = np.linalg.norm(off, axis=1)
    median, most = np.median(distances), np.percentile(distances, 95)
    bias = np.mean(off, axis=0)
    print(
        f"capture: {count} images, {found} tags found in every fifth, {len(seen)} different; corners off the truth "
        f"{median:.2f} px median, {most:.2f} px 95 %, {np.hypot(*bias):.2f} px on average, "
        f"{np.mean(inward):.2f} px towards the tag's middle (light is blurred before the tone curve: white grows)"
    )
    assert found >= 60, "too few tags are found"
    assert len(seen) >= 5, seen
    assert false == 0, f"{false} tags are read that are not there"
    assert median < 0.5, "tags are not where the truth says"
    assert most < 1.5, "some tags are not where the truth says"
    assert np.hypot(*bias) < 0.1, "tags are off to one side"


main()
