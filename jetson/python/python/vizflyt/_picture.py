"""Images for notebooks: colour, and depth as colours with a scale."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ._log import LogImage
from ._vizflyt import CameraImage, Observation

_U8 = npt.NDArray[np.uint8]

# From the nearest to the farthest, evenly spaced. [sRGB]
_COLOURS = np.array([[255, 244, 168], [247, 157, 54], [205, 60, 70], [111, 30, 110], [24, 14, 62]])
_NO_RETURN = (90, 90, 90)
_GAP_PX, _BAR_PX, _SCALE_PX = 6, 10, 56
# Digits of 3 x 5 pixels, one row in three bits, from the top; drawn at twice the size.
_DIGITS = {
    "0": (7, 5, 5, 5, 7), "1": (2, 6, 2, 2, 7), "2": (7, 1, 7, 4, 7), "3": (7, 1, 7, 1, 7), "4": (5, 5, 7, 1, 1),
    "5": (7, 4, 7, 1, 7), "6": (7, 4, 7, 5, 7), "7": (7, 1, 1, 1, 1), "8": (7, 5, 7, 5, 7), "9": (7, 5, 7, 1, 7),
    ".": (0, 0, 0, 0, 2), "m": (0, 0, 7, 7, 5),
}  # fmt: skip


class Picture:
    """A picture that a notebook shows as the last line of a cell, or with `IPython.display.display`."""

    def __init__(self, pixels: _U8):
        self.pixels = pixels
        """Shape (H, W, 3), sRGB."""

    def png(self) -> bytes:
        """Returns the picture as a PNG file."""
        height, width, _ = self.pixels.shape
        # Each row begins with its filter type, 0 for none.
        rows = np.zeros((height, 1 + 3 * width), np.uint8)
        rows[:, 1:] = self.pixels.reshape(height, -1)
        head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes())), (b"IEND", b""))
        chunks = (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            for kind, data in parts
        )
        return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the picture as a PNG file."""
        Path(path).write_bytes(self.png())

    def _repr_png_(self) -> bytes:
        return self.png()

    def __repr__(self) -> str:
        height, width, _ = self.pixels.shape
        return f"Picture({width} x {height} px)"


def show(seen: Observation | CameraImage | LogImage, *, far_m: float | None = None) -> Picture:
    """Returns a picture of an image: colour, and depth next to it. An observation gets one row for each camera.

    The colours of depth go from yellow (nearest) to dark blue (`far_m` and beyond [m]; default: the farthest pixel of
    the image). The ends of the scale are in metres along the optical axis. Grey means no return. An image without
    depth, for example of level `g`, is shown without it.

    Raises ValueError for an observation without an image.
    """
    images = seen.cameras if isinstance(seen, Observation) else [seen]
    if not images:
        raise ValueError("this observation has no image yet; take the next one")
    rows = [_beside(image.rgb, *_depth(image.depth, far_m)) for image in images]
    return Picture(_below(rows))


def _depth(depth_m: npt.NDArray[np.float32], far_m: float | None) -> list[_U8]:
    """Returns depth as colours, and its scale; empty if no pixel has a return."""
    returned = depth_m > 0
    if not returned.any():
        return []
    near_m = float(depth_m[returned].min())
    far_m = max(far_m or float(depth_m.max()), near_m + 0.01)
    pixels = _coloured((depth_m - near_m) / (far_m - near_m))
    pixels[~returned] = _NO_RETURN
    return [pixels, _scale(depth_m.shape[0], near_m, far_m)]


def _coloured(share: npt.NDArray[np.floating]) -> _U8:
    """Returns colours (..., 3) of fractions between the nearest (0) and the farthest (1)."""
    at = np.clip(share, 0, 1) * (len(_COLOURS) - 1)
    return np.stack([np.interp(at, range(len(_COLOURS)), channel) for channel in _COLOURS.T], -1).astype(np.uint8)


def _scale(height_px: int, near_m: float, far_m: float) -> _U8:
    """Returns a colour bar with the farthest on top, and both ends in metres."""
    pixels = np.full((height_px, _SCALE_PX, 3), 255, np.uint8)
    pixels[:, :_BAR_PX] = _coloured(np.linspace(1, 0, height_px))[:, None]
    for top, value_m in ((0, far_m), (height_px - 10, near_m)):
        word = np.concatenate([_glyph(letter) for letter in f"{value_m:.1f}m"], axis=1)[:, : _SCALE_PX - _BAR_PX - 3]
        box = pixels[max(top, 0) :, _BAR_PX + 3 :][:10, : word.shape[1]]
        box[word[: box.shape[0]]] = 0
    return pixels


def _glyph(letter: str) -> npt.NDArray[np.bool_]:
    rows = [[bool(row & bit) for bit in (4, 2, 1, 0)] for row in _DIGITS[letter]]
    return np.array(rows).repeat(2, axis=0).repeat(2, axis=1)


def _beside(*pictures: _U8) -> _U8:
    gap = np.full((pictures[0].shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=1)


def _below(rows: list[_U8]) -> _U8:
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, _GAP_PX), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate(padded)[:-_GAP_PX]
