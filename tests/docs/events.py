#!/usr/bin/env python3
"""Checks that docs/reference/events.md lists every event, reason, phase and outcome of the protocol with its fields and
units, and no others.

tests/docs/events.py    prints each difference; exit status 0 if there is none
"""

import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/reference/events.md"
CORE = ROOT / "protocol/core/src"
EVENTS = CORE / "messages/event.rs"
REASONS = CORE / "flight_end/reason.rs"
# Heading of the page, file, enumeration.
SECTIONS = [
    ("Kinds", EVENTS, "EventKind"),
    ("Phases", CORE / "messages/telemetry.rs", "FlightPhase"),
    ("Reasons", REASONS, "EndReason"),
    ("Faults of the plugin", REASONS, "PluginFault"),
    ("Invalid setpoints", CORE / "messages/setpoint.rs", "InvalidSetpoint"),
    ("Conditions for take-off", REASONS, "Missing"),
    ("Obstacles", REASONS, "Obstacle"),
    ("Boundaries", REASONS, "Boundary"),
    ("Outcomes", CORE / "messages/telemetry.rs", "OutcomeKind"),
]
# These payloads are structures, whose fields a row lists.
STRUCTURES = ("Collision", "FenceBreach")
FIELD = re.compile(r"((?:^ *///[^\n]*\n)*)^ *(?:pub )?([a-z]\w*): ", re.M)
VARIANT = re.compile(r"^    ([A-Z]\w*)(?:\((\w+)[^)]*\)| \{\n(.*?)^    \})?,$", re.M | re.S)
UNIT = re.compile(r"\[[^\]`]+\](?=\s*$)")


def snake(name: str) -> str:
    """Returns a variant's name in JSON."""
    return re.sub(r"(?<!^)([A-Z])", r"_\1", name).lower()


def body(text: str, start: str) -> str:
    """Returns the block that begins with the line `start` and ends at the next line with its indentation."""
    indent = start[: len(start) - len(start.lstrip())]
    found = re.search(rf"^{re.escape(start)}[^\n]*\{{\n(.*?)^{indent}\}}", text, re.M | re.S)
    if not found:
        sys.exit(f"tests/docs/events.py: no '{start.strip()}' in the sources; correct this test")
    return found[1]


def fields(text: str) -> list[tuple[str, str]]:
    """Returns names and units of the fields of a structure or variant."""
    found = []
    for comment, name in FIELD.findall(text):
        unit = UNIT.search(" ".join(line.strip(" /") for line in comment.splitlines()))
        found.append((name, unit[0] if unit else ""))
    return found


def variants(file: pathlib.Path, name: str) -> dict[str, list[tuple[str, str]]]:
    """Returns the fields of each variant of an enumeration."""
    text = file.read_text()
    found = {}
    for variant, payload, inner in VARIANT.findall(body(text, f"pub enum {name}")):
        if payload in STRUCTURES:
            inner = body(REASONS.read_text(), f"pub struct {payload}")
        found[snake(variant)] = fields(inner)
    return found


def rows(page: str, heading: str) -> dict[str, str]:
    """Returns the rows of a section's table by the name in the first cell."""
    section = page.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return {row[1]: row[0] for row in re.finditer(r"^\| `(\w+)` \|.*$", section, re.M)}


def faults(page: str) -> list[str]:
    """Returns a line for each difference between page and types."""
    found = []
    for heading, file, enum in SECTIONS:
        written, known = rows(page, heading), variants(file, enum)
        found += [f"'{heading}' lacks {enum} `{name}`" for name in known if name not in written]
        found += [f"'{heading}' lists `{name}`, which {enum} lacks" for name in written if name not in known]
        for name in known.keys() & written.keys():
            row = written[name]
            if "as the kind" in row:
                continue
            for field, unit in known[name]:
                if f"`{field}`" not in row:
                    found.append(f"'{heading}', `{name}`: no field `{field}`")
                elif unit and unit not in row:
                    found.append(f"'{heading}', `{name}`: no unit {unit} of `{field}`")
    ends = {snake(name) for name in re.findall(r"Self::(\w+)", body(EVENTS.read_text(), "    pub fn end_reason"))}
    for name, row in rows(page, "Kinds").items():
        if (row.split("|")[5].strip() == "yes") != (name in ends):
            found.append(f"'Kinds', `{name}`: wrong in column 'ends the flight'")
    return sorted(found)


def main() -> int:
    lines = faults(PAGE.read_text())
    print("\n".join(lines) or "docs/reference/events.md lists every event")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
