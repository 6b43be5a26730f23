"""Drawings of parts to cut and print for a lab: STL of every part, and DXF of the frames' plates.

    python3 hardware/lab/drawings.py OUT          # writes all parts into the folder OUT
    python3 hardware/lab/drawings.py OUT guard    # only parts whose names begin with "guard"

All lengths in millimetres; z is up, and parts lie on z = 0. No part was cut, printed or flown: the source of each
number is next to it, and `drawings.md` lists what to measure first. `tests/python/test_lab_book.py` reads the
files back.

A part is a list of pieces. A piece is a polygon of the plan (corners counter-clockwise, shape (n, 2)) with holes, and
the heights between which it is filled. Pieces that touch share the corners on their common edge, so that every edge
of the surface belongs to two triangles.
"""

import math
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

EPS = 1e-9
M2, M3 = 2.2, 3.2           # diameter of a clearance hole for such a screw, printed or milled
STACK, MINI = 30.5, 20.0    # edge of the square of holes of autopilots and speed controllers, large and small


@dataclass(frozen=True)
class Size:
    """One size of vehicle."""

    diagonal: float       # between opposite motor shafts; 160 as in the paper, 220 usual for 5 inches
    propeller: float      # diameter: 3 inches, 5 inches
    motor_circle: float   # circle of the motor's four screws: usual for 15xx and 22xx motors; measure yours
    motor_screw: float
    motor_bore: float     # for the shaft's end and its clip
    pad: float            # radius of the arm's end
    arm: float            # width
    plate: float          # thickness; 2 as in the paper
    plane: float          # propeller's plane above the arm, guard's foot included: measure yours


SIZES = {
    "160": Size(160, 76.2, 12, M2, 6, 10, 12, 2, 18),
    "220": Size(220, 127.0, 16, M3, 8, 13, 15, 4, 27),
}
BODY = 28.0                 # radius of the frame's center: space for the large stack and the slots of the battery strap
CLEARANCE = 4.0             # from the propeller's tip to the guard: blades bend, prints warp
XIAO = (17.8, 21.0)         # Seeed XIAO ESP32C3, across and along its USB plug (its page, rounded up)


@dataclass(frozen=True)
class Circle:
    x: float
    y: float
    diameter: float

    def corners(self) -> np.ndarray:
        n = 24
        turn = np.arange(n) * 2 * math.pi / n
        # The circle lies inside the polygon, so that the screw passes the polygon too.
        r = self.diameter / 2 / math.cos(math.pi / n)
        return np.stack([self.x + r * np.cos(turn), self.y + r * np.sin(turn)], 1)


@dataclass
class Piece:
    outline: np.ndarray
    bottom: float
    top: float
    holes: list = field(default_factory=list)      # Circles, or corners counter-clockwise


# --- plans ---

def box(x0, y0, x1, y1) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def arc(radius, start, end, n, middle=(0.0, 0.0)) -> np.ndarray:
    """Returns n corners from angle `start` to `end` (radians), both ends included."""
    turn = np.linspace(start, end, n)
    return np.stack([middle[0] + radius * np.cos(turn), middle[1] + radius * np.sin(turn)], 1)


def square_of_holes(edge, diameter) -> list:
    h = edge / 2
    return [Circle(x, y, diameter) for x in (-h, h) for y in (-h, h)]


def motor_holes(size: Size, x=0.0, y=0.0) -> list:
    r = size.motor_circle / 2
    screws = [Circle(x + r * math.cos(t), y + r * math.sin(t), size.motor_screw)
              for t in (math.pi / 2 * k for k in range(4))]
    return [Circle(x, y, size.motor_bore), *screws]


def frame(size: Size) -> list:
    """Returns the plate: a disc with four arms at 45 degrees, holes for both stacks, motors and the battery's strap."""
    half = size.arm / 2
    body, pad = math.asin(half / BODY), math.asin(half / size.pad)
    outline, holes = [], [*square_of_holes(STACK, M3), *square_of_holes(MINI, M2)]
    holes += [box(x - 1.5, -8, x + 1.5, 8) for x in (-22.0, 22.0)]
    for k in range(4):
        at = math.pi / 4 + k * math.pi / 2
        motor = (size.diagonal / 2 * math.cos(at), size.diagonal / 2 * math.sin(at))
        outline += [arc(BODY, at - math.pi / 2 + body, at - body, 12)]
        outline += [arc(size.pad, at + math.pi + pad, at + 3 * math.pi - pad, 24, motor)]
        holes += motor_holes(size, *motor)
    return [Piece(np.concatenate(outline), 0, size.plate, holes)]


def guard(size: Size) -> list:
    """Returns a ring around one propeller's tips. It sits between motor and arm, held by the motor's screws."""
    inner = size.propeller / 2 + CLEARANCE
    outer, half, posts = inner + 1.6, 2.5, [math.pi / 2 * k for k in range(4)]
    foot, arm, ring = 2.0, 3.0, (size.plane - 3, size.plane + 3)

    def turns(radius, n):
        """Returns angles of corners at a radius: at the arms, and evenly spaced ones between these."""
        ends = sorted((t + s * math.asin(half / radius)) % (2 * math.pi) for t in posts for s in (-1, 1))
        near = [t for t in np.arange(n) * 2 * math.pi / n
                if all(abs(math.remainder(t - e, 2 * math.pi)) > math.pi / n for e in ends)]
        return np.array(sorted(near + ends))

    def between(all_turns, start, end):
        """Returns the angles from start to end, counter-clockwise."""
        ahead = (all_turns - start + 1e-7) % (2 * math.pi)
        order = np.argsort(ahead)
        return all_turns[order][ahead[order] <= (end - start) % (2 * math.pi) + 2e-7]

    def on(radius, angles):
        return radius * np.stack([np.cos(angles), np.sin(angles)], 1)

    hub, rim = turns(size.pad, 48), turns(inner, 96)
    at_hub, at_rim = math.asin(half / size.pad), math.asin(half / inner)
    pieces = [Piece(on(size.pad, hub), 0, foot, motor_holes(size))]
    for k, t in enumerate(posts):
        bow, end = between(hub, t - at_hub, t + at_hub), between(rim, t - at_rim, t + at_rim)
        pieces += [Piece(np.concatenate([on(inner, end), on(size.pad, bow[::-1])]), 0, arm)]
        pieces += [Piece(np.concatenate([on(outer, end), on(inner, end[::-1])]), 0, ring[1])]
        gap = between(rim, t + at_rim, posts[(k + 1) % 4] - at_rim)
        pieces += [Piece(np.concatenate([on(outer, gap), on(inner, gap[::-1])]), *ring)]
    return pieces


def bridge_tray() -> list:
    """Returns a tray for the XIAO between two holes of the large stack; its USB plug is at the open side."""
    wide, long, wall, gap = XIAO[0] / 2 + 0.3, XIAO[1] / 2 + 0.3, 1.6, 5.5
    x, y, ear, hole = wide + wall, long + wall, STACK / 2 + 4, STACK / 2
    floor = np.array([[-wide, -long], [-gap, -long], [gap, -long], [wide, -long], [wide, long], [-wide, long]])
    rim = np.array([[-gap, -long], [-wide, -long], [-wide, long], [wide, long], [wide, -long], [gap, -long],
                    [gap, -y], [x, -y], [x, -5], [x, 5], [x, y], [-x, y], [-x, 5], [-x, -5], [-x, -y], [-gap, -y]])
    sill = np.array([[-gap, -y], [gap, -y], [gap, -long], [-gap, -long]])
    ears = [np.array([[x, -5], [ear, -5], [ear, 5], [x, 5]]), np.array([[-ear, -5], [-x, -5], [-x, 5], [-ear, 5]])]
    return [Piece(floor, 0, 1.6), Piece(rim, 0, 5.6), Piece(sill, 0, 1.6),
            Piece(ears[0], 0, 1.6, [Circle(hole, 0, M3)]), Piece(ears[1], 0, 1.6, [Circle(-hole, 0, M3)])]


def cube_carrier(face: float) -> list:
    """Returns a cross inside the cube of `vizflyt tags print cube --face-mm`, with faces on 5 mm foam core."""
    reach, width, tab, deep = face / 2 - 5, 5.0, 20.0, 8.0
    side = np.array([[22, -width], [reach - deep, -width], [reach - deep, -tab], [reach, -tab],
                     [reach, tab], [reach - deep, tab], [reach - deep, width], [22, width], [22, 22]])
    turn = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    return [Piece(np.concatenate([side @ t.T for t in turn]), 0, 2, square_of_holes(STACK, M3))]


def leg() -> list:
    """Returns a leg that holds an arm at 90 mm, by two ties. A lens 10 mm below the plate is then at 80 mm."""
    outline = np.array([[-9, 0], [9, 0], [9, 4], [3, 10], [3, 85], [10, 85], [10, 90], [-10, 90], [-10, 85], [-3, 85],
                        [-3, 10], [-9, 4]], float)
    return [Piece(outline, 0, 8, [box(x - 1.5, 86.5, x + 1.5, 88.5) for x in (-6.0, 6.0)])]


PARTS: dict[str, Callable[[], list]] = {
    **{f"frame-{name}": partial(frame, size) for name, size in SIZES.items()},
    **{f"guard-{name}": partial(guard, size) for name, size in SIZES.items()},
    "bridge-tray": bridge_tray,
    "cube-carrier-170": partial(cube_carrier, 170.0),
    "cube-carrier-250": partial(cube_carrier, 250.0),
    "leg-90": leg,
}


def part(name: str) -> list:
    return PARTS[name]()


# --- triangles of a polygon with holes ---

def cross(o, a, b):
    return (a[..., 0] - o[..., 0]) * (b[..., 1] - o[..., 1]) - (a[..., 1] - o[..., 1]) * (b[..., 0] - o[..., 0])


def sees(p, q, starts, ends) -> bool:
    """Whether no edge lies between p and q; edges that begin or end in them are ignored."""
    same = [np.abs(a - b).sum(1) < EPS for a in (starts, ends) for b in (p, q)]
    other = ~(same[0] | same[1] | same[2] | same[3])
    a, b = starts[other], ends[other]
    crossed = (cross(p, q, a) * cross(p, q, b) <= EPS) & (cross(a, b, p) * cross(a, b, q) <= EPS)
    on_line = np.abs(cross(p, q, starts)) < EPS
    inside = ((starts - p) @ (q - p) > EPS) & ((starts - q) @ (p - q) > EPS)
    return not crossed.any() and not (on_line & inside).any()


def triangles(outline, holes) -> np.ndarray:
    """Returns triangles, shape (n, 3, 2): joins holes to the outline by bridges, then clips ears."""
    loops = sorted((h[::-1] for h in holes), key=lambda h: -h[:, 0].max())
    ring = list(outline)
    for i, hole in enumerate(loops):
        at = int(hole[:, 0].argmax())
        closed = [np.array(ring), *loops[i:]]
        starts, ends = np.concatenate(closed), np.concatenate([np.roll(c, -1, 0) for c in closed])
        nearest = np.argsort(np.linalg.norm(np.array(ring) - hole[at], axis=1))
        # A bridge doubles its corners; choose the copy with the hole on its inner side.
        to = next(j for j in nearest if sees(hole[at], ring[j], starts, ends)
                  and within(ring[j - 1], ring[j], ring[(j + 1) % len(ring)], hole[at]))
        turned = np.roll(hole, -at, 0)
        ring[to + 1:to + 1] = [*turned, turned[0], ring[to]]
    points, left, found = np.array(ring), list(range(len(ring))), []
    while len(left) > 3:
        ear = next(k for k in range(len(left)) if is_ear(points, left, k))
        found.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return points[np.array([*found, left])]


def within(before, at, after, p) -> bool:
    """Whether p lies within the corner's angle, on the inner side of the polygon."""
    left_of = cross(before, at, p) > EPS, cross(at, after, p) > EPS
    return all(left_of) if cross(before, at, after) > 0 else any(left_of)


def is_ear(points, left, k) -> bool:
    a, b, c = points[left[k - 1]], points[left[k]], points[left[(k + 1) % len(left)]]
    if cross(a, b, c) <= EPS:
        return False
    rest = points[left]
    apart = [np.abs(rest - p).sum(1) > EPS for p in (a, b, c)]
    rest = rest[apart[0] & apart[1] & apart[2]]
    inside = (cross(a, b, rest) > -EPS) & (cross(b, c, rest) > -EPS) & (cross(c, a, rest) > -EPS)
    return not inside.any()


# --- surface ---

def surface(pieces) -> np.ndarray:
    """Returns the surface of a part: triangles, shape (n, 3, 3), counter-clockwise seen from outside."""
    plan, spans = [], []
    for p in pieces:
        holes = [h.corners() if isinstance(h, Circle) else h for h in p.holes]
        cut = triangles(p.outline, holes)
        plan.append(cut)
        spans += [(p.bottom, p.top)] * len(cut)
    corners = np.round(np.concatenate(plan), 6)
    levels = sorted({z for span in spans for z in span})
    filled = np.array([[low <= z < high for z in levels[:-1]] for low, high in spans])
    sides = {}
    for t, tri in enumerate(corners):
        for k in range(3):
            side = (*tri[k], *tri[(k + 1) % 3])
            sides[side] = t
    out = []

    def at(p, z):
        return (p[0], p[1], z)

    for (x0, y0, x1, y1), t in sides.items():
        neighbour = sides.get((x1, y1, x0, y0))
        for i, (low, high) in enumerate(pairwise(levels)):
            if filled[t, i] and (neighbour is None or not filled[neighbour, i]):
                a, b = (x0, y0), (x1, y1)
                out += [(at(a, low), at(b, low), at(b, high)), (at(a, low), at(b, high), at(a, high))]
    for t, (a, b, c) in enumerate(corners):
        for i, z in enumerate(levels):
            below, above = i > 0 and filled[t, i - 1], i < len(levels) - 1 and filled[t, i]
            if below and not above:
                out.append((at(a, z), at(b, z), at(c, z)))
            if above and not below:
                out.append((at(c, z), at(b, z), at(a, z)))
    return np.array(out)


# --- files ---

def write_stl(path: Path, faces: np.ndarray) -> None:
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    with path.open("wb") as f:
        f.write(b"vizflyt, millimetres".ljust(80) + struct.pack("<I", len(faces)))
        for normal, face in zip(normals, faces):
            f.write(struct.pack("<12fH", *normal, *face.ravel(), 0))


def write_dxf(path: Path, piece: Piece) -> None:
    """Writes outline and holes of a plate for milling: DXF R12, closed polylines and circles, millimetres."""
    lines = ["0", "SECTION", "2", "ENTITIES"]
    for shape in [piece.outline, *piece.holes]:
        if isinstance(shape, Circle):
            lines += ["0", "CIRCLE", "8", "holes", "10", f"{shape.x:.4f}", "20", f"{shape.y:.4f}", "40",
                      f"{shape.diameter / 2:.4f}"]
            continue
        lines += ["0", "POLYLINE", "8", "outline", "66", "1", "70", "1"]
        for x, y in shape:
            lines += ["0", "VERTEX", "8", "outline", "10", f"{x:.4f}", "20", f"{y:.4f}"]
        lines += ["0", "SEQEND"]
    path.write_text("\n".join([*lines, "0", "ENDSEC", "0", "EOF", ""]))


def write(name: str, folder: Path) -> list[Path]:
    pieces = part(name)
    paths = [folder / f"{name}.stl"]
    write_stl(paths[0], surface(pieces))
    if name.startswith("frame"):
        paths.append(folder / f"{name}.dxf")
        write_dxf(paths[1], pieces[0])
    return paths


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    folder, wanted = Path(sys.argv[1]), sys.argv[2:] or [""]
    names = [n for n in PARTS if any(n.startswith(w) for w in wanted)]
    if not names:
        sys.exit(f"no part begins with {' or '.join(wanted)}; parts are {', '.join(PARTS)}")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        for path in write(name, folder):
            print(path)


if __name__ == "__main__":
    main()
