"""Detects tags in a folder's images with pupil-apriltags, and compares this project's detections with it and with the
truth."""

import csv
import pathlib
import sys

import numpy as np
from pupil_apriltags import Detector


def read(path):
    """Returns corners (4 x 2, pixels) by image and id."""
    tags = {}
    for image, family, tag, *numbers in csv.reader(path.open()):
        assert family == "tag36h11"
        key = int(image), int(tag)
        assert key not in tags, f"{path.name}: {key} is there twice"
        tags[key] = np.array(numbers, float).reshape(4, 2)
    return tags


def load(path):
    magic, size, most, pixels = path.read_bytes().split(b"\n", 3)
    assert (magic, most) == (b"P5", b"255")
    width, height = map(int, size.split())
    return np.frombuffer(pixels, np.uint8).reshape(height, width)


def rms(found, truth):
    off = [found[key] - truth[key] for key in found]
    return float(np.sqrt(np.mean(np.square(off)) * 2))


def main():
    folder = pathlib.Path(sys.argv[1])
    ours, truth = read(folder / "found.csv"), read(folder / "true.csv")
    detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0, refine_edges=1)
    theirs = {}
    images = sorted(folder.glob("*.pgm"), key=lambda path: int(path.stem))
    for path in images:
        image = load(path)
        height, width = image.shape
        for tag in detector.detect(np.ascontiguousarray(image)):
            corners = np.asarray(tag.corners)
            middle = corners.mean(0)
            rim = middle + 1.15 * (corners - middle)
            # The detector need not find tags cut by the image's border: their corners are at the border.
            whole = (rim >= 0).all() and (rim <= (width, height)).all()
            if tag.hamming <= 1 and tag.decision_margin >= 15 and whole:
                theirs[int(path.stem), tag.tag_id] = corners
    both = ours.keys() & theirs.keys()
    print(f"{len(images)} images: {len(ours)} tags found, {len(theirs)} by pupil-apriltags, {len(both)} by both")
    assert len(images) >= 30 and len(both) >= 150, "too few to compare"
    false = [key for key in ours if key not in truth]
    assert not false, f"found what is not there: {false}"
    missed = theirs.keys() - ours.keys()
    assert len(missed) <= 0.02 * len(theirs), f"missed: {sorted(missed)}"
    for key in both:
        # Corners in another order would differ by an edge length.
        apart = np.linalg.norm(ours[key] - theirs[key], axis=1)
        assert apart.max() < 3.0, f"{key}: {apart} px apart"
    ours_px = rms({key: ours[key] for key in both}, truth)
    theirs_px = rms({key: theirs[key] for key in both}, truth)
    print(f"corners off the truth: {ours_px:.3f} px rms, pupil-apriltags {theirs_px:.3f} px")
    assert ours_px < 0.2, "corners are off"
    assert ours_px <= 1.1 * theirs_px, "corners are worse than the library's own"


main()
