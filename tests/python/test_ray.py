"""Ray's RLlib on two nodes: both fly their own episodes, the reward rises, and no process remains at the end.

Ray is large, and tests/python/run does not install it. docs/guides/learning.md explains how to run this test.
"""

import importlib.util
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ray.rllib", reason="Ray is not installed: pip install 'ray[rllib]' torch")
pytest.importorskip("torch", reason="RLlib learns by PyTorch: pip install torch")
# Deprecations within Ray and its dependencies do not matter here.
pytestmark = pytest.mark.filterwarnings("ignore")

import ray  # noqa: E402, after the check that it is installed

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "learn_ray.py"


@pytest.fixture(scope="module")
def guide():
    spec = importlib.util.spec_from_file_location("learn_ray", GUIDE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    cluster = module.start(nodes=2, address=None)
    yield module
    ray.shutdown()
    cluster.shutdown()


def of_each(algorithm, what):
    """Calls `what` in every flying process; not in the learner, whose vehicles only provide the spaces."""
    return algorithm.env_runner_group.foreach_env_runner(what, local_env_runner=False)


def flies(runner):
    return runner.env.unwrapped._flights._process.pid


def draw(runner):
    return runner.env.unwrapped._draw().tolist()


def is_over(pid):
    """Returns whether a process has ended; a zombie counts as ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")")[-1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def wait_until(is_so, seconds=30):
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_two_nodes_fly_and_one_learns(guide, program):
    algorithm = guide.config(runners=2, vehicles=4, program=program).build_algo()
    assert len(set(guide.where(algorithm))) == 2, "a process on each node"
    rounds = list(guide.learn(algorithm, 30_000))
    rewards = [reward for *_, reward in rounds]
    assert np.isfinite(rewards).all() and rewards[-1] > rewards[0] + 2.0, rewards
    drawn = of_each(algorithm, draw)
    assert len(np.unique(drawn)) == 8, "episodes differ from process to process"
    pids = of_each(algorithm, flies)
    assert not any(map(is_over, pids))
    algorithm.stop()
    wait_until(lambda: all(map(is_over, pids)))


def test_who_is_killed_takes_its_vehicles_along_and_is_replaced(guide, program):
    algorithm = guide.config(runners=2, vehicles=2, program=program, batch=1024).build_algo()
    pids = of_each(algorithm, lambda runner: (os.getpid(), flies(runner)))
    os.kill(pids[0][0], signal.SIGKILL)
    wait_until(lambda: is_over(pids[0][1]))
    assert not is_over(pids[1][1])
    for _ in range(20):
        algorithm.train()
        if len(of_each(algorithm, flies)) == 2:
            break
    now = of_each(algorithm, flies)
    assert pids[1][1] in now and len(now) == 2 and pids[0][1] not in now
    algorithm.stop()
    wait_until(lambda: all(map(is_over, now)))


def test_an_environment_that_cannot_be_made_says_why(guide, program, capfd):
    with pytest.raises(Exception, match="vizflyt gym ended with status 1"):
        guide.config(runners=0, vehicles=2, env="vizflyt.gym:vizflyt/Gap-v0", rate_hz=33, program=program).build_algo()
    assert "a multiple of" in capfd.readouterr().err
