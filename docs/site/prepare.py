#!/usr/bin/env python3
"""Prepares the sources of the documentation site: the documents, with links to other files led to the repository, and
the generated pages: the help of every command, and the reference of the Python package.

docs/site/prepare.py VIZFLYT FOLDER
"""

import os
import pathlib
import posixpath
import re
import shutil
import subprocess
import sys

SITE = pathlib.Path(__file__).resolve().parent
ROOT = SITE.parents[1]
REPOSITORY = "https://github.com/vizflyt/vizflyt"
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
# A link labelled with a file's name: [safety.md](safety.md)
LABEL = re.compile(r"\[([\w./-]+)\.md\]\(([^)\s#]+)")
# Pages of the navigation, and their titles
TITLE = re.compile(r"^ +- (.+): (\S+\.md)$", re.M)
# Folders of the course that are not published: answers, and what `vizflyt new` writes
PRIVATE = re.compile(r"^docs/course/\w+/(solution|starter)/")
# The site's language of a code block has no attributes of rustdoc: ```rust,no_run
ATTRIBUTES = re.compile(r"^(```\w+),[\w,]+$", re.M)
CODE = re.compile(r"(^(?:```|~~~).*?^(?:```|~~~)[^\n]*$|`[^`\n]*`)", re.M | re.S)
ITEM = re.compile(r"(?:-|\d+\.) +")
PYTHON = """# Python API

The package `vizflyt`: `pip install` the wheel, or `pip install ./jetson/python` from the sources.

::: vizflyt

::: vizflyt.gym
"""


def is_published(path: str) -> bool:
    """Returns whether a file of the repository is part of the site."""
    within = path.startswith("docs/") and not path.startswith("docs/site/") and not PRIVATE.match(path)
    return within and (ROOT / path).is_file()


def led(name: str, text: str, titles: dict[str, str]) -> str:
    """Returns a document with its links to files outside the site led to the repository, and pages called by title."""
    folder = posixpath.dirname(name)

    def call(match: re.Match[str]) -> str:
        title = titles.get(posixpath.normpath(posixpath.join(folder, match[2])), match[1])
        return f"[{title}]({match[2]}"

    def lead(match: re.Match[str]) -> str:
        begin, target, anchor, end = match.groups()
        path = posixpath.normpath(posixpath.join(folder, target))
        if re.match(r"[a-z]+:", target) or is_published(path):
            return match[0]
        kind = "tree" if (ROOT / path).is_dir() else "blob"
        return f"{begin}{REPOSITORY}/{kind}/main/{path}{anchor or ''}{end}"

    # Odd parts are code.
    parts = CODE.split(text)
    return "".join(part if index % 2 else LINK.sub(lead, LABEL.sub(call, part)) for index, part in enumerate(parts))


def indented(text: str) -> str:
    """Returns a document with the content of list items indented by four columns: the site's Markdown needs them."""
    lines, width, is_code = [], 0, False
    for line in text.split("\n"):
        if width and (not line or line.startswith(" " * width)):
            lines.append(line and " " * 4 + line[width:])
            continue
        is_code ^= line.startswith(("```", "~~~"))
        item = None if is_code else ITEM.match(line)
        width = len(item[0]) if item else 0
        lines.append(line)
    return "\n".join(lines)


def subcommands(text: str) -> list[str]:
    """Returns the subcommands in a help text. They are listed before the options, under one heading or several."""
    listed = text.partition("Usage:")[2].partition("\nOptions:")[0]
    return [name for name in re.findall(r"^  ([a-z][\w-]*)(?=  |$)", listed, re.M) if name != "help"]


def commands(program: str) -> str:
    """Returns a page with the help of every command."""
    parts = ["# Commands\n\nThe help of each command, as `vizflyt COMMAND --help` prints it.\n"]

    environment = {**os.environ, "COLUMNS": "84"}

    def add(*names: str) -> None:
        call = [program, *names, "--help"]
        text = subprocess.run(call, check=True, capture_output=True, text=True, env=environment).stdout
        level = "#" * min(max(len(names), 1) + 1, 4)
        parts.append(f"{level} {' '.join(('vizflyt', *names))}\n\n```text\n{text.rstrip()}\n```\n")
        for name in subcommands(text):
            add(*names, name)

    add()
    return "\n".join(parts)


def main() -> None:
    program, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    shutil.rmtree(folder, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "docs"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.splitlines()
    config = (SITE / "mkdocs.yml").read_text()
    titles = {f"docs/{path}": title for title, path in TITLE.findall(config)}
    for name in filter(is_published, listed):
        source, target = ROOT / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".md"):
            # Decisions are too many for the navigation.
            index = "\n[All decisions](README.md)\n" if name.startswith("docs/decisions/0") else ""
            text = indented(ATTRIBUTES.sub(r"\1", source.read_text())) + index
            target.write_text(led(name, text, titles))
        else:
            shutil.copy(source, target)
    reference = folder / "docs/reference"
    reference.mkdir(exist_ok=True)
    (reference / "cli.md").write_text(commands(program))
    (reference / "python.md").write_text(PYTHON)
    shutil.copytree(SITE / "theme", folder / "theme")
    shutil.copy(SITE / "theme/site.css", folder / "docs")
    (folder / "mkdocs.yml").write_text(config.replace("PYTHON_PACKAGE", str(ROOT / "jetson/python/python")))


if __name__ == "__main__":
    main()
