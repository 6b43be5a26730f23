"""Learns to fly through the three windows of project p3, from the state; says how the last hundred episodes ended.

pip install gymnasium stable-baselines3
python learn_windows.py
python learn_windows.py --fly windows.zip                      flies courses that it has not seen
python learn_windows.py --export wing                          makes a plugin of it, which needs numpy alone
"""

import argparse
import pickle
import shutil
import time
from collections import Counter
from pathlib import Path

import gymnasium
import numpy as np
import torch
from fly_windows import towards
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import vizflyt.gym

# Twenty steps a second: each has an effect that a policy can see.
HOW = dict(rate_hz=20, seconds=12.0)
# Steps of 50 ms until an action counts; the vehicles take turns.
DELAYS = (1, 2)
# Most by which the velocity asked for changes in a step, in shares of the course's speed: 4 m/s and 6 m/s^2 make 0.075.
# The guard lets no more through.
MOST_CHANGE = 0.07
# Nearer to a window's edge than this costs. [m]
COMFORT_M = 0.2
# What a plugin of a policy consists of, beside its network.
PLUGIN = ("fly_windows.py", "windows.toml")


def careful(step):
    """The usual reward, and up to 0.5 less for a step near an edge."""
    return vizflyt.gym.default_reward(step) - 0.5 * np.clip(1.0 - step.clearance_m / COMFORT_M, 0.0, 1.0)


class Steady(gymnasium.Wrapper):
    """Lets a velocity change no faster than a plugin's will."""

    def reset(self, **how):
        self.asked = np.zeros(3)
        return self.env.reset(**how)

    def step(self, action):
        self.asked = towards(self.asked, action[:3], MOST_CHANGE)
        return self.env.step(np.append(self.asked, action[3]))


class Ends(BaseCallback):
    """Prints now and then how episodes end."""

    def __init__(self):
        super().__init__()
        self.ends, self.start, self.told = [], time.monotonic(), 0

    def _on_step(self):
        self.ends += [info["end"] for done, info in zip(self.locals["dones"], self.locals["infos"]) if done]
        if self.num_timesteps - self.told >= 20_000:
            self.told = self.num_timesteps
            ends = dict(Counter(self.ends[-100:]).most_common())
            print(f"{self.num_timesteps:7} steps, {time.monotonic() - self.start:4.0f} s: {ends}", flush=True)
        return True


def learn(steps, output):
    def make(delay):
        how = dict(courses=range(1, 9), delay=delay, reward=careful, **HOW)
        return lambda: Monitor(Steady(vizflyt.gym.Env("p3", **how)))

    envs = DummyVecEnv([make(delay) for delay in DELAYS * 4])
    envs.seed(1)
    # A network learns from numbers about 1.
    envs = VecNormalize(envs, norm_reward=False)
    policy = dict(log_std_init=-0.7)
    model = PPO("MlpPolicy", envs, n_steps=512, batch_size=512, n_epochs=8, learning_rate=5e-4, ent_coef=0.001,
                policy_kwargs=policy, seed=1, device="cpu")  # fmt: skip
    model.learn(steps, callback=Ends())
    model.save(output)
    envs.save(f"{output}.scale")
    envs.close()


def fly(policy, episodes):
    model = PPO.load(policy, device="cpu")
    env = Steady(vizflyt.gym.Env("p3", courses=range(1001, 1011), delay=DELAYS[0], **HOW))
    scale = VecNormalize.load(f"{policy}.scale", DummyVecEnv([lambda: env]))
    ends, seconds = Counter(), []
    for seed in range(episodes):
        state, _ = env.reset(seed=seed)
        over = late = False
        while not (over or late):
            action, _ = model.predict(scale.normalize_obs(state), deterministic=True)
            state, _, over, late, info = env.step(action)
        ends[info["end"]] += 1
        seconds += [info["time_s"]] if info["end"] == "finished" else []
    env.close()
    print(f"{dict(ends.most_common())}; {np.mean(seconds or [np.nan]):.1f} s to the finish, on average")


def export(policy, folder):
    """Writes the network for numpy, and the plugin that flies by it."""
    network = PPO.load(policy, device="cpu").policy
    with open(f"{policy}.scale", "rb") as file:
        scale = pickle.load(file)
    layers = [layer for layer in network.mlp_extractor.policy_net if isinstance(layer, torch.nn.Linear)]
    values = {}
    for n, layer in enumerate([*layers, network.action_net]):
        values |= {f"w{n}": layer.weight.detach().numpy(), f"b{n}": layer.bias.detach().numpy()}
    deviation = np.sqrt(scale.obs_rms.var + scale.epsilon)
    folder.mkdir(parents=True, exist_ok=True)
    values |= dict(mean=scale.obs_rms.mean, deviation=deviation, seconds=HOW["seconds"], most_change=MOST_CHANGE)
    np.savez(folder / "policy.npz", **values)
    for name in PLUGIN:
        shutil.copy(Path(__file__).with_name(name), folder)
    print(f"vizflyt grade {folder / PLUGIN[0]} --project {folder / PLUGIN[1]} --first-seed 1001")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--output", default="windows.zip")
    parser.add_argument("--fly", metavar="POLICY", help="flies courses that are new to it")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--export", metavar="DIR", type=Path, help="makes a plugin of what --output has learnt")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.export:
        export(args.output, args.export)
    elif args.fly:
        fly(args.fly, args.episodes)
    else:
        learn(args.steps, args.output)
