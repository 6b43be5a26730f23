#!/usr/bin/env python3
"""Checks that every relative link in the documents leads to a file, and every anchor to a heading.

tests/docs/links.py    prints the broken ones; exit status 0 if there is none
"""

import pathlib
import re
import subprocess
import sys
import urllib.parse

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Text and target of a link or image, outside of code spans and code blocks.
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
CODE = re.compile(r"^(```|~~~).*?^\1[^\n]*$|`[^`\n]*`", re.MULTILINE | re.DOTALL)
# Templates contain placeholders.
LEFT_OUT = "jetson/cli/templates/"


def anchors(text: str) -> set[str]:
    """Returns the anchors that GitHub creates for a document's headings."""
    found: dict[str, int] = {}
    names = set(re.findall(r"<a (?:id|name)=\"([^\"]+)\"", text))
    for heading in re.findall(r"^#{1,6} +(.*?) *#*$", re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.M | re.S), re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        name = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        count = found.get(name, 0)
        found[name] = count + 1
        names.add(f"{name}-{count}" if count else name)
    return names


def broken(document: pathlib.Path) -> list[str]:
    """Returns a line for each link of a document that leads nowhere."""
    lines = []
    for target in LINK.findall(CODE.sub("", document.read_text())):
        path, _, anchor = urllib.parse.unquote(target).partition("#")
        if re.match(r"[a-z]+:", path):
            continue
        file = document.parent / path if path else document
        if not file.exists():
            lines.append(f"{document.relative_to(ROOT)}: no file {target}")
        elif anchor and file.suffix == ".md" and anchor not in anchors(file.read_text()):
            lines.append(f"{document.relative_to(ROOT)}: no heading {target}")
    return lines


def main() -> int:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.splitlines()
    documents = [name for name in listed if not name.startswith(LEFT_OUT) and (ROOT / name).exists()]
    lines = [line for name in documents for line in broken(ROOT / name)]
    print("\n".join(lines) or f"{len(documents)} documents: every link leads somewhere")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
