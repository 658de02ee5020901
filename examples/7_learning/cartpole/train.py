"""Learns to balance the pole, and writes weights.txt for policy.py: python train.py [weights.txt]

The cross-entropy method: try weights drawn from a normal distribution, fit that to the best of
them, and so on. R. Rubinstein and D. Kroese, "The Cross-Entropy Method", 2004.
"""

import sys
from pathlib import Path

import numpy as np
from policy import has_fallen, linear, push

import neuros.gym

HERE = Path(__file__).resolve().parent
POSITION, VELOCITY = "cart.joints.position", "cart.joints.velocity"
STEPS = 500  # 10 s
TRIED, KEPT, GENERATIONS = 16, 4, 15


def make():
    """The environment: cart.joints is observed, and the packets of policy.force are the action."""
    return neuros.gym.make(
        HERE / "project.json",
        action="policy.force",
        observation=[f"{POSITION}[2]", f"{VELOCITY}[2]"],
        reward=lambda: 1.0,
        done=lambda observation: has_fallen(observation[POSITION]),
        model="cart.xml",
        max_episode_steps=STEPS,
    )


def steps_upright(env, weights, seed):
    """Steps until the pole falls, or the episode is over."""
    seen, _ = env.reset(seed=seed)
    for step in range(1, STEPS + 1):
        force = push(linear(weights), seen[POSITION], seen[VELOCITY])
        seen, _, has_ended, is_over, _ = env.step([force])
        if has_ended or is_over:
            return step
    raise AssertionError("max_episode_steps ends each episode")


def learn(env, seed=0):
    """Weights with which none of the best has let the pole fall."""
    random = np.random.default_rng(seed)
    mean, spread = np.zeros(4), np.array([1.0, 5.0, 1.0, 5.0])
    for generation in range(GENERATIONS):
        tried = random.normal(mean, spread, (TRIED, 4))
        scores = [steps_upright(env, weights, generation) for weights in tried]
        best = tried[np.argsort(scores)[-KEPT:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.05
        print(f"generation {generation}: {np.mean(scores):5.1f} steps, the best {max(scores)}")
        if sorted(scores)[-KEPT] == STEPS and steps_upright(env, mean, 1000) == STEPS:
            break
    return mean


def main():
    env = make()
    try:
        weights = learn(env)
    finally:
        env.close()
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "weights.txt"
    np.savetxt(file, weights, "%.4f")
    print(f"{file}: {weights}")


if __name__ == "__main__":
    main()
