"""An independent lab: renders camera images of printed tags without any of the code under test.

Tags come from OpenCV (`cv2.aruco`), lenses follow OpenCV's distortion model, poses are matrices. Every pixel is a ray:
the lens is inverted at each pixel of an image with three times the resolution, the ray intersects the tag's plane at
the tag's pose while this row is exposed, and the ink there is averaged over the pixel and the exposure. Then blur and
noise are added.

Frames as in docs/COORDINATES.md: `world` (z up), `body` (forward, left, up), `cam` (right, down, forward). Pixels
follow OpenCV: the centre of the first is (0, 0).
"""

import json
import pathlib
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

FINE = 3
# Cells of a tag with its white rim: eight of border and data, one of paper on each side.
CELLS = 10
RIM = CELLS / 8
BLACK, WHITE, WALL = 35.0, 205.0, 118.0

Pose = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""At times [s], n of them: rotations (n x 3 x 3) and positions (n x 3) [m], from an object to the world."""


@dataclass
class Tag:
    """A tag of a layout: its centre and its axes (right, up, towards the reader)."""

    number: int
    size_m: float
    position_m: np.ndarray
    rotation: np.ndarray


def rotation_of(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Returns the matrix of a quaternion."""
    x, y, z, w = np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: np.ndarray) -> list[float]:
    """Returns the quaternion (x, y, z, w) of a matrix."""
    vector = cv2.Rodrigues(rotation)[0].ravel()
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else vector
    return [*(np.sin(angle / 2) * axis).tolist(), float(np.cos(angle / 2))]


def read_layout(path: pathlib.Path) -> list[Tag]:
    """Returns the tags of a layout file. Avoids tomllib, which some of the supported Python versions lack."""
    tags: list[dict] = []
    for line in path.read_text().splitlines():
        if line == "[[tags]]":
            tags.append({})
        key, _, value = line.partition(" = ")
        if tags and value and key != "family":
            tags[-1][key] = json.loads(value)
    return [
        Tag(tag["id"], tag["size_m"], np.array(tag["position_m"]), rotation_of(*tag["rotation_xyzw"])) for tag in tags
    ]


def scale_layout(path: pathlib.Path, scale: float, output: pathlib.Path) -> None:
    """Writes a layout with all lengths multiplied by `scale`."""
    lines = []
    for line in path.read_text().splitlines():
        key, _, value = line.partition(" = ")
        if key == "size_m":
            line = f"{key} = {json.loads(value) * scale}"
        elif key == "position_m":
            line = f"{key} = {[x * scale for x in json.loads(value)]}"
        lines.append(line)
    output.write_text("\n".join(lines) + "\n")


def fixed(rotation: np.ndarray, position_m: np.ndarray) -> Pose:
    """Returns the constant pose of a static object."""
    return lambda t_s: (np.broadcast_to(rotation, (len(t_s), 3, 3)), np.broadcast_to(position_m, (len(t_s), 3)))


def looking(from_m: np.ndarray, to_m: np.ndarray, roll_rad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns rotation and position of a camera that looks from one point at another, upright except for `roll_rad`."""
    z = (to_m - from_m) / np.linalg.norm(to_m - from_m)
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return rotation @ cv2.Rodrigues(np.array([0.0, 0.0, roll_rad]))[0], from_m


def turned(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Returns rotations of yaw about z, then pitch about y, then roll about x. [rad]"""
    (cz, cy, cx), (sz, sy, sx) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    rows = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


@dataclass
class Lens:
    """A lens with OpenCV's model; the principal point is relative to the centre of the first pixel."""

    width: int = 960
    height: int = 600
    matrix: np.ndarray = field(
        default_factory=lambda: np.array([[702.0, 0.0, 476.3], [0.0, 700.5, 303.1], [0.0, 0.0, 1.0]])
    )
    distortion: np.ndarray = field(default_factory=lambda: np.array([-0.13, 0.035, 0.0006, -0.0008, 0.0]))

    def __post_init__(self) -> None:
        # Rays of the fine image, computed once for each lens.
        across = (np.arange(self.width * FINE) + 0.5) / FINE - 0.5
        down = (np.arange(self.height * FINE) + 0.5) / FINE - 0.5
        pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-10)
        slopes = cv2.undistortPoints(pixels, self.matrix, self.distortion, criteria=stop)
        self.slopes = slopes.reshape(self.height * FINE, self.width * FINE, 2).astype(np.float32)

    def project(self, p_cam: np.ndarray) -> np.ndarray:
        """Returns the pixels of points ahead of the camera (n x 3)."""
        return cv2.projectPoints(p_cam, np.zeros(3), np.zeros(3), self.matrix, self.distortion)[0].reshape(-1, 2)


@dataclass
class Sensor:
    """Exposure of the images."""

    exposure_s: float = 0.004
    # From the first row's exposure to the last one's; the stamp is the middle row's.
    readout_s: float = 0.0
    blur_px: float = 0.6
    noise: float = 3.0


class Camera:
    """Takes pictures of static or moving tags."""

    def __init__(self, lens: Lens, pose: Pose, sensor: Sensor, seed: int) -> None:
        self.lens, self.pose, self.sensor = lens, pose, sensor
        self.random = np.random.default_rng(seed)
        shape = (lens.height, lens.width)
        self.noises = [self.random.normal(0, sensor.noise, shape).astype(np.float32) for _ in range(3)]
        # A wall of soft spots; it does not move with the camera, and contains no tag.
        spots = self.random.normal(0, 1, (lens.height // 24 + 1, lens.width // 24 + 1)).astype(np.float32)
        self.wall = WALL + 14 * cv2.resize(spots, (lens.width, lens.height), interpolation=cv2.INTER_CUBIC)

    def leave(self, tags: list[Tag], pose: Pose) -> None:
        """Adds tags that do not move relative to the camera to the wall."""
        for tag in tags:
            self._paint(self.wall, tag, pose, 0.0)

    def image(self, groups: list[tuple[list[Tag], Pose]], t_s: float) -> np.ndarray:
        """Returns the image at an instant, that of the middle row."""
        canvas = self.wall.copy()
        shown = []
        now = np.array([t_s])
        r_cam, p_cam = (value[0] for value in self.pose(now))
        for tags, pose in groups:
            r, p = (value[0] for value in pose(now))
            for tag in tags:
                middle = r_cam.T @ (r @ tag.position_m + p - p_cam)
                normal = r_cam.T @ r @ tag.rotation[:, 2]
                if middle[2] > 0.05 and normal @ middle < -0.05 * np.linalg.norm(middle):
                    shown.append((float(np.linalg.norm(middle)), tag, pose))
        for _, tag, pose in sorted(shown, key=lambda item: -item[0]):
            self._paint(canvas, tag, pose, t_s)
        if self.sensor.blur_px > 0:
            canvas = cv2.GaussianBlur(canvas, (0, 0), self.sensor.blur_px)
        noise = self.noises[self.random.integers(len(self.noises))]
        canvas += np.roll(noise, tuple(self.random.integers(0, 600, 2)), (0, 1))
        return np.clip(np.rint(canvas), 0, 255).astype(np.uint8)

    def _tag_in_cam(self, tag: Tag, pose: Pose, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r_cam, p_cam = self.pose(t_s)
        r, p = pose(t_s)
        back = np.swapaxes(r_cam, 1, 2)
        rotation = back @ r @ tag.rotation
        position = back @ (r @ tag.position_m + p - p_cam)[:, :, None]
        return rotation, position[:, :, 0]

    def _paint(self, canvas: np.ndarray, tag: Tag, pose: Pose, t_s: float) -> None:
        sensor, height = self.sensor, self.lens.height
        half = tag.size_m * RIM / 2
        square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
        # Positions of the tag while the image is exposed.
        span_s = (sensor.readout_s + sensor.exposure_s) / 2
        corners = []
        for moment in (t_s - span_s, t_s, t_s + span_s):
            rotation, position = self._tag_in_cam(tag, pose, np.array([moment]))
            p_cam = square @ rotation[0].T + position[0]
            if p_cam[:, 2].min() < 0.02 or np.abs(p_cam[:, :2] / p_cam[:, 2:]).max() > 1.2:
                return
            corners.append(self.lens.project(p_cam))
        seen = np.concatenate(corners)
        low = np.maximum(np.floor(seen.min(0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(seen.max(0)).astype(int) + 2, [self.lens.width, height])
        if (high <= low).any():
            return
        slopes = self.lens.slopes[low[1] * FINE : high[1] * FINE, low[0] * FINE : high[0] * FINE]
        rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1), np.float32)], axis=-1)
        rows = (np.arange(low[1] * FINE, high[1] * FINE) + 0.5) / FINE / height - 0.5
        edge_px = float(np.linalg.norm(corners[1][0] - corners[1][1]))
        ink, cell_px = texture(tag.number, edge_px * FINE / CELLS)
        total = np.zeros(slopes.shape[:2], np.float32)
        cover = np.zeros(slopes.shape[:2], np.float32)
        for moment in (np.arange(3) - 1) / 3 * sensor.exposure_s if sensor.exposure_s > 0 else [0.0]:
            times_s = t_s + moment + rows * sensor.readout_s
            rotation, position = self._tag_in_cam(tag, pose, times_s)
            # A ray intersects the plane at (x, y) of the tag: the inverse of [right, up, middle].
            inverse = np.linalg.inv(np.stack([rotation[:, :, 0], rotation[:, :, 1], position], axis=2))
            met = np.einsum("rij,rcj->rci", inverse.astype(np.float32), rays)
            place = met[..., :2] / met[..., 2:] / (2 * half) * [1, -1] + 0.5
            u, v = (np.ascontiguousarray(place[..., i] * CELLS * cell_px - 0.5, np.float32) for i in (0, 1))
            inside = ((place >= 0) & (place <= 1)).all(-1) & (met[..., 2] > 0)
            value = cv2.remap(ink, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            total += np.where(inside, value, 0)
            cover += inside
        count = 3 if sensor.exposure_s > 0 else 1
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        total, cover = (cv2.resize(x / count, size, interpolation=cv2.INTER_AREA) for x in (total, cover))
        place_of = canvas[low[1] : high[1], low[0] : high[0]]
        place_of[:] = total + (1 - cover) * place_of


_textures: dict[tuple[int, int], np.ndarray] = {}


def texture(number: int, cell_px: float) -> tuple[np.ndarray, int]:
    """Returns a tag with its rim at a suitable resolution, and its pixels per cell."""
    fine = int(min(max(2 ** round(np.log2(max(cell_px, 1))), 4), 64))
    if (number, fine) not in _textures:
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        cells = cv2.aruco.generateImageMarker(family, number, 8)
        # OpenCV's tags are upside down in the AprilTag library's convention.
        bits = np.pad(np.rot90(cells > 0, 2), 1, constant_values=True)
        picture = np.where(bits, WHITE, BLACK).astype(np.float32)
        _textures[number, fine] = np.kron(picture, np.ones((fine, fine), np.float32))
    return _textures[number, fine], fine


def write_images(folder: pathlib.Path, images: list[np.ndarray], stamps_s: list[float]) -> None:
    """Writes a folder that `vizflyt tags` reads as a camera."""
    folder.mkdir(parents=True)
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / f"{index}.pgm"), image)
    write_stamps(folder, stamps_s)


def write_stamps(folder: pathlib.Path, stamps_s: list[float]) -> None:
    """Writes the stamps of a folder's images."""
    lines = [f"{index}.pgm,{round(stamp * 1e9)}" for index, stamp in enumerate(stamps_s)]
    (folder / "stamps.csv").write_text("name,stamp_ns\n" + "\n".join(lines) + "\n")
