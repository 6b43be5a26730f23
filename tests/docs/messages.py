#!/usr/bin/env python3
"""Checks that the messages quoted in docs/troubleshooting.md and docs/reference/errors.md are those of the sources.

tests/docs/messages.py    prints each message with the part that the sources lack; exit status 0 if there is none

A message is compared in parts between its values and punctuation. Values are numbers, words in capitals, and `...`.
"""

import pathlib
import re
import subprocess
import sys
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGES = ("docs/troubleshooting.md", "docs/reference/errors.md")
SOURCES = ("*.rs", "*.py", "*.js", "*.c", "*.h", "hardware/packages")
# Rows of a table of messages.
TABLE = re.compile(r"^\| message[^|\n]*\|.*\n\|[-| ]+\|\n((?:\|.*\n?)+)", re.M)
SPAN = re.compile(r"`([^`]+)`")
# A value, as one word; `\0` in the sources.
VALUE = re.compile(r"^\w+Error: |\.\.\.|\b[A-Z]{2,}[A-Za-z]*\b|\bN(?:xN)?\b|(?<![\w-])\d[\d.,]*\b")
INSERTED = re.compile(r"\{[^{}]*\}|\$\{.*?\}|%[sd]")
RUST = re.compile(r'"((?:[^"\\]|\\.)*)"', re.S)
SCRIPT = re.compile(r'"((?:[^"\\\n]|\\.)*)"|`((?:[^`\\]|\\.)*)`|\'((?:[^\'\\\n]|\\.)*)\'', re.S)


def words(text: str) -> list[str]:
    """Returns the words of a text without punctuation."""
    return re.findall(r"[\w'/.-]*\w|\0", text.lower())


def corpus() -> str:
    """Returns the words of the string literals in the sources, each literal in a line."""
    call = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *SOURCES]
    names = subprocess.run(call, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    lines = set()
    for name in names:
        if "tests/" in name or name.endswith("tests.rs") or not (ROOT / name).is_file():
            continue
        text = (ROOT / name).read_text(errors="replace")
        text = re.sub(r"^#\[cfg\(test\)\]\nmod tests \{.*", "", text, flags=re.M | re.S)
        for match in (RUST if name.endswith(".rs") else SCRIPT).finditer(text):
            literal = re.sub(r"\\\n\s*", "", next(group for group in match.groups() if group is not None))
            literal = INSERTED.sub(" \0 ", literal.replace('\\"', '"').replace("\\n", " "))
            lines.add(" ".join(words(VALUE.sub(" \0 ", literal))))
    return "".join(f"\n {line} \n" for line in lines)


def parts(message: str) -> Iterator[list[str]]:
    """Returns the parts of a message between values, punctuation and quotes."""
    for part in re.split(r"\0|[:;()\"]|,? '|'(?= |$)", VALUE.sub("\0", message)):
        if found := words(part):
            yield found


def is_known(part: list[str], known: str) -> bool:
    """Whether the sources have a part, or have it with a value in place of a few words or of another literal."""
    if f" {' '.join(part)} " in known:
        return True
    for at in range(len(part)):
        for end in range(at + 1, len(part) + 1):
            is_value = end - at <= len(part) // 2 or f"\n {' '.join(part[at:end])} \n" in known
            if is_value and f" {' '.join([*part[:at], chr(0), *part[end:]])} " in known:
                return True
    return False


def lacking(message: str, known: str) -> str:
    """Returns the part of a message that the sources lack; empty if there is none."""
    return next((" ".join(part) for part in parts(message) if not is_known(part, known)), "")


def main() -> int:
    known, count, lines = corpus(), 0, []
    for page in PAGES:
        text = (ROOT / page).read_text() if (ROOT / page).exists() else ""
        for table in TABLE.finditer(text):
            for row in table[1].splitlines():
                # Symptoms without a message are in italics.
                for message in SPAN.findall(re.sub(r"\*[^*]+\*", "", row.split(" | ")[0])):
                    count += 1
                    if part := lacking(message, known):
                        lines.append(f"{page}: no '{part}' of `{message}`")
    print("\n".join(lines) or f"{count} messages: all are in the sources")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
