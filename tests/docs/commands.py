#!/usr/bin/env python3
"""Checks that the commands in the documents exist: the program's help lists each subcommand and each option of
`vizflyt` that a code block or a code span has.

tests/docs/commands.py VIZFLYT    prints the wrong ones; exit status 0 if there is none
"""

import pathlib
import re
import shlex
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^(```|~~~)[^\n]*\n(.*?)^\1", re.M | re.S)
SPAN = re.compile(r"`(vizflyt [^`\n]+)`")
# A command line, after a prompt or `sudo`, with the program's name or cargo.
LINE = re.compile(r"^\s*(?:\$ )?(?:sudo )?(?:vizflyt|\S*/vizflyt|cargo run(?: --release)? --) (.*)$")
# Templates contain placeholders; decisions and the changelog may name removed commands.
LEFT_OUT = ("jetson/cli/templates/", "docs/decisions/", "docs/CHANGELOG.md")
# Commands of builds with more features than the ordinary one.
OTHER_BUILDS = ("ros2", "crazyflie")
# Hidden commands that the program starts itself.
HIDDEN = ("guardian", "plugin")
# This command also accepts options of `vizflyt grade`.
GRADES = "grade-class"


class Program:
    def __init__(self, path: str):
        self.path = path
        self.known: dict[tuple[str, ...], str] = {}

    def help(self, *names: str) -> str:
        if names not in self.known:
            call = [self.path, *names, "--help"]
            self.known[names] = subprocess.run(call, check=True, capture_output=True, text=True).stdout
        return self.known[names]

    def subcommands(self, *names: str) -> set[str]:
        # Listed before the options, under one heading or several.
        listed = self.help(*names).partition("Usage:")[2].partition("\nOptions:")[0]
        return set(re.findall(r"^  ([a-z][\w-]*)(?=  |$)", listed, re.M))

    def options(self, *names: str) -> set[str]:
        text = self.help(*names)
        found = set(re.findall(r"(?<![\w-])(--[a-z][\w-]*|-[a-zA-Z])\b", text)) | {"--help", "-h", "--version", "-V"}
        return found | (self.options("grade") if names == (GRADES,) else set())


def lines(text: str) -> list[str]:
    """Returns the arguments of `vizflyt` in each command of a document."""
    found = [match[1].removeprefix("vizflyt ") for match in SPAN.finditer(BLOCK.sub("", text))]
    for block in BLOCK.finditer(text):
        for line in block[2].replace("\\\n", " ").splitlines():
            for part in re.split(r" && | \|\| |; | \| ", line):
                if match := LINE.match(part):
                    found.append(match[1])
    return found


def fault(program: Program, line: str) -> str | None:
    """Returns the fault of a command line, if any."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        # An apostrophe in a comment, or a truncated line.
        words = line.split("#")[0].split()
    names: tuple[str, ...] = ()
    while words and words[0] in program.subcommands(*names):
        names += (words.pop(0),)
    if not names:
        if words and re.fullmatch(r"[a-z][\w-]*", words[0]) and words[0] not in OTHER_BUILDS + HIDDEN:
            return f"no command {words[0]!r}"
        return None
    if program.subcommands(*names) and words and re.fullmatch(r"[a-z][a-z-]*", words[0]):
        # The usage shows whether a command also accepts an argument.
        if not re.search(r"^Usage: .*[\[<](?!OPTIONS|COMMAND)[A-Z]", program.help(*names), re.M):
            return f"no command {' '.join((*names, words[0]))!r}"
    for word in words:
        if word in ("--", ">", "|", "#"):
            break
        option = word.split("=")[0]
        if re.fullmatch(r"--[a-z][\w-]*|-[a-zA-Z]", option) and option not in program.options(*names):
            return f"{' '.join(names)} has no option {option}"
    return None


def main() -> int:
    program = Program(sys.argv[1])
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    documents = [name for name in listed.splitlines() if not name.startswith(LEFT_OUT) and (ROOT / name).exists()]
    faults, count = [], 0
    for name in documents:
        for line in lines((ROOT / name).read_text()):
            count += 1
            if why := fault(program, line):
                faults.append(f"{name}: {why}: vizflyt {line}")
    print("\n".join(faults) or f"{count} commands in {len(documents)} documents: all exist")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
