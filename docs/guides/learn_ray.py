"""Learns to fly through the three windows of project p3 with Ray's RLlib, on one node or several; says how fast.

pip install gymnasium 'ray[rllib]' torch
python learn_ray.py
python learn_ray.py --nodes 2                                  two nodes of Ray's on this machine, a core each
python learn_ray.py --address HOST:6379                        nodes that run already (`ray start`)
"""

import argparse
import os
import time

# What Ray's processes start with: one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import ray
from ray.cluster_utils import Cluster
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

# The module before the colon is imported wherever a vehicle flies: on other nodes too.
ENV = "vizflyt.gym:vizflyt/Windows-v0"
HOW = dict(courses=range(1, 9), rate_hz=20, seconds=12.0, delay=1)


def config(runners, vehicles, seed=1, env=ENV, batch=4096, **how):
    """PPO, with so many processes that fly so many vehicles each."""
    return (
        PPOConfig()
        .environment(env, env_config={**HOW, **how})
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=vehicles,
            # The vehicles of a process in one `vizflyt gym`. With "sync", RLlib's own choice, each has one of its own.
            gym_env_vectorize_mode="vector_entry_point",
            # A network learns from numbers about 1.
            env_to_module_connector=lambda env, spaces, device: MeanStdFilter(),
        )
        .training(
            train_batch_size_per_learner=batch,
            minibatch_size=512,
            num_epochs=8,
            lr=5e-4,
            entropy_coeff=0.001,
            gamma=0.99,
            lambda_=0.95,
            clip_param=0.2,
            vf_clip_param=1e3,
            use_kl_loss=False,
            grad_clip=0.5,
        )
        .rl_module(
            model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], fcnet_activation="tanh", vf_share_layers=False)
        )
        .debugging(seed=seed)
    )


def start(nodes, address):
    """Joins the nodes of an address, else starts some here; returns what must be shut down in the end, if anything."""
    if address:
        ray.init(address=address, log_to_driver=False)
        return None
    if nodes == 1:
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
        return None
    cluster = Cluster(initialize_head=True, head_node_args=dict(num_cpus=1, include_dashboard=False))
    for _ in range(nodes - 1):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    ray.init(address=cluster.address, log_to_driver=False)
    return cluster


def where(algorithm):
    """Returns, of each process that flies, the node that it is on."""
    ids = algorithm.env_runner_group.foreach_env_runner(
        lambda runner: ray.get_runtime_context().get_node_id(), local_env_runner=False
    )
    return [node[:8] for node in ids]


def learn(algorithm, steps):
    """Learns; yields steps, seconds, steps a second of the last round, and what an episode earned."""
    done, begun = 0, time.monotonic()
    while done < steps:
        at = time.monotonic()
        result = algorithm.train()["env_runners"]
        before, done = done, int(result["num_env_steps_sampled_lifetime"])
        now = time.monotonic()
        yield done, now - begun, (done - before) / (now - at), result.get("episode_return_mean", float("nan"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=120_000)
    parser.add_argument("--nodes", type=int, default=1, help="nodes of Ray's to start on this machine")
    parser.add_argument("--address", help="of nodes that run already")
    parser.add_argument("--runners", type=int, default=2, help="processes that fly")
    parser.add_argument("--vehicles", type=int, default=4, help="of each process")
    args = parser.parse_args()
    cluster = start(args.nodes, args.address)
    algorithm = config(args.runners, args.vehicles).build_algo()
    print(f"{args.runners} x {args.vehicles} vehicles, on nodes {', '.join(where(algorithm))}", flush=True)
    for done, seconds, rate, reward in learn(algorithm, args.steps):
        print(f"{done:7} steps, {seconds:4.0f} s, {rate:5.0f} a second: {reward:6.2f} an episode", flush=True)
    algorithm.stop()
    ray.shutdown()
    if cluster:
        cluster.shutdown()
