"""The main loop as a separate process: messages to the runtime when a plugin fails."""

import signal
import subprocess
import sys
import textwrap
import time

import pytest
from conftest import Stage, pattern

from vizflyt import Setpoint
from vizflyt._vizflyt import waiting_services


class Process:
    """A plugin's file, run by this Python and attached to a stage."""

    def __init__(self, stage, folder, source, arguments=None):
        self.path = folder / "my_plugin.py"
        self.path.write_text("import vizflyt\nfrom vizflyt import Setpoint\n" + textwrap.dedent(source))
        if arguments is None:
            arguments = [f"--vizflyt-service={stage.rehearsal.service}"]
        self.child = subprocess.Popen(
            [sys.executable, str(self.path), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # A shell's background jobs, including these tests, ignore SIGINT, and their children inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        self.stage = stage

    def ready(self):
        self.stage.wait_attached(alive=lambda: self.child.poll() is None)
        self.stage.rehearsal.start(self.stage.info)
        return self.stage.rehearsal.receive()

    def ended(self):
        out, err = self.child.communicate(timeout=20)
        return self.child.returncode, out, err


@pytest.fixture
def start(stage, tmp_path):
    processes = []

    def start(source, arguments=None):
        processes.append(Process(stage, tmp_path, source, arguments))
        return processes[-1]

    yield start
    for process in processes:
        process.child.kill()
        process.child.communicate()


def test_a_whole_flight_in_order(stage, start):
    process = start(
        """
        class Count(vizflyt.Plugin):
            def on_start(self, info):
                print("start", info.name, info.goal_m, info.cameras[0].name)
            def on_event(self, event):
                print("event", event.kind, event.details, event.text)
            def on_image(self, obs):
                print("image", obs.seq)
                return Setpoint.velocity([obs.seq, 0, 0]) if obs.seq > 1 else None
            def on_stop(self):
                print("stop")
        vizflyt.run(Count)
        """
    )
    assert process.ready()[::2] == ("ready", "Count")
    stage.rehearsal.finish(9.5)
    assert stage.answer(1)[:3] == ("answer", 1, None)
    assert stage.answer(2)[:3] == ("answer", 2, Setpoint.velocity([2, 0, 0]))
    stage.rehearsal.stop()
    status, out, err = process.ended()
    assert (status, err) == (0, "")
    assert out.splitlines() == [
        "start stage [5. 0. 1.] front",
        "event finished {'seconds': 9.5} finished",
        "image 1",
        "image 2",
        "stop",
    ]


def test_what_is_printed_comes_at_once(stage, start):
    process = start(
        """
        class Print(vizflyt.Plugin):
            def on_image(self, obs):
                print("seen", obs.seq)
        vizflyt.run(Print)
        """
    )
    process.ready()
    stage.answer(3)
    # Through a pipe, while the plugin is still running.
    assert process.child.stdout.readline() == "seen 3\n"


FAILURES = {
    "an exception": (
        "return Setpoint.velocity([1 / 0, 0, 0])",
        "my_plugin.py:6 in on_image: ZeroDivisionError: division by zero "
        "(return Setpoint.velocity([1 / 0, 0, 0]))",
    ),
    "an exception inside a library": (
        "import numpy as np; return np.zeros(3) @ np.zeros(4)",
        "my_plugin.py:6 in on_image: ValueError: matmul",
    ),
    "an exception in a helper": (
        "return self.helper(obs)",
        "my_plugin.py:8 in helper, called from on_image: AttributeError: 'NoneType' object has no "
        "attribute 'rgb'",
    ),
    "an array": (
        "import numpy as np; return np.array([1, 0, 0])",
        "in on_image: TypeError: on_image returned a ndarray of shape (3,); return a "
        "vizflyt.Setpoint, such as Setpoint.velocity([1, 0, 0]), or None",
    ),
    "a tuple": ("return (1, 0, 0)", "on_image returned a tuple; return a vizflyt.Setpoint"),
    "a method": (
        "return Setpoint.hold",
        "on_image returned the function hold itself; call it: hold(...)",
    ),
    "a wrong vector": (
        "return Setpoint.velocity(obs.camera('front').depth)",
        "v_mps must be three numbers [x, y, z], not a numpy.ndarray of shape (48, 64)",
    ),
    "an unknown camera": ("return obs.camera('fornt')", "there is no camera 'fornt'; this vehicle has 'front'"),
    "a name that is not there": (
        "return obs.position",
        "'vizflyt.Observation' object has no attribute 'position'; it has battery, camera, cameras, imu,",
    ),
    "exit": ("import sys; sys.exit(0)", "my_plugin.py:6 in on_image: the plugin called exit: status 0"),
}


@pytest.mark.parametrize("line, sentence", FAILURES.values(), ids=FAILURES.keys())
def test_a_failure_is_one_sentence_with_the_students_own_line(stage, start, line, sentence):
    process = start(
        f"""
        class Fail(vizflyt.Plugin):
            def on_image(self, obs):
                {line}
            def helper(self, obs):
                return None .rgb
        vizflyt.run(Fail)
        """
    )
    process.ready()
    what, _, reason, _ = stage.answer(1)
    assert what == "failed" and sentence in reason, reason
    status, _, err = process.ended()
    if "exit" in reason:
        assert status == 0
    else:
        # And the whole traceback on standard error.
        assert status == 1 and err.startswith("Traceback") and reason.split(": ")[1] in err


def test_a_number_that_is_not_finite_is_refused_and_the_plugin_goes_on(stage, start):
    process = start(
        """
        class Blind(vizflyt.Plugin):
            def on_image(self, obs):
                speed_mps = 1.0 if obs.seq > 12 else float("nan")
                return Setpoint.velocity([speed_mps, 0, 0])
        vizflyt.run(Blind)
        """
    )
    process.ready()
    for seq in range(1, 13):
        what, answered, setpoint, _ = stage.answer(seq)
        # Setpoints that the runtime refuses, in every language.
        assert (what, answered) == ("answer", seq) and "NaN" in repr(setpoint), setpoint
    assert stage.answer(13)[:3] == ("answer", 13, Setpoint.velocity([1, 0, 0]))
    stage.rehearsal.stop()
    status, _, err = process.ended()
    line = "plugin: my_plugin.py:7 in on_image: NotFiniteError: v_mps is [NaN, 0.0, 0.0]: every number must be finite"
    assert status == 0
    assert [told.startswith(line) for told in err.splitlines()] == [True, True], err
    assert "(1 so far)" in err and "(10 so far)" in err, err


CLASSES = {
    "not a plugin": ("class P:\n    pass", "P is not a plugin: define it as class P(vizflyt.Plugin)"),
    "misspelt": (
        "class P(vizflyt.Plugin):\n    def on_imgae(self, obs): pass",
        "P has no method on_image(self, obs); rename on_imgae to on_image?",
    ),
    "without self": (
        "class P(vizflyt.Plugin):\n    def on_image(obs): pass",
        "P.on_image must be def on_image(self, obs)",
    ),
    "async": (
        "class P(vizflyt.Plugin):\n    async def on_image(self, obs): pass",
        "P.on_image is async, but is not awaited: write def on_image(self, obs)",
    ),
    "broken constructor": (
        "class P(vizflyt.Plugin):\n    def __init__(self): self.model = open('weights.pt')\n"
        "    def on_image(self, obs): pass",
        "my_plugin.py:4 in __init__: FileNotFoundError",
    ),
}


@pytest.mark.parametrize("source, sentence", CLASSES.values(), ids=CLASSES.keys())
def test_a_wrong_class_is_told_before_the_vehicle_is_in_the_air(stage, start, source, sentence):
    process = start(source + "\nvizflyt.run(P)\n")
    what, _, reason, _ = stage.rehearsal.receive()
    assert what == "failed" and sentence in reason, reason
    assert process.ended()[0] == 1


def test_ctrl_c_ends_a_plugin_and_tells_why(stage, start):
    process = start(
        """
        class Wait(vizflyt.Plugin):
            def on_image(self, obs):
                return Setpoint.hold()
        vizflyt.run(Wait)
        """
    )
    process.ready()
    stage.answer(1)
    process.child.send_signal(signal.SIGINT)
    assert stage.rehearsal.receive()[::2] == ("failed", "the plugin was interrupted (Ctrl-C)")
    assert "KeyboardInterrupt" in process.ended()[2]


def test_a_crash_in_compiled_code_shows_the_line_it_came_from(stage, start):
    process = start(
        """
        import ctypes
        class Crash(vizflyt.Plugin):
            def on_image(self, obs):
                ctypes.string_at(0)
        vizflyt.run(Crash)
        """
    )
    process.ready()
    stage.publish(1)
    status, _, err = process.ended()
    assert status == -signal.SIGSEGV
    assert f'"{process.path}", line 7 in on_image' in err


def test_a_plugin_ends_when_its_runtime_is_gone(tmp_path):
    stage = Stage()
    process = Process(
        stage,
        tmp_path,
        """
        class Last(vizflyt.Plugin):
            def on_image(self, obs):
                return None
            def on_stop(self):
                print("stopped")
        vizflyt.run(Last)
        """,
    )
    process.ready()
    process.stage = None
    del stage
    status, out, err = process.ended()
    assert (status, out) == (1, "stopped\n") and "the runtime is gone" in err


PLAIN = """
class Plain(vizflyt.Plugin):
    def on_image(self, obs):
        return Setpoint.hold()
vizflyt.run(Plain)
"""


def test_started_by_hand_it_finds_the_runtime_that_waits(tmp_path):
    stage = Stage(waiting=True)
    waiting = waiting_services()
    assert stage.rehearsal.service in waiting
    process = Process(stage, tmp_path, PLAIN, arguments=[])
    if waiting == [stage.rehearsal.service]:
        assert process.ready()[::2] == ("ready", "Plain")
        stage.rehearsal.stop()
        assert process.ended()[0] == 0
    else:
        # Another process on this computer flies too: then the plugin needs the service name.
        status, _, err = process.ended()
        assert status == 2 and "runtimes wait for a plugin: choose one" in err
    service = stage.rehearsal.service
    del stage, process.stage
    assert service not in waiting_services()


def test_without_a_runtime_it_says_how_to_start_one(tmp_path):
    process = Process(None, tmp_path, PLAIN, arguments=["--vizflyt-service=vizflyt/nobody"])
    status, _, err = process.ended()
    assert status == 2
    assert err == "plugin: no runtime offers vizflyt/nobody; start the plugin with `vizflyt fly`\n"
    if not waiting_services():
        status, _, err = Process(None, tmp_path, PLAIN, arguments=[]).ended()
        assert status == 2 and "no runtime waits for a plugin; start one with `vizflyt fly --attach`" in err


def test_a_debugger_may_stop_it_for_seconds(stage, start):
    process = start(PLAIN)
    process.ready()
    process.child.send_signal(signal.SIGSTOP)
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        assert stage.rehearsal.receive(timeout_s=0.2) is None
    process.child.send_signal(signal.SIGCONT)
    assert stage.answer(9)[:2] == ("answer", 9)


def test_time_from_an_image_to_on_image(stage, start, capsys):
    """Prints the latency; a limit would fail on a busy computer."""
    big = Stage(width=640, height=480)
    process = start(PLAIN.replace("return", "obs.camera('front').depth_mm[240, 320]; return"),
                    [f"--vizflyt-service={big.rehearsal.service}"])
    process.stage = big
    process.ready()
    rgb, depth_mm = pattern(480, 640, 5)
    waits_ms = []
    for seq in range(1, 301):
        due = time.monotonic() + 1 / 60
        big.buffer.clear(seq)
        big.buffer.set_image("front", rgb, depth_mm, seq=seq)
        ready_ns = time.monotonic_ns()
        big.rehearsal.publish(big.buffer)
        what, answered, _, entered_ns = big.rehearsal.receive()
        assert (what, answered) == ("answer", seq) and entered_ns >= ready_ns
        waits_ms.append((entered_ns - ready_ns) * 1e-6)
        while time.monotonic() < due:
            big.rehearsal.receive(timeout_s=max(due - time.monotonic(), 0.0))
    waits_ms.sort()
    with capsys.disabled():
        print(
            f"\nimage published -> on_image at 640x480, 60 Hz: p50 {waits_ms[150]:.3f} ms, "
            f"p99 {waits_ms[297]:.3f} ms, max {waits_ms[-1]:.3f} ms (the copy into shared memory included)"
        )
