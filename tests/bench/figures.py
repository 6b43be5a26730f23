"""Measured figures: the best of several turns, changes against the committed figures, and both as JSON. Pure functions.

Times and rates are compared as ratios to a reference kernel timed in the same turns: a slower machine slows the kernel
too, so the ratio stays constant.
"""

import json
import math
import re
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

# Minimum ratio of a change worth reporting.
MOVED = 1.10
# A time: smaller is faster. A rate: larger is faster. A count does not depend on the machine's speed.
KINDS = ("time", "rate", "count")


class FiguresError(Exception):
    """The file of committed figures is damaged; the message gives the place and the remedy."""


@dataclass(frozen=True)
class Figure:
    """A figure: its value in the unit of its name or column, the number of digits shown, and its kind."""

    value: float
    digits: int
    kind: str

    def __str__(self) -> str:
        return f"{self.value:.{self.digits}f}"


def time(value: float, digits: int = 2) -> Figure:
    return Figure(round(value, digits + 2), digits, "time")


def rate(value: float, digits: int = 1) -> Figure:
    return Figure(round(value, digits + 2), digits, "rate")


def count(value: float, digits: int = 0) -> Figure:
    return Figure(round(value, digits + 2), digits, "count")


# The figures of a table by name, "ROW | COLUMN", in the table's order.
Figures = dict[str, Figure]


@dataclass(frozen=True)
class Reference:
    """Processor time of the two kernels, computing and copying memory: the minimum of a turn. [ms]"""

    computing_ms: float
    memory_ms: float

    def of(self, kernel: str) -> float:
        return {"computing": self.computing_ms, "memory": self.memory_ms}[kernel]


@dataclass(frozen=True)
class Taken:
    """The figures of a table, and the machine they were measured on."""

    figures: Figures
    reference: Reference
    turns: int
    date: str
    processor: str
    load: float


@dataclass(frozen=True)
class Moved:
    """A changed figure; `ratio` is new divided by old, corrected for the machine's own change."""

    name: str
    before: Figure
    after: Figure
    ratio: float


def number(cell: str, kind: str) -> Figure | None:
    """Returns the figure in a printed cell, or None if the cell is not a plain number."""
    if not re.fullmatch(r"-?\d+(\.\d+)?", cell):
        return None
    return Figure(float(cell), len(cell.partition(".")[2]), kind)


def best(turns: list[Figures]) -> Figures:
    """Returns for each figure its value least disturbed by other work: the minimum of times, the maximum of rates, the
    median of counts."""
    names = list(turns[0])
    for turn in turns:
        if list(turn) != names:
            raise FiguresError(f"a turn has other figures than the first: {sorted(set(names) ^ set(turn))}; "
                               "their names must not depend on what was measured")
    chosen: dict[str, Callable[[list[float]], float]] = {"time": min, "rate": max, "count": statistics.median}
    return {name: replace(turns[0][name], value=chosen[turns[0][name].kind]([turn[name].value for turn in turns]))
            for name in names}


def least(references: list[Reference]) -> Reference:
    return Reference(min(one.computing_ms for one in references), min(one.memory_ms for one in references))


def expected(before: Figure, machine: float) -> Figure:
    """Returns the expected figure on a machine whose reference kernel takes `machine` times as long."""
    factor = {"time": machine, "rate": 1.0 / machine, "count": 1.0}[before.kind]
    return replace(before, value=before.value * factor)


def moved(before: Taken, after: Taken, kernel: str) -> list[Moved]:
    """Returns the figures in both sets whose ratio to the kernel changed by more than 10 %, largest change first."""
    machine = after.reference.of(kernel) / before.reference.of(kernel)
    found = []
    for name, figure in after.figures.items():
        if name not in before.figures:
            continue
        by_machine = expected(before.figures[name], machine)
        # A change below the last digit shown is not visible.
        if str(by_machine) == str(figure):
            continue
        changed = figure.value / by_machine.value if by_machine.value else math.inf
        if not 1 / MOVED <= changed <= MOVED:
            found.append(Moved(name, before.figures[name], figure, changed))
    return sorted(found, key=lambda one: -abs(math.log(one.ratio)) if 0 < one.ratio < math.inf else -math.inf)


def rows(figures: Figures) -> tuple[list[str], list[list[str]]]:
    """Returns the column names, and the rows: name and cells; a cell without a figure is empty."""
    split = [name.split(" | ") for name in figures]
    columns = list(dict.fromkeys(column for _, column in split))
    names = list(dict.fromkeys(row for row, _ in split))
    return columns, [[row, *(str(figures.get(f"{row} | {column}", "")) for column in columns)] for row in names]


def to_json(tables: dict[str, Taken]) -> str:
    """Returns the file of committed figures: tables by name, one figure per line."""
    out = []
    for name in sorted(tables):
        taken = asdict(tables[name])
        figures = taken.pop("figures")
        lines = [f"      {json.dumps(key)}: {json.dumps(list(figure.values()))}" for key, figure in figures.items()]
        parts = [f"    {json.dumps(key)}: {json.dumps(value)}" for key, value in taken.items()]
        parts.append('    "figures": {\n' + ",\n".join(lines) + "\n    }")
        out.append(f"  {json.dumps(name)}: {{\n" + ",\n".join(parts) + "\n  }")
    return "{\n" + ",\n".join(out) + "\n}\n"


def from_json(text: str) -> dict[str, Taken]:
    """Reads the output of `to_json`."""
    try:
        return {name: read_table(table) for name, table in json.loads(text).items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise FiguresError(f"the committed figures are damaged ({type(error).__name__}: {error}); "
                           "take the file as it was committed, or measure with --update") from error


def read_table(table: dict) -> Taken:
    figures = {}
    for name, (value, digits, kind) in table["figures"].items():
        if kind not in KINDS or not math.isfinite(value) or digits not in range(10) or name.count(" | ") != 1:
            raise ValueError(f"{name}: {[value, digits, kind]} is no figure")
        figures[name] = Figure(float(value), digits, kind)
    reference = Reference(**table["reference"])
    if not (reference.computing_ms > 0 and reference.memory_ms > 0):
        raise ValueError(f"{reference} is no reference")
    return Taken(figures, reference, int(table["turns"]), str(table["date"]), str(table["processor"]),
                 float(table["load"]))
