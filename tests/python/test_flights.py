"""The example plugins fly in the simulated lab, by the real program."""

import json
import subprocess
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parents[2] / "jetson/plugins/python"


class Flight:
    def __init__(self, program, plugin, folder, *arguments):
        report = folder / "report.json"
        done = subprocess.run(
            [
                program, "demo", "--headless", f"--plugin={plugin}", f"--log={folder}",
                f"--report={report}", *arguments,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=150,
        )
        self.status, self.output = done.returncode, done.stdout
        assert report.exists(), self.output
        self.report = json.loads(report.read_text())


@pytest.fixture
def fly(program, tmp_path):
    return lambda plugin, *arguments: Flight(program, plugin, tmp_path, *arguments)


def test_avoid_crosses_the_forest(fly):
    flight = fly(PLUGINS / "avoid.py")
    assert (flight.status, flight.report["outcome"]) == (0, "finished"), flight.output
    assert flight.report["mean_speed_mps"] > 1.5 and flight.report["min_clearance_m"] > 0, flight.output


def test_hover_turns_and_lands(fly):
    flight = fly(PLUGINS / "hover.py")
    assert "the plugin asked to land" in flight.report["reason"], flight.output
    # 8 s of turning, and the way up and down.
    assert 8 < flight.report["seconds"] < 40, flight.output


def test_waypoints_flies_its_square(fly):
    flight = fly(PLUGINS / "waypoints.py", "--scene=room")
    assert "the plugin asked to land" in flight.report["reason"], flight.output


def test_a_plugin_that_raises_ends_in_a_landing_with_its_own_line(fly, tmp_path):
    plugin = tmp_path / "raises.py"
    plugin.write_text(
        "#!/usr/bin/env python3\n"
        "import vizflyt\n"
        "class Raises(vizflyt.Plugin):\n"
        "    def on_event(self, event):\n"
        "        if event.details.get('phase') == 'flying':\n"
        "            self.speed_mps = 1 / 0\n"
        "    def on_image(self, obs):\n"
        "        return vizflyt.Setpoint.hold()\n"
        "vizflyt.run(Raises)\n"
    )
    plugin.chmod(0o755)
    flight = fly(plugin)
    assert flight.status != 0
    assert (
        "raises.py:6 in on_event: ZeroDivisionError: division by zero (self.speed_mps = 1 / 0)"
        in flight.report["reason"]
    ), flight.output
