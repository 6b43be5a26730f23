"""Keeps the type stub for editors in step with the compiled module.

    stub.py --check    fails if a name or a docstring differs between the two
    stub.py --write    copies the docstrings of the compiled module into the stub

Signatures are written by hand in the stub; the documentation is written in the Rust source.
"""

import ast
import inspect
import sys
from pathlib import Path

from vizflyt import _vizflyt

STUB = Path(__file__).parents[2] / "jetson/python/python/vizflyt/_vizflyt.pyi"


def main():
    write = sys.argv[1:] == ["--write"]
    text = STUB.read_text()
    faults, stale = compare(ast.parse(text))
    if write:
        lines = text.splitlines()
        # From the end to the start, so that line numbers stay valid.
        for node, doc in sorted(stale, key=lambda pair: -pair[0].lineno):
            put(lines, node, doc)
        STUB.write_text("\n".join(lines) + "\n")
    else:
        faults += [f"line {node.lineno}: {node.name} is documented otherwise" for node, _ in stale]
    if faults:
        sys.exit("\n".join([*faults, f"{STUB.name}: stub.py --write copies docstrings"]))


def compare(tree):
    """Returns the faults to correct by hand, and the nodes with outdated docstrings and their new text."""
    faults, stale = [], []
    stubs = {
        node.name: node for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))
    }
    compiled = {
        name: value
        for name, value in vars(_vizflyt).items()
        if not name.startswith("__") and name != "PROTOCOL_VERSION"
    }
    pairs = match("the module", stubs, compiled, faults)
    for node, value in list(pairs):
        if isinstance(node, ast.ClassDef):
            inner = {stub.name: stub for stub in node.body if isinstance(stub, ast.FunctionDef)}
            public = {name: stub for name, stub in inner.items() if not name.startswith("_")}
            real = {name: getattr(value, name) for name in vars(value) if not name.startswith("_")}
            pairs += match(node.name, public, real, faults)
    for node, value in pairs:
        doc = inspect.getdoc(value)
        if not doc:
            faults.append(f"{node.name} has no documentation in Rust")
        elif ast.get_docstring(node) != doc:
            stale.append((node, doc))
    return faults, stale


def match(where, stubs, compiled, faults):
    for name in sorted(stubs.keys() ^ compiled.keys()):
        has = "the stub" if name in stubs else "the compiled module"
        faults.append(f"{where}: {name} is in {has} only")
    return [(stubs[name], compiled[name]) for name in stubs if name in compiled]


def put(lines, node, doc):
    """Replaces or adds the docstring of a class or function in the text."""
    indent = " " * (node.col_offset + 4)
    first, *rest = doc.split("\n")
    quoted = [f'{indent}"""{first}', *(indent + line if line else "" for line in rest)]
    quoted += [indent + '"""'] if rest else []
    if not rest:
        quoted[-1] += '"""'
    body = node.body[0]
    if ast.get_docstring(node) is not None:
        lines[body.lineno - 1 : body.end_lineno] = quoted
    elif isinstance(node, ast.ClassDef):
        lines[node.lineno : node.lineno] = [*quoted, ""]
    else:
        # `def f(...) -> T: ...`
        head = lines[body.lineno - 1][: body.col_offset].rstrip()
        lines[body.lineno - 1 : body.end_lineno] = [head] * bool(head) + quoted


if __name__ == "__main__":
    main()
