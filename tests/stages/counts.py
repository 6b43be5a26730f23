"""Counts of tests, read from the output of the test runners."""

from __future__ import annotations

import dataclasses
import re


@dataclasses.dataclass
class Counts:
    """Tests that passed, failed and were skipped."""

    passed: int = 0
    failed: int = 0
    skipped: int = 0

    def __iadd__(self, other: Counts) -> Counts:
        self.passed += other.passed
        self.failed += other.failed
        self.skipped += other.skipped
        return self

    def __str__(self) -> str:
        return f"{self.passed} passed, {self.failed} failed, {self.skipped} skipped"


def of(output: str, passed: bool) -> Counts:
    """Returns the tests in a stage's output; a stage whose tools print no counts is one test."""
    counts = Counts()
    for line in output.splitlines():
        plain = re.sub(r"\x1b\[[0-9;]*m", "", line)
        # Output of a failed test in nextest, which counts the test in its summary.
        if not re.match(r"\s+test result:", plain):
            counts += of_line(plain.strip())
    if counts.passed + counts.failed == 0:
        counts.passed += passed
    # A tool may fail outside its tests.
    if not passed and counts.failed == 0:
        counts.failed = 1
    return counts


def of_line(line: str) -> Counts:
    """Returns the counts in a runner's closing line: cargo test, nextest, pytest, node, or our own scripts."""
    # test result: ok. 5 passed; 0 failed; 1 ignored; 0 measured; 3 filtered out
    if match := re.match(r"test result: \w+\. (\d+) passed; (\d+) failed; (\d+) ignored", line):
        return Counts(*map(int, match.groups()))
    # Summary [ 3.2s] 12 tests run: 11 passed (1 slow), 1 failed, 40 skipped; those skipped are in another stage.
    if re.match(r"Summary \[.*tests? run:", line):
        return Counts(number(line, "passed"), number(line, "failed") + number(line, "timed out"))
    # 3 failed, 12 passed, 1 skipped in 12.3s
    if re.match(r"(=+ )?\d+ (passed|failed|skipped|error).* in [\d.]+s", line):
        return Counts(number(line, "passed"), number(line, "failed") + number(line, "errors?"), number(line, "skipped"))
    # node: "# pass 12", or an information sign in place of the hash
    if match := re.match(r"(?:#|\u2139) (pass|fail|skipped) (\d+)$", line):
        kind = {"pass": "passed", "fail": "failed", "skipped": "skipped"}[match[1]]
        return Counts(**{kind: int(match[2])})
    # 12 passed, 0 failed, 1 skipped
    if re.match(r"(\w+: )?\d+ passed, \d+ failed(, \d+ skipped)?$", line):
        return Counts(number(line, "passed"), number(line, "failed"), number(line, "skipped"))
    return Counts()


def number(line: str, word: str) -> int:
    match = re.search(rf"(\d+) {word}\b", line)
    return int(match[1]) if match else 0
