"""Finds and replaces the measured tables of docs/BENCHMARKS.md, and reads the Markdown tables printed by programs.

A measured table stands between `<!-- bench:NAME -->` and `<!-- /bench -->`, each on its own line. Pure functions: text
in, text out.
"""

import re

START = re.compile(r"<!-- bench:([a-z][a-z0-9-]*) -->")
END = "<!-- /bench -->"
# A damaged marker: text that is similar to a marker.
LIKE_A_MARKER = re.compile(r"<!--.*\bbench\b.*-->|<!--\s*/?\s*bench\b")


class DocumentError(Exception):
    """The document's markers are missing or damaged; the message gives the place and the remedy."""


def blocks(text: str) -> dict[str, tuple[int, int]]:
    """Returns the lines of each marked table: the first after the start, and the line of the end; counted from 0."""
    found: dict[str, tuple[int, int]] = {}
    name, begun = "", 0
    for number, line in enumerate(text.split("\n")):
        start = START.fullmatch(line)
        if start and name:
            raise DocumentError(f"line {number + 1}: bench:{start[1]} begins before bench:{name} has ended; "
                                f"put '{END}' on a line of its own behind that table")
        if start and start[1] in found:
            raise DocumentError(f"line {number + 1}: bench:{start[1]} is there a second time; leave one")
        if start:
            name, begun = start[1], number + 1
        elif line == END and not name:
            raise DocumentError(f"line {number + 1}: '{END}' without a start; "
                                "put '<!-- bench:NAME -->' before the table")
        elif line == END:
            found[name], name = (begun, number), ""
        elif LIKE_A_MARKER.search(line):
            raise DocumentError(f"line {number + 1}: '{line}' is no marker; "
                                f"they are '<!-- bench:NAME -->' and '{END}', alone on their lines")
    if name:
        raise DocumentError(f"bench:{name} has no end; put '{END}' on a line of its own behind that table")
    return found


def block(text: str, name: str) -> str:
    """Returns the text between the markers of `name`, without the empty lines around it."""
    begin, end = place(text, name)
    return "\n".join(text.split("\n")[begin:end]).strip("\n")


def place(text: str, name: str) -> tuple[int, int]:
    found = blocks(text)
    if name not in found:
        raise DocumentError(f"no table bench:{name}; put '<!-- bench:{name} -->' and '{END}' where it shall stand")
    return found[name]


def replaced(text: str, tables: dict[str, str]) -> str:
    """Returns the document with its tables replaced; raises if a table is missing, without any replacement."""
    for name, table in tables.items():
        begin, end = place(text, name)
        lines = text.split("\n")
        text = "\n".join([*lines[:begin], "", *table.split("\n"), "", *lines[end:]])
    blocks(text)
    return text


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """Returns a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" if cells is not lines[1] else "|" + "|".join(cells) + "|"
                     for cells in lines)


def printed_tables(text: str) -> list[list[list[str]]]:
    """Returns the Markdown tables in a program's output: for each its rows as cells, the head first."""
    tables: list[list[list[str]]] = []
    inside = False
    for line in text.split("\n"):
        line = line.strip()
        if not (line.startswith("|") and line.endswith("|") and len(line) > 1):
            inside = False
            continue
        cells = [cell.strip() for cell in line[1:-1].split("|")]
        if not inside:
            tables.append([])
            inside = True
        if not all(re.fullmatch(r":?-+:?", cell) for cell in cells):
            tables[-1].append(cells)
    return tables
