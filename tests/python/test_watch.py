"""`vizflyt grade --watch`: grades again when the plugin is saved, and reports changes; leaves no partial results."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PLUGIN = """
import vizflyt
from vizflyt import Setpoint


class Waits(vizflyt.Plugin):
    def on_start(self, info):
        self.images = 0

    def on_image(self, obs):
        self.images += 1
        return Setpoint.land() if self.images > {images} else Setpoint.hold()


if __name__ == "__main__":
    vizflyt.run(Waits)
"""


@pytest.fixture
def program(request):
    program = request.config.getoption("--vizflyt")
    if program is None:
        pytest.skip("no --vizflyt given")
    return str(Path(program).absolute())


class Watched:
    """`vizflyt grade --watch` in its own folder."""

    def __init__(self, folder, program, *options):
        self.folder, self.plugin = folder, folder / "plugin.py"
        folder.chmod(0o755)
        self.save(20)
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        self.out = folder / "said"
        with self.out.open("w") as out:
            self.process = subprocess.Popen(
                [program, "grade", "plugin.py", "--project", "p3", "--seeds", "1", "--log", "none", "--watch",
                 "--report", "report", *options],
                cwd=folder, env=os.environ | {"PATH": path, "XDG_CONFIG_HOME": str(folder / "config")},
                stdout=out, stderr=subprocess.STDOUT,
            )

    def save(self, images):
        self.plugin.write_text(PLUGIN.format(images=images))

    def until(self, words, times=1):
        deadline = time.monotonic() + 120
        while self.out.read_text().count(words) < times:
            assert self.process.poll() is None and time.monotonic() < deadline, self.out.read_text()
            time.sleep(0.1)

    def end(self):
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


def test_a_saved_plugin_is_graded_again_and_compared(tmp_path, program):
    watched = Watched(tmp_path, program)
    try:
        watched.until("waiting until")
        first = (tmp_path / "report/grade.json").read_text()
        # Saved again without a change: a new round with the same results.
        watched.save(20)
        watched.until("waiting until", 2)
        assert "nothing changed: 1 flights went as before" in watched.out.read_text()
        watched.save(60)
        watched.until("waiting until", 3)
        said = watched.out.read_text().split("attempt 3")[1]
        assert "score 0.0 -> 0.0, finished 0 -> 0 of 1" in said, said
        assert "points      0.0 of 65" in said, said
        assert (tmp_path / "report/grade.json").read_text() != first
    finally:
        assert watched.end() == 0
    verified = subprocess.run(
        [program, "grade", "verify", "report"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env=os.environ | {"XDG_CONFIG_HOME": str(tmp_path / "config")}, text=True, check=False,
    )
    assert verified.returncode == 0, verified.stdout


def test_a_round_that_is_overtaken_leaves_nothing(tmp_path, program):
    watched = Watched(tmp_path, program)
    try:
        watched.save(100_000)
        while not list(tmp_path.glob(".attempt-*")):
            time.sleep(0.05)
        watched.save(100_001)
        watched.until("saved meanwhile")
        assert not (tmp_path / "report").exists()
    finally:
        assert watched.end() == 0
    assert not list(tmp_path.glob(".attempt-*"))


def test_an_attempt_is_compared_with_the_one_that_is_named(tmp_path, program):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])

    def grade(seeds, *options):
        done = subprocess.run(
            [program, "grade", "plugin.py", "--project", "p3", "--seeds", str(seeds), "--log", "none", *options],
            cwd=tmp_path, env=os.environ | {"PATH": path, "XDG_CONFIG_HOME": str(tmp_path / "config")},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )
        return done.returncode, done.stdout

    tmp_path.chmod(0o755)
    (tmp_path / "plugin.py").write_text(PLUGIN.format(images=5))
    status, said = grade(1, "--report", "first")
    assert status == 0 and "since the last attempt" not in said, said
    (tmp_path / "plugin.py").write_text(PLUGIN.format(images=40))
    status, said = grade(1, "--since", "first")
    assert status == 0 and "since the last attempt" in said and "finished 0 -> 0 of 1" in said, said
    # Grades of another project, and folders without a grade, are not earlier attempts.
    status, said = grade(1, "--since", "first", "--project", "p4")
    assert status == 1 and "the earlier attempt is of project p3" in said, said
    (tmp_path / "empty").mkdir()
    status, said = grade(1, "--since", "empty")
    assert status == 1 and "--since" in said, said


def test_what_it_does_not_go_with_is_refused(tmp_path, program):
    done = subprocess.run(
        [program, "grade", "plugin.py", "--watch", "--json"], cwd=tmp_path, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, check=False,
    )
    assert done.returncode == 2 and "--json" in done.stdout, done.stdout
