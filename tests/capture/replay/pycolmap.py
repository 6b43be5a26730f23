"""Replaces pycolmap: returns the poses in `tests/capture/recorded` instead of new ones, which vary from run to run. Has
only the functions that `vizflyt scene capture` calls.

FILM_RATE_HZ in the environment is the rate of the film behind the video.
"""

import json
import os
from pathlib import Path
from types import SimpleNamespace

__version__ = "recorded"
RECORDED = Path(__file__).resolve().parent.parent / "recorded"


class Options(SimpleNamespace):
    def __init__(self):
        super().__init__(sift=SimpleNamespace(), mapper=SimpleNamespace())


ImageReaderOptions = FeatureExtractionOptions = ImportedPairingOptions = IncrementalPipelineOptions = Options
CameraMode = SimpleNamespace(SINGLE=None)


def set_random_seed(seed):
    assert seed == 1


def extract_features(database, images, camera_mode, reader_options, extraction_options):
    lens = (RECORDED / "cameras.txt").read_text().split()
    asked = [float(value) for value in reader_options.camera_params.split(",")]
    assert reader_options.camera_model == lens[1], reader_options.camera_model
    # A given lens stays unchanged.
    assert all(abs(a - float(b)) < 1e-9 for a, b in zip(asked, lens[4:], strict=True)), (asked, lens)
    Path(database).touch()


def match_image_pairs(database, pairing_options):
    assert Path(database).is_file()
    names = {name for line in Path(pairing_options.match_list_path).read_text().splitlines() for name in line.split()}
    assert len(names) > 100, names


def incremental_mapping(database, images, models, options):
    """Writes the recorded model of the pictures in the folder `images`, with their names."""
    rate_hz = float(os.environ["FILM_RATE_HZ"])
    pictures = json.loads(Path(images).with_suffix(".json").read_text())["result"]["pictures"]
    name_of = {f"{round(picture['at_s'] * rate_hz):05d}.jpg": picture["name"] for picture in pictures}
    target = Path(models) / "0"
    target.mkdir(parents=True)
    lines = (RECORDED / "images.txt").read_text().splitlines()
    kept = set()
    with open(target / "images.txt", "w", encoding="ascii") as file:
        for head, seen in zip(lines[::2], lines[1::2], strict=True):
            *values, film = head.split()
            if film in name_of:
                kept.add(values[0])
                file.write(f"{' '.join(values)} {name_of[film]}\n{seen}\n")
    with open(target / "points3D.txt", "w", encoding="ascii") as file:
        for line in (RECORDED / "points3D.txt").read_text().splitlines():
            head, track = line.split()[:8], line.split()[8:]
            seen_by = [pair for pair in zip(track[::2], track[1::2], strict=True) if pair[0] in kept]
            file.write(" ".join([*head, *(word for pair in seen_by for word in pair)]) + "\n")
    (target / "cameras.txt").write_text((RECORDED / "cameras.txt").read_text())
    return {0: None}
