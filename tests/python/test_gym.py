"""Gymnasium environments: Gymnasium's own check, reproducible flights, single and vectorised ones, rules, misuse."""

import gc
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import vizflyt.gym

IMAGES = dict(camera=(32, 24), observation=("state", "depth", "rgb"))


@pytest.fixture
def make(program):
    """Makes environments that are closed at the end of the test."""
    made = []

    def make(name="Windows", number=None, **how):
        one, name = number is None, f"vizflyt/{name}-v0"
        how = {**how, "program": program}
        made.append(gymnasium.make(name, **how) if one else gymnasium.make_vec(name, num_envs=number, **how))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize("how", [{}, IMAGES])
def test_gymnasium_finds_nothing_wrong(make, how):
    with warnings.catch_warnings():
        # A state has no bounds.
        warnings.filterwarnings("ignore", message=".*A Box observation space m.*")
        warnings.filterwarnings("ignore", message=".*render.*")
        check_env(make(**how).unwrapped)


def fly(envs, steps=60, seed=3):
    """Returns all observations of a few flights."""
    random = np.random.default_rng(seed)
    seen = [envs.reset(seed=5)[0]]
    rewards = []
    for _ in range(steps):
        values, reward, *_ = envs.step(random.uniform(-1, 1, (envs.num_envs, 4)))
        seen.append(values)
        rewards.append(reward)
    return seen, np.array(rewards)


def test_the_same_seeds_and_actions_show_the_same(make):
    first, first_rewards = fly(make(number=3, courses=(1, 2), delay=2, **IMAGES))
    again, again_rewards = fly(make(number=3, courses=(1, 2), delay=2, **IMAGES))
    assert (first_rewards == again_rewards).all()
    for one, other in zip(first, again):
        assert all((one[part] == other[part]).all() for part in ("state", "depth", "rgb"))
    depth = np.array([seen["depth"] for seen in first])
    assert depth.dtype == np.float32 and 0.02 < depth.min() < 0.5 and depth.max() == 1.0
    assert np.array([seen["rgb"] for seen in first]).std() > 20, "there is something to see"


def test_many_fly_as_one_does(make):
    envs, env = make(number=3), make()
    many, _ = envs.reset(seed=7)
    one, _ = env.reset(seed=8)
    for turn in range(40):
        assert (many[1] == one).all(), turn
        action = np.array([0.3, -0.2, 0.1 * np.sin(turn), 0.4], np.float32)
        many, rewards, *_ = envs.step(np.tile(action, (3, 1)))
        one, reward, *_ = env.step(action)
        assert rewards[1] == reward


def towards(state, speed_mps=1.2, limit_mps=2.0):
    """Returns the action that flies through the next window: first onto the line through its centre."""
    way_m, along = state[9:12], state[12:15]
    ahead_m = way_m @ along
    aim_m = way_m - along * np.clip(ahead_m - 0.3, -0.6, 0.8) if along.any() and ahead_m > 0 else way_m + 0.6 * along
    velocity = aim_m / max(np.linalg.norm(aim_m), 0.3) * speed_mps
    return np.array([*velocity / limit_mps, 0.0], np.float32)


def test_who_flies_through_the_gap_finishes_and_who_flies_down_crashes(make):
    env = make("Gap", seconds=20.0)
    limit_mps = env.unwrapped._flights.about["max_speed_mps"]
    state, info = env.reset(seed=1)
    total, is_over = 0.0, False
    while not is_over:
        state, reward, is_over, is_late, info = env.step(towards(state, limit_mps=limit_mps))
        total += reward
        assert not is_late, info
    assert info["end"] == "finished" and total > 10.0, info
    env.reset(seed=2)
    for _ in range(400):
        _, reward, is_over, _, info = env.step([0.0, 0.0, -1.0, 0.0])
        if is_over:
            break
    assert info["end"] == "crashed" and reward < -3.0, info


def test_an_episode_that_is_over_begins_anew_and_rewards_are_ones_own(make):
    envs = make(number=2, seconds=0.5, reward=lambda step: step.time_s * 2.0)
    envs.reset(seed=1)
    for turn in range(1, 20):
        _, rewards, terminated, truncated, _ = envs.step(np.zeros((2, 4)))
        assert np.allclose(rewards, 2 * turn / 40) and not terminated.any() and not truncated.any()
    assert envs.step(np.zeros((2, 4)))[3].all()
    seen, rewards, _, truncated, infos = envs.step(np.ones((2, 4)))
    assert (infos["time_s"] == 0).all() and not truncated.any() and (rewards == 0).all()
    assert (seen[:, 21] == 1.0).all(), "all of the time is left"


def test_what_follows_comes_from_one_seed_or_from_many(make):
    for seed in (5, [5, 11, 17]):
        starts = []
        for _ in range(2):
            envs = make(number=3, seconds=0.1)
            envs.reset(seed=seed)
            steps = [envs.step(np.zeros((3, 4))) for _ in range(30)]
            starts.append(np.array([seen for seen, *_, infos in steps if not any(infos["time_s"])]))
        assert starts[0].shape == (6, 3, 22) and (starts[0] == starts[1]).all(), seed
        assert len(np.unique(starts[0][:, :, 15])) == 18, "each episode has a start of its own"


def test_hovering_stays_and_numbers_that_are_none_ask_for_nothing(make):
    for action in ("velocity", "acceleration", "body-rates"):
        env = make(action=action)
        before, _ = env.reset(seed=4)
        for _ in range(40):
            after, *_ = env.step([np.nan, 0.0, 0.0, np.inf])
        assert np.linalg.norm(after[15:18] - before[15:18]) < 0.02, action


def test_mistakes_are_explained(program, capfd):
    with pytest.raises(RuntimeError, match="ended with status 1"):
        vizflyt.gym.Env("p99", program=program)
    assert "no project 'p99'; there are" in capfd.readouterr().err
    # Without the mark as closed, gymnasium would report the end.
    with pytest.raises(RuntimeError, match="ended with status 1"):
        vizflyt.gym.VectorEnv(2, "p99", program=program)
    gc.collect()
    capfd.readouterr()
    with pytest.raises(RuntimeError):
        vizflyt.Env("p3", rate_hz=33, program=program)
    assert "a multiple of" in capfd.readouterr().err
    with pytest.raises(ValueError, match="give camera="):
        vizflyt.Env("p3", observation="depth", program=program)
    with pytest.raises(ValueError, match="one or several of state, depth, rgb"):
        vizflyt.Env("p3", observation="lidar", program=program)
