"""Learns to balance the pole with Stable-Baselines3: python train_sb3.py [balance.onnx]

Proximal policy optimization with a network of 16 units. What it has learnt is written to
network.npz for policy.py, or in ONNX for a node without a plugin; neither needs Stable-Baselines3
or PyTorch. J. Schulman et al., "Proximal Policy Optimization Algorithms", 2017.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from gymnasium.wrappers import FlattenObservation
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from train import HERE, STEPS, make

import neuros.gym

MOST_STEPS, BETWEEN, EPISODES = 40_960, 4_096, 3


def make_flat():
    """The environment of train.py, with positions and velocities in one array."""
    return Monitor(FlattenObservation(make()))


def learn(env, seed=1):
    """A model with which the pole stays up in all episodes that it is tried in."""
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=512,
        batch_size=128,
        gamma=0.98,
        gae_lambda=0.9,
        learning_rate=3e-3,
        policy_kwargs={"net_arch": [16], "log_std_init": -0.5},
        seed=seed,
        device="cpu",
    )
    upright = 0.0
    while upright < STEPS and model.num_timesteps < MOST_STEPS:
        model.learn(BETWEEN, reset_num_timesteps=False)
        upright, _ = evaluate_policy(model, env, EPISODES)
        print(f"{model.num_timesteps} steps: upright for {upright:.0f} of {STEPS}")
    return model


def write(file, model):
    """The policy in ONNX, or the layers from observation to force, as policy.py reads them."""
    if file.suffix == ".onnx":
        node = neuros.gym.export_policy(model, file)
        print(json.dumps(node, indent=4))  # as in exported.json
        return
    layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    arrays = {}
    for n, layer in enumerate(each for each in layers if isinstance(each, torch.nn.Linear)):
        arrays[f"weights{n}"] = layer.weight.detach().numpy()
        arrays[f"biases{n}"] = layer.bias.detach().numpy()
    np.savez(file, **arrays)


def main():
    torch.set_num_threads(1)  # the network is small, and the nodes need the other cores
    env = make_flat()
    try:
        model = learn(env)
    finally:
        env.close()
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "network.npz"
    write(file, model)
    print(f"written: {file}")


if __name__ == "__main__":
    main()
