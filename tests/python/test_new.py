"""A new student's first minutes: creates a plugin, tests it, flies it, saves it in flight, breaks it, replays it."""

import json
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest


@pytest.fixture
def first(program, tmp_path):
    """Creates the plugin `first` in a new folder, with a virtual environment of this process's packages."""
    done = subprocess.run([program, "new", "first", "--lang", "python"], cwd=tmp_path)
    assert done.returncode == 0
    # As after `pip install -r requirements.txt`.
    venv = tmp_path / "first/.venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    (site,) = venv.glob("lib/python3*/site-packages")
    for package in Path(sysconfig.get_path("purelib")).iterdir():
        if package.name.split("-")[0] in ("vizflyt", "numpy", "numpy.libs"):
            shutil.copytree(package, site / package.name)
    return tmp_path / "first"


class Flight:
    """`vizflyt fly first` in the plugin's folder, with its output."""

    def __init__(self, program, first, *arguments):
        self.desk = first.parent
        self.seen = []
        self.process = subprocess.Popen(
            [
                program, "fly", "first", "--no-config", "--headless", "--seed=4", "--log-dir=flights",
                "--report=report.json", *arguments,
            ],
            cwd=self.desk,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()

    def wait_for(self, text):
        for line in self.process.stdout:
            self.seen.append(line)
            if text in line:
                return
        pytest.fail(f"no '{text}' in {self.seen}")

    def report(self):
        rest, _ = self.process.communicate(timeout=150)
        self.seen += rest.splitlines(keepends=True)
        return json.loads((self.desk / "report.json").read_text())


def change(first, old, new):
    plugin = first / "plugin.py"
    text = plugin.read_text()
    assert old in text
    plugin.write_text(text.replace(old, new))


@pytest.mark.long
def test_a_new_plugin_is_tested_and_flies(program, first):
    subprocess.run([first / ".venv/bin/python3", "-m", "unittest"], cwd=first, check=True)
    with Flight(program, first, "--seconds=12") as flight:
        report = flight.report()
        assert (flight.process.returncode, report["outcome"]) == (0, "landed"), flight.seen
    assert report["images_delivered"] > 10 and report["mean_speed_mps"] > 0.1, report


@pytest.mark.long
def test_a_file_saved_in_flight_flies_and_one_that_breaks_lands(program, first):
    with Flight(program, first, "--watch", "--seconds=60") as flight:
        flight.wait_for("plugin flies")
        change(first, "HEIGHT_M = 1.0", "HEIGHT_M = 1.3")
        flight.wait_for("holding: the plugin is being started again")
        flight.wait_for("the plugin flies again")
        # A file with a syntax error changes nothing: the old version continues to fly.
        change(first, "def on_image", "deff on_image")
        flight.wait_for("not reloaded: first/plugin.py is not Python")
        change(first, "deff on_image", "def on_image")
        flight.wait_for("the plugin flies again")
        change(first, "front.depth, height_m", "front.deepth, height_m")
        flight.wait_for("the plugin failed")
        report = flight.report()
    assert report["outcome"] == "plugin_failed", flight.seen
    assert "plugin.py:" in report["reason"] and "deepth" in report["reason"], report

    (log,) = flight.desk.glob("flights/*.mcap")
    replayed = subprocess.run(
        [program, "replay", log, "--plugin", "first"],
        cwd=flight.desk,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=150,
    )
    assert "deepth" in replayed.stdout and "plugin.py:" in replayed.stdout, replayed.stdout
