"""Trains a linear policy that flies through the window of window.toml, by the cross-entropy method; numpy only.

pip install 'vizflyt[gym]'
python learn_window.py                writes policy.npz, for fly_windows.py
"""

import time

import numpy as np

import vizflyt.gym

VEHICLES, ELITE, ROUNDS, SECONDS = 128, 16, 30, 8.0
MOST_CHANGE = 0.07  # largest change of the velocity in a step, as a share of the speed limit
# Inputs of the policy: velocity, direction to the window, axis of the window [heading axes].
INPUTS = [0, 1, 2, 9, 10, 11, 12, 13, 14]
SCALE = np.array([3, 3, 3, 3, 1, 1, 1, 1, 1])


def act(weights, state):
    """Returns one action per vehicle: a linear function of its inputs, from -1 to 1."""
    inputs = np.column_stack([state[:, INPUTS] / SCALE, np.ones(len(state))])
    return np.clip(np.einsum("nij,nj->ni", weights, inputs), -1, 1)


def towards(velocity, wish):
    """Limits the change of the velocity in one step, as the guard does in flight."""
    wish = wish / np.maximum(np.linalg.norm(wish, axis=1, keepdims=True), 1)
    change = wish - velocity
    return velocity + change * np.minimum(MOST_CHANGE / (np.linalg.norm(change, axis=1, keepdims=True) + 1e-9), 1)


def episode(envs, weights, seed):
    """Flies each vehicle to the end of its episode; returns its reward, and whether it finished."""
    state, _ = envs.reset(seed=seed)
    reward, finished = np.zeros(len(weights)), np.zeros(len(weights), bool)
    flying, velocity = np.ones(len(weights), bool), np.zeros((len(weights), 3))
    while flying.any():
        action = act(weights, state)
        velocity = action[:, :3] = towards(velocity, action[:, :3])
        state, gain, terminated, truncated, info = envs.step(action)
        reward += gain * flying
        finished |= flying & (info["end"] == vizflyt.gym.FINISHED)
        flying &= ~(terminated | truncated)
    return reward, finished


def environments(courses):
    return vizflyt.gym.VectorEnv(VEHICLES, "window.toml", courses=courses, rate_hz=20, delay=2, seconds=SECONDS)


rng, start = np.random.default_rng(1), time.monotonic()
mean, deviation = np.zeros((4, 10)), np.full((4, 10), 0.5)
envs = environments(range(1, 9))
for n in range(1, ROUNDS + 1):
    weights = mean + deviation * rng.standard_normal((VEHICLES, 4, 10))
    runs = [episode(envs, weights, 10_000 * n + 1_000 * k) for k in range(4)]
    reward, finished = np.mean([run[0] for run in runs], axis=0), np.mean([run[1] for run in runs])
    best = np.argsort(reward)[-ELITE:]
    mean, deviation = weights[best].mean(axis=0), weights[best].std(axis=0) + 0.05
    if n % 5 == 0:
        print(f"round {n}, {time.monotonic() - start:.0f} s: reward {reward.mean():.1f}, {finished:.0%} finished")
envs.close()

envs = environments(range(1001, 1021))
finished = episode(envs, np.repeat(mean[None], VEHICLES, axis=0), seed=1)[1]
print(f"new courses: {finished.sum()} of {VEHICLES} finished")
envs.close()

# The format of fly_windows.py: a layer of weights for all 22 numbers of the state.
layer, scale = np.zeros((4, 22)), np.ones(22)
layer[:, INPUTS], scale[INPUTS] = mean[:, :-1], SCALE
values = dict(w0=layer, b0=mean[:, -1], mean=np.zeros(22), deviation=scale)
np.savez("policy.npz", **values, seconds=SECONDS, most_change=MOST_CHANGE)
