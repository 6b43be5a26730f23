"""Tests of the runner: counts read from tools' closing lines, and the record of heavy stages."""

from __future__ import annotations

import pathlib
import subprocess
import tempfile
import unittest

import changes
import counts
import table


class Counts(unittest.TestCase):
    def check(self, line: str, passed: int, failed: int, skipped: int = 0) -> None:
        self.assertEqual(counts.of_line(line), counts.Counts(passed, failed, skipped), line)

    def test_reads_the_closing_line_of_each_runner(self) -> None:
        self.check(
            "test result: ok. 12 passed; 0 failed; 3 ignored; 0 measured; 7 filtered out; finished in 0.51s", 12, 0, 3
        )
        self.check("Summary [  31.022s] 40 tests run: 38 passed (2 slow), 1 failed, 1 timed out, 900 skipped", 38, 2)
        self.check("Summary [   0.100s] 1 test run: 1 passed, 1382 skipped", 1, 0)
        self.check("3 failed, 12 passed, 1 skipped, 2 errors in 12.31s", 12, 5, 1)
        self.check("=== 12 passed in 2.00s ===", 12, 0)
        self.check("\u2139 pass 9", 9, 0)
        self.check("# fail 2", 0, 2)
        self.check("clients: 14 passed, 0 failed", 14, 0)

    def test_reads_nothing_from_other_lines(self) -> None:
        for line in [
            "error: 3 failed",
            "12 passed the gate",
            "pass 9",
            "the test result: ok. 1 passed; 0 failed; 0 ignored",
        ]:
            self.check(line, 0, 0)

    def test_a_stage_without_counts_is_one_test(self) -> None:
        self.assertEqual(counts.of("nothing", passed=True), counts.Counts(1, 0, 0))
        self.assertEqual(counts.of("nothing", passed=False), counts.Counts(0, 1, 0))

    def test_a_failed_test_of_nextest_counts_once(self) -> None:
        output = (
            "    test result: FAILED. 0 passed; 1 failed; 0 ignored\n"
            "  Summary [ 3.2s] 3 tests run: 2 passed, 1 failed, 0 skipped"
        )
        self.assertEqual(counts.of(output, passed=False), counts.Counts(2, 1, 0))

    def test_a_stage_that_fails_after_its_tests_counts_as_failed(self) -> None:
        output = "test result: ok. 2 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out"
        self.assertEqual(counts.of(output, passed=False), counts.Counts(2, 1, 0))


class Record(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.root = pathlib.Path(folder.name)
        self.write("Cargo.lock", '[[package]]\nname = "ours"\n\n[[package]]\nname = "other"\nsource = "registry"\n')
        self.write("rust-toolchain.toml", "")
        self.write("tests/x/run", "1")
        self.write("y/a.rs", "1")
        for command in (
            ["init", "-q"],
            ["add", "-A"],
            ["-c", "user.name=x", "-c", "user.email=x@x", "commit", "-qm", "x"],
        ):
            subprocess.run(["git", *command], cwd=self.root, check=True)
        self.stage = table.Stage("x", "x", table.HEAVY, table.COMPUTE, "true", 1, [], ["tests/x", "y"])

    def write(self, name: str, text: str) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def passed(self) -> str | None:
        return changes.Record(self.root).passed(self.stage)

    def test_a_stage_is_unchanged_until_one_of_its_inputs_changes(self) -> None:
        self.assertIsNone(self.passed())
        record = changes.Record(self.root)
        record.write({"x": record.hash_of(self.stage)})
        self.assertIsNotNone(self.passed())
        self.write("z/b.rs", "another folder")
        self.write("Cargo.lock", '[[package]]\nname = "new"\n\n[[package]]\nname = "other"\nsource = "registry"\n')
        self.assertIsNotNone(self.passed())
        for name, text in [
            ("y/a.rs", "2"),
            ("y/new.rs", ""),
            ("tests/x/run", "2"),
            ("Cargo.lock", '[[package]]\nname = "other"\nsource = "elsewhere"\n'),
        ]:
            path = self.root / name
            before = path.read_text() if path.exists() else None
            self.write(name, text)
            self.assertIsNone(self.passed(), name)
            path.unlink() if before is None else path.write_text(before)
            self.assertIsNotNone(self.passed(), name)


class Table(unittest.TestCase):
    def test_the_inputs_of_heavy_stages_exist(self) -> None:
        root = pathlib.Path(__file__).resolve().parents[2]
        for stage in table.STAGES:
            self.assertEqual(stage.tier == table.HEAVY, bool(stage.inputs), stage.name)
            for path in stage.inputs:
                self.assertTrue((root / path).exists(), f"{stage.name}: {path}")


if __name__ == "__main__":
    unittest.main()
