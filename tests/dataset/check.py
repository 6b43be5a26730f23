"""Checks data sets against independently computed geometry: projected gates, cast rays, warped images."""

import json
import pathlib
import subprocess
import sys

import numpy as np
from PIL import Image
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO

# Bars of a racing window: width and thickness, as in docs/guides/course.md. [m]
BAR_M, THICK_M = 0.16, 0.09

checks = 0


def check(name: str, is_good: bool, found: object) -> None:
    global checks
    checks += 1
    print(f"{'ok    ' if is_good else 'FAILED'} {name}: {found}")
    if not is_good:
        sys.exit(1)


def render(vizflyt: str, folder: pathlib.Path, *options: str) -> pathlib.Path:
    subprocess.run([vizflyt, "dataset", "-o", str(folder), *options], check=True, stdout=subprocess.DEVNULL)
    return folder


def rotation(q: list[float]) -> np.ndarray:
    x, y, z, w = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def matrix(pose: dict) -> np.ndarray:
    """Returns the 4x4 matrix that maps points of the second frame to the first."""
    m = np.eye(4)
    m[:3, :3] = rotation(pose["q_xyzw"])
    m[:3, 3] = pose["p_m"]
    return m


def rays(camera: dict) -> np.ndarray:
    """Returns the rays of all pixels, H x W x 3 in cam, z = 1."""
    u, v = np.meshgrid(np.arange(camera["width_px"]) + 0.5, np.arange(camera["height_px"]) + 0.5)
    x = (u - camera["cx_px"]) / camera["fx_px"]
    y = (v - camera["cy_px"]) / camera["fy_px"]
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def cast_box(origin: np.ndarray, direction: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance at which rays in the box's axes enter it (infinite for a miss), and the axis of the entry
    face."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / direction
        low, high = (-half - origin) * inverse, (half - origin) * inverse
    near, far = np.minimum(low, high), np.maximum(low, high)
    enters, leaves = near.max(axis=-1), far.min(axis=-1)
    is_hit = (enters <= leaves) & (enters > 0.0)
    return np.where(is_hit, enters, np.inf), near.argmax(axis=-1)


def frame_depth(camera: dict, gate: dict) -> np.ndarray:
    """Returns the depth of only the four bars of a window; infinite elsewhere. [m]"""
    cam_from_gate = matrix(gate["cam_from_gate"])
    gate_from_cam = np.linalg.inv(cam_from_gate)
    direction = rays(camera) @ gate_from_cam[:3, :3].T
    y, z = np.array(gate["size_m"]) / 2.0
    bars = [
        ((0, y + BAR_M / 2, 0), (THICK_M / 2, BAR_M / 2, z + BAR_M)),
        ((0, -y - BAR_M / 2, 0), (THICK_M / 2, BAR_M / 2, z + BAR_M)),
        ((0, 0, z + BAR_M / 2), (THICK_M / 2, y, BAR_M / 2)),
        ((0, 0, -z - BAR_M / 2), (THICK_M / 2, y, BAR_M / 2)),
    ]
    depths = [cast_box(gate_from_cam[:3, 3] - np.array(c), direction, np.array(h))[0] for c, h in bars]
    return np.minimum.reduce(depths)


def cast(volumes: list, camera: dict, world_from_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns true depth [m] and true normals in cam, of boxes and half spaces."""
    direction = rays(camera) @ world_from_cam[:3, :3].T
    eye = world_from_cam[:3, 3]
    depth = np.full(direction.shape[:2], np.inf)
    normals = np.zeros(direction.shape)
    for volume in volumes:
        kind, values = next(iter(volume.items()))
        if kind == "half_space":
            normal = np.array(values["normal"])
            down = direction @ normal
            with np.errstate(divide="ignore"):
                found = np.where(down < 0, (values["offset_m"] - eye @ normal) / down, np.inf)
            outward = np.broadcast_to(normal, direction.shape)
        elif kind == "cuboid":
            turn = rotation(values["rotation"])
            inside = direction @ turn
            found, axis = cast_box((eye - np.array(values["center_m"])) @ turn, inside, np.array(values["half_m"]))
            outward = turn.T[axis]
        else:
            raise SystemExit(f"a hall has no {kind}")
        is_nearer = (found > 0) & (found < depth)
        depth = np.where(is_nearer, found, depth)
        facing = np.where((outward * direction).sum(axis=-1, keepdims=True) > 0, -outward, outward)
        normals = np.where(is_nearer[..., None], facing, normals)
    return depth, normals @ world_from_cam[:3, :3]


def near_edge(mask: np.ndarray, reach: int = 1) -> np.ndarray:
    """Returns the pixels within `reach` of a change of the mask."""
    changed = np.zeros_like(mask)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            changed |= np.roll(mask, (dy, dx), axis=(0, 1)) != mask
    return changed


def png(path: pathlib.Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def flow_png(path: pathlib.Path) -> np.ndarray:
    """Returns a PNG of 16 bits, H x W x 3: Pillow reads it with 8 bits, so it is decoded here (PNG, section 9)."""
    import struct
    import zlib

    data = path.read_bytes()
    at, packed, width, height = 8, b"", 0, 0
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, bits, colour = struct.unpack(">IIBB", body[:10])
            assert (bits, colour) == (16, 2)
        elif kind == b"IDAT":
            packed += body
        at += 12 + length
    raw = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, 1 + 6 * width)
    rows = np.zeros((height, 6 * width), np.uint8)
    for y in range(height):
        line, above = raw[y, 1:], rows[y - 1] if y else np.zeros(6 * width, np.uint8)
        assert raw[y, 0] in (0, 2), f"filter {raw[y, 0]}"
        rows[y] = line + above if raw[y, 0] == 2 else line
    return rows.view(">u2").reshape(height, width, 3).astype(np.float64)


def coco_set(folder: pathlib.Path) -> None:
    """Checks masks, boxes and corners, read by pycocotools, against the images and projected gates."""
    ious, corners_off, seen, hidden = [], [], 0, 0
    annotations, explained = 0, []
    for split in ("train", "val"):
        coco = COCO(str(folder / f"annotations/instances_{split}.json"))
        names = {category["id"]: category["name"] for category in coco.loadCats(coco.getCatIds())}
        for image_id in coco.getImgIds():
            info = coco.loadImgs(image_id)[0]
            stem = info["file_name"].removesuffix(".png")
            ids = png(folder / f"instances/{split}/{stem}.png")
            depth = png(folder / f"depth/{split}/{stem}.png") / 1000.0
            record = json.loads((folder / f"records/{split}/{stem}.json").read_text())
            camera = record["camera"]
            for annotation in coco.loadAnns(coco.getAnnIds(image_id)):
                annotations += 1
                mask = coco.annToMask(annotation).astype(bool)
                assert (mask == (ids == annotation["instance"])).all(), f"{stem}: the mask is not that of the image"
                assert annotation["area"] == mask.sum()
                tight = coco_mask.toBbox(annotation["segmentation"])
                assert (tight == np.array(annotation["bbox"])).all(), f"{stem}: {tight} is not {annotation['bbox']}"
                if names[annotation["category_id"]] != "gate":
                    continue
                gate = next(gate for gate in record["gates"] if gate["id"] == annotation["instance"])
                assert np.allclose(matrix(gate["cam_from_gate"]), matrix(annotation["cam_from_gate"]), atol=1e-12)
                # The mask: pixels of the bars, except those behind nearer objects; pixels at edges may belong to
                # either.
                alone = frame_depth(camera, gate)
                there = np.isfinite(alone)
                hides = (depth > 0) & (depth < np.where(there, alone, 0) - 0.1)
                expected = there & ~hides
                inner = ~near_edge(there) & ~near_edge(ids == annotation["instance"])
                if (expected & inner).sum() > 50:
                    explained.append((expected[inner] == mask[inner]).mean())
                    either = (expected | mask).sum()
                    if annotation["area"] > 800:
                        ious.append((expected & mask).sum() / either)
                # The corners, computed from the pose only.
                y, z = np.array(gate["size_m"]) / 2.0
                points = np.array([[0, y, z, 1], [0, -y, z, 1], [0, -y, -z, 1], [0, y, -z, 1]])
                points = (matrix(gate["cam_from_gate"]) @ points.T)[:3].T
                for point, (u, v, visibility) in zip(points, np.reshape(annotation["keypoints"], (4, 3))):
                    if visibility == 0:
                        continue
                    projected = np.array([
                        camera["fx_px"] * point[0] / point[2] + camera["cx_px"],
                        camera["fy_px"] * point[1] / point[2] + camera["cy_px"],
                    ])
                    corners_off.append(np.abs(projected - (u, v)).max())
                    before = depth[int(v), int(u)]
                    is_hidden = 0 < before < point[2] - 0.12 - 1e-3
                    assert visibility == (1 if is_hidden else 2) or abs(before - point[2] + 0.12) < 2e-3
                    seen += visibility == 2
                    hidden += visibility == 1
    check("annotations that pycocotools reads as the images have them", annotations > 100, annotations)
    check("corners from the pose alone, worst [px]", max(corners_off) < 1e-6, max(corners_off))
    check("corners seen and hidden", seen > 50 and hidden > 3, (int(seen), int(hidden)))
    share = float(np.mean(explained))
    check("pixels off the edges where mask and projected bars agree", share > 0.998, f"{share:.5f}")
    median = float(np.median(ious))
    check("IoU of large gates with their projected bars, edges included, median", median > 0.85, f"{median:.4f}")


def yolo_set(folder: pathlib.Path) -> None:
    """Checks polygons, filled by the even-odd rule, against the images' masks."""
    polygons = 0
    names = [line.split(": ")[1] for line in (folder / "data.yaml").read_text().splitlines() if line.startswith("  ")]
    check("classes of data.yaml", names == ["gate"], names)
    for path in sorted((folder / "labels/train").glob("*.txt")):
        record = json.loads((folder / f"records/train/{path.stem}.json").read_text())
        ids = png(folder / f"instances/train/{path.stem}.png")
        height, width = ids.shape
        things = [thing for thing in record["things"] if thing["class"] == "gate" and thing["area_px"] >= 12]
        lines = path.read_text().splitlines()
        assert len(lines) == len(things), path
        for line, thing in zip(lines, things):
            corners = np.array(line.split()[1:], float).reshape(-1, 2) * (width, height)
            inside = np.zeros(ids.shape, bool)
            x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0)):
                if ay != by:
                    crosses = (ay > y) != (by > y)
                    inside ^= crosses & (x < ax + (y - ay) / (by - ay) * (bx - ax))
            assert (inside == (ids == thing["id"])).all(), f"{path}: {thing['name']}"
            polygons += 1
    check("polygons of YOLO that fill their masks", polygons > 10, polygons)


def true_surfaces(vizflyt: str, folder: pathlib.Path) -> None:
    """Checks depth and normals against rays cast at the true solids, and masks of parts defined by boxes."""
    room = folder / "race"
    subprocess.run(
        [vizflyt, "scene", "generate", "race", "--seed", "5", "-o", str(room)], check=True, stdout=subprocess.DEVNULL
    )
    truth = json.loads((room / "truth.json").read_text())
    options = ["--scene", str(room), "--images", "8", "--size", "160x120", "--val", "0"]
    data = render(vizflyt, folder / "surfaces", *options)
    depths_off, all_angles, missing = [], [], []
    for path in sorted((data / "records/train").glob("*.json")):
        record = json.loads(path.read_text())
        depth = png(data / f"depth/train/{path.stem}.png") / 1000.0
        encoded = png(data / f"normals/train/{path.stem}.png").astype(float)
        still = png(data / f"instances/train/{path.stem}.png") == 0
        true_depth, true_normals = cast(truth, record["camera"], matrix(record["world_from_cam"]))
        # Flat static surfaces: exclude depth edges, pixels beyond the hall's walls, and moving objects.
        slope = np.abs(np.diff(1 / true_depth, 2, axis=0, prepend=0, append=0)) + np.abs(
            np.diff(1 / true_depth, 2, axis=1, prepend=0, append=0)
        )
        edge = slope > 1e-4
        for dy in range(-3, 4):
            for dx in range(-3, 4):
                edge |= np.roll(slope > 1e-4, (dy, dx), axis=(0, 1))
        flat = ~edge & still & np.isfinite(true_depth)
        missing.append((depth[flat] == 0).mean())
        flat &= depth > 0
        depths_off.append(np.abs(depth - true_depth)[flat] / true_depth[flat])
        valid = flat & (encoded.max(axis=-1) > 0)
        normals = encoded[valid] / 127.5 - 1.0
        length = np.linalg.norm(normals, axis=-1)
        assert (np.abs(length - 1) < 0.02).all()
        cosine = (normals * true_normals[valid]).sum(axis=-1) / length
        all_angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    depth_off, angles = np.concatenate(depths_off), np.concatenate(all_angles)
    p50, p90 = np.percentile(depth_off, [50, 90]) * 100
    check("depth off the true surfaces [%], median and 90 %", p50 < 1.5 and p90 < 4.5, f"{p50:.2f} {p90:.2f}")
    check("pixels without depth [%]", np.mean(missing) < 0.005, f"{np.mean(missing) * 100:.2f}")
    p50, p90 = np.percentile(angles, [50, 90])
    check("normals off the true ones [deg], median and 90 %", p50 < 12.0 and p90 < 40.0, f"{p50:.2f} {p90:.2f}")


def flow(folder: pathlib.Path) -> None:
    """Checks the flow of static surfaces against depth and poses; of moving objects and the rest by warping the next
    image."""
    off, warped_error, plain_error, moving = [], [], [], []
    for path in sorted((folder / "records/train").glob("*.json")):
        record = json.loads(path.read_text())
        camera = record["camera"]
        encoded = flow_png(folder / f"flow/train/{path.stem}.png")
        depth = png(folder / f"depth/train/{path.stem}.png") / 1000.0
        ids = png(folder / f"instances/train/{path.stem}.png")
        now, then = (png(folder / f"{name}/train/{path.stem}.png").astype(float) for name in ("images", "next"))
        uv = (encoded[..., :2] - 32768.0) / 64.0
        valid = encoded[..., 2] == 1
        movers = [thing["id"] for thing in record["things"] if thing["class"] in ("moving", "vehicle")]
        is_mover = np.isin(ids, movers)
        next_from_cam = np.linalg.inv(matrix(record["next"]["world_from_cam"])) @ matrix(record["world_from_cam"])
        points = rays(camera) * depth[..., None] @ next_from_cam[:3, :3].T + next_from_cam[:3, 3]
        u, v = np.meshgrid(np.arange(camera["width_px"]) + 0.5, np.arange(camera["height_px"]) + 0.5)
        with np.errstate(divide="ignore", invalid="ignore"):
            target = np.stack([
                camera["fx_px"] * points[..., 0] / points[..., 2] + camera["cx_px"],
                camera["fy_px"] * points[..., 1] / points[..., 2] + camera["cy_px"],
            ], axis=-1)
        still = valid & ~is_mover & (depth > 0.3)
        off.append(np.abs(uv - (target - np.stack([u, v], axis=-1)))[still])
        # Sample the next image at the target of each pixel.
        x, y = u + uv[..., 0] - 0.5, v + uv[..., 1] - 0.5
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        inside = valid & (x0 >= 0) & (y0 >= 0) & (x0 < camera["width_px"] - 1) & (y0 < camera["height_px"] - 1)
        x0, y0 = np.clip(x0, 0, camera["width_px"] - 2), np.clip(y0, 0, camera["height_px"] - 2)
        fx, fy = (x - x0)[..., None], (y - y0)[..., None]
        looked_up = (then[y0, x0] * (1 - fx) + then[y0, x0 + 1] * fx) * (1 - fy) + (
            then[y0 + 1, x0] * (1 - fx) + then[y0 + 1, x0 + 1] * fx
        ) * fy
        warped, plain = np.abs(looked_up - now).mean(axis=-1), np.abs(then - now).mean(axis=-1)
        warped_error.append(warped[inside])
        plain_error.append(plain[inside])
        of_mover = inside & is_mover & ~near_edge(is_mover, 2)
        moving.append(np.stack([warped[of_mover], plain[of_mover]]))
    worst = np.percentile(np.concatenate(off), 99)
    check("flow of what stands still, from depth and poses, 99 % within [px]", worst < 0.15, f"{worst:.3f}")
    warped, plain = np.concatenate(warped_error), np.concatenate(plain_error)
    check(
        "grey values off after warping and before, mean",
        warped.mean() < 0.35 * plain.mean(),
        f"{warped.mean():.2f} {plain.mean():.2f}",
    )
    warped, plain = np.concatenate(moving, axis=1)
    check(
        "the same of what moves",
        len(warped) > 200 and warped.mean() < 0.6 * plain.mean(),
        f"{warped.mean():.2f} {plain.mean():.2f} over {len(warped)} pixels",
    )


def main() -> None:
    vizflyt, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    how = folder / "how.toml"
    how.write_text("[distractors]\ncount = [1, 4]\n[vehicles]\ncount = [0, 2]\n[gates]\nprobability = 0.5\n")
    options = ["--project", "p3", "--seeds", "3", "--images", "72"]
    coco_set(render(vizflyt, folder / "coco", *options, "--randomize", str(how)))
    options = ["--project", "p3", "--images", "16", "--format", "yolo-seg", "--things", "gate", "--val", "0"]
    yolo_set(render(vizflyt, folder / "yolo", *options, "--randomize", str(how)))
    layers = "rgb,next,depth,instances,flow"
    options = ["--project", "p5", "--seed", "4", "--images", "40", "--layers", layers, "--val", "0"]
    flow(render(vizflyt, folder / "flow", *options))
    true_surfaces(vizflyt, folder)
    print(f"{checks} checks passed")


main()
