"""Draws curves as one SVG of small panels, both axes logarithmic. Pure functions: figures in, text out."""

import math
from typing import NamedTuple


class Curve(NamedTuple):
    """A curve: its name, and its points (x, y), both positive."""

    name: str
    points: list[tuple[float, float]]


class Panel(NamedTuple):
    """A panel: the quantity, its variable, and its curves."""

    title: str
    over: str
    curves: list[Curve]


# Readable on white and on black.
COLOURS = ["#d1495b", "#2a9d8f", "#e09f3e", "#3d7ea6"]
GREY = "#808080"
WIDTH, HEIGHT, COLUMNS = 320, 300, 3
LEFT, RIGHT, TOP, BOTTOM = 50, 12, 42, 44
LEGEND = 15


def decades(values: list[float]) -> tuple[int, int]:
    """Returns the exponents of the powers of ten that enclose all values."""
    low, high = math.floor(math.log10(min(values)) + 1e-9), math.ceil(math.log10(max(values)) - 1e-9)
    return low, max(high, low + 1)


def short(power: int) -> str:
    return {-3: "0.001", -2: "0.01", -1: "0.1", 0: "1", 1: "10", 2: "100", 3: "1 k", 4: "10 k", 5: "100 k", 6: "1 M",
            7: "10 M", 8: "100 M"}.get(power, f"1e{power}")


def panel(drawn: Panel, left: float, top: float) -> list[str]:
    """Returns the elements of a panel with its corner at (left, top)."""
    points = [point for curve in drawn.curves for point in curve.points]
    (x_low, x_high), (y_low, y_high) = (decades([point[axis] for point in points]) for axis in (0, 1))
    wide, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM - LEGEND * len(drawn.curves)
    x0, y0 = left + LEFT, top + TOP + high
    x = lambda value: x0 + (math.log10(value) - x_low) / (x_high - x_low) * wide
    y = lambda value: y0 - (math.log10(value) - y_low) / (y_high - y_low) * high
    out = [f'<text x="{left + 8:.0f}" y="{top + 20:.0f}" font-size="13">{drawn.title}</text>']
    for power in range(x_low, x_high + 1):
        out.append(f'<path d="M{x(10.0**power):.1f} {y0:.1f}V{top + TOP:.1f}" stroke="{GREY}" stroke-opacity="0.3"/>'
                   f'<text x="{x(10.0**power):.1f}" y="{y0 + 14:.1f}" text-anchor="middle">{short(power)}</text>')
    for power in range(y_low, y_high + 1):
        out.append(f'<path d="M{x0:.1f} {y(10.0**power):.1f}H{x0 + wide:.1f}" stroke="{GREY}" stroke-opacity="0.3"/>'
                   f'<text x="{x0 - 5:.1f}" y="{y(10.0**power) + 4:.1f}" text-anchor="end">{short(power)}</text>')
    out.append(f'<text x="{x0 + wide / 2:.1f}" y="{y0 + 29:.1f}" text-anchor="middle">{drawn.over}</text>')
    for index, curve in enumerate(drawn.curves):
        colour, at = COLOURS[index], y0 + 44 + LEGEND * index
        places = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in curve.points)
        out.append(f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{x(a):.1f}" cy="{y(b):.1f}" r="2.5" fill="{colour}"/>' for a, b in curve.points]
        out.append(f'<path d="M{x0:.1f} {at:.1f}h20" stroke="{colour}" stroke-width="2"/>'
                   f'<text x="{x0 + 27:.1f}" y="{at + 4:.1f}">{curve.name}</text>')
    return out


def svg(panels: list[Panel]) -> str:
    """Returns the drawing of all panels."""
    lines = -(-len(panels) // COLUMNS)
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH * COLUMNS} {HEIGHT * lines}" '
           f'font-family="sans-serif" font-size="11" fill="{GREY}">']
    for index, drawn in enumerate(panels):
        out += panel(drawn, WIDTH * (index % COLUMNS), HEIGHT * (index // COLUMNS))
    return "\n".join([*out, "</svg>", ""])
