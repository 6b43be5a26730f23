"""Flies the example plugins in the simulated lab with the real program."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vizflyt._vizflyt import waiting_services

PLUGINS = Path(__file__).parents[2] / "jetson/plugins/python"


class Flight:
    def __init__(self, program, plugin, folder, *arguments):
        report = folder / "report.json"
        done = subprocess.run(
            [
                program, "demo", "--headless", f"--plugin={plugin}", f"--log-dir={folder}",
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


@pytest.mark.long
def test_avoid_crosses_the_forest(fly):
    flight = fly(PLUGINS / "avoid.py")
    assert (flight.status, flight.report["outcome"]) == (0, "finished"), flight.output
    assert flight.report["mean_speed_mps"] > 1.5 and flight.report["min_clearance_m"] > 0, flight.output


def test_hover_turns_and_lands(fly):
    flight = fly(PLUGINS / "hover.py")
    assert "the plugin asked to land" in flight.report["reason"], flight.output
    # 8 s of yawing, take-off and landing.
    assert 8 < flight.report["seconds"] < 40, flight.output


@pytest.mark.long
def test_waypoints_flies_its_square(fly):
    flight = fly(PLUGINS / "waypoints.py", "--scene=room")
    assert "the plugin asked to land" in flight.report["reason"], flight.output


@pytest.mark.long
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


@pytest.mark.long
def test_numbers_that_are_not_finite_end_in_a_landing_and_not_in_a_failure(fly, tmp_path):
    plugin = tmp_path / "nan.py"
    plugin.write_text(
        "#!/usr/bin/env python3\n"
        "import vizflyt\n"
        "class Nan(vizflyt.Plugin):\n"
        "    speed_mps = 0.0\n"
        "    def on_event(self, event):\n"
        "        if event.details.get('phase') == 'flying':\n"
        "            self.speed_mps = float('nan')\n"
        "    def on_image(self, obs):\n"
        "        return vizflyt.Setpoint.velocity([self.speed_mps, 0, 0])\n"
        "vizflyt.run(Nan)\n"
    )
    plugin.chmod(0o755)
    flight = fly(plugin)
    # Ignored, then held, then landed, as described in docs/guides/safety.md.
    assert "setpoints are refused: a number in it is not finite" in flight.report["reason"], flight.output
    assert "nan.py:9 in on_image: NotFiniteError: v_mps is [NaN, 0.0, 0.0]" in flight.output
    assert "holding: " in flight.output, flight.output


@pytest.mark.long
def test_a_plugin_attaches_stops_at_a_breakpoint_and_dies(program, tmp_path):
    others, report = set(waiting_services()), tmp_path / "report.json"
    lab = subprocess.Popen(
        [
            program, "fly", "--attach", "--headless", "--no-config", f"--log-dir={tmp_path}",
            f"--report={report}",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    seen, plugin = [], None

    def wait_for(text):
        for line in lab.stdout:
            seen.append(line)
            if text in line:
                return
        pytest.fail(f"no '{text}' in {seen}")

    try:
        wait_for("waiting for a plugin: start yours")
        (service,) = set(waiting_services()) - others
        # The service name is needed only if several wait.
        choose = [f"--vizflyt-service={service}"] if others else []
        plugin = subprocess.Popen([sys.executable, PLUGINS / "hover.py", *choose])
        wait_for("the plugin flies")
        assert service not in waiting_services()
        # As a debugger does. The guard would land after 2 s.
        plugin.send_signal(signal.SIGSTOP)
        time.sleep(3.5)
        plugin.kill()
        wait_for("the attached plugin has ended")
        assert not any("landing" in line for line in seen[:-1]), seen
        lab.communicate(timeout=60)
    finally:
        for process in (lab, plugin):
            if process is not None and process.poll() is None:
                process.kill()
                process.communicate()
    assert json.loads(report.read_text())["outcome"] == "plugin_failed"
