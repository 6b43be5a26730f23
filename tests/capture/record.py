"""Records poses computed by pycolmap, for tests that must not depend on a new run of it.

    python record.py HALL FILM_RATE_HZ MODEL

HALL is the output of `vizflyt scene capture` for a film's video. Writes a COLMAP model as text to the folder MODEL,
with the film's names of the pictures and a random part of the points. A selection of the longest tracks would omit the
floor.
"""

import json
import random
import sys
from pathlib import Path

import pycolmap

# Minimum number of points kept for each picture, if it has them: about 1.8 MB.
POINTS_OF_A_PICTURE = 260


def main(hall: Path, rate_hz: float, target: Path) -> None:
    pictures = json.loads((hall / "stages/images.json").read_text())["result"]["pictures"]
    name_of = {picture["name"]: f"{round(picture['at_s'] * rate_hz):05d}.jpg" for picture in pictures}
    found = json.loads((hall / "stages/poses.json").read_text())["result"]["models"][0]["folder"]
    model = pycolmap.Reconstruction(hall.parent / found)
    images = sorted(model.images.values(), key=lambda image: image.name)
    # Points seen by only two pictures carry little information.
    points = [(point_id, point) for point_id, point in sorted(model.points3D.items()) if point.track.length() > 2]
    random.Random(1).shuffle(points)
    counts = {image.image_id: 0 for image in images}
    kept = []
    for point_id, point in points:
        seen_by = sorted({element.image_id for element in point.track.elements})
        if any(counts[image] < POINTS_OF_A_PICTURE for image in seen_by):
            kept.append(point_id)
            for image in seen_by:
                counts[image] += 1
    number_of = {point_id: number for number, point_id in enumerate(kept, start=1)}

    target.mkdir(parents=True, exist_ok=True)
    with open(target / "cameras.txt", "w", encoding="ascii") as file:
        for camera in model.cameras.values():
            values = " ".join(repr(float(value)) for value in camera.params)
            file.write(f"{camera.camera_id} {camera.model.name} {camera.width} {camera.height} {values}\n")
    tracks: dict[int, list[str]] = {number: [] for number in number_of.values()}
    with open(target / "images.txt", "w", encoding="ascii") as file:
        for image in images:
            pose = image.cam_from_world()
            x, y, z, w = pose.rotation.quat
            values = " ".join(f"{value:.9f}" for value in (w, x, y, z, *pose.translation))
            file.write(f"{image.image_id} {values} {image.camera_id} {name_of[image.name]}\n")
            seen = [point for point in image.points2D if point.has_point3D() and point.point3D_id in number_of]
            for index, point in enumerate(seen):
                tracks[number_of[point.point3D_id]] += [str(image.image_id), str(index)]
            observations = (f"{p.xy[0]:.2f} {p.xy[1]:.2f} {number_of[p.point3D_id]}" for p in seen)
            file.write(" ".join(observations) + "\n")
    with open(target / "points3D.txt", "w", encoding="ascii") as file:
        for point_id, number in number_of.items():
            point = model.points3D[point_id]
            place = " ".join(f"{value:.5f}" for value in point.xyz)
            color = " ".join(str(int(value)) for value in point.color)
            file.write(f"{number} {place} {color} {point.error:.3f} {' '.join(tracks[number])}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]))
