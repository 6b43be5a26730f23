"""Shared fixtures: a small vehicle, and a way to run a plugin against a rehearsal."""

import threading

import numpy as np
import pytest

import vizflyt


def pytest_addoption(parser):
    parser.addoption("--vizflyt", help="the built program; without it nothing flies")
    parser.addoption("--wheel", help="the built wheel; without it nothing is installed")


def pytest_configure(config):
    # `tests/run` has a stage for each.
    config.addinivalue_line("markers", "long: whole flights that take many seconds")
    config.addinivalue_line("markers", "course: starters and solutions of docs/course")


@pytest.fixture
def program(request):
    path = request.config.getoption("--vizflyt")
    if path is None:
        pytest.skip("no --vizflyt given")
    return path


@pytest.fixture(autouse=True)
def readable(tmp_path):
    """Makes the folder readable: as root, a plugin runs as another user."""
    tmp_path.chmod(0o755)


def camera(name="front", width=64, height=48):
    return vizflyt.CameraInfo(name, vizflyt.Intrinsics.from_horizontal_fov(width, height, 1.5))


def pattern(height, width, seed):
    """Returns colour and depth that differ between pixels and between seeds."""
    random = np.random.default_rng(seed)
    rgb = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    depth_mm = random.integers(0, 60000, (height, width), dtype=np.uint16)
    return rgb, depth_mm


class Stage:
    """A rehearsal with one camera, and a buffer to publish from."""

    def __init__(self, waiting=False, width=64, height=48):
        self.cameras = [camera(width=width, height=height)]
        self.shape = (height, width)
        self.rehearsal = vizflyt.Rehearsal(self.cameras, waiting=waiting)
        self.buffer = vizflyt.ObservationBuffer(self.cameras)
        self.info = vizflyt.ArenaInfo(name="stage", goal_m=[5, 0, 1], cameras=self.cameras)

    def publish(self, seq, stamp_ns=0):
        rgb, depth_mm = pattern(*self.shape, seq)
        self.buffer.clear(seq)
        self.buffer.set_image("front", rgb, depth_mm, seq=seq, stamp_ns=stamp_ns)
        self.rehearsal.publish(self.buffer)
        return rgb, depth_mm

    def attach(self, plugin):
        """Runs the plugin on its own thread; returns the thread once the plugin is ready."""
        thread = Runner(plugin, self.rehearsal.service)
        thread.start()
        self.wait_attached()
        self.rehearsal.start(self.info)
        assert self.rehearsal.receive()[0] == "ready"
        return thread

    def wait_attached(self, alive=lambda: True):
        while not self.rehearsal.is_attached:
            assert alive(), "the plugin ended before it attached"
            self.rehearsal.receive(timeout_s=0.02)

    def answer(self, seq, stamp_ns=0):
        """Publishes an image and returns the plugin's reply."""
        self.publish(seq, stamp_ns)
        return self.rehearsal.receive()


class Runner(threading.Thread):
    def __init__(self, plugin, service):
        super().__init__(daemon=True)
        self.plugin, self.service, self.error = plugin, service, None

    def run(self):
        try:
            vizflyt.run(self.plugin, service=self.service)
        except BaseException as error:
            self.error = error

    def ended(self):
        self.join(20)
        assert not self.is_alive(), "the plugin goes on"
        return self.error


@pytest.fixture
def stage():
    return Stage()
