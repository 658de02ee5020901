"""Learns with several seeds and controls, tests what was learnt, draws it: python study.py [SEEDS]

It writes study.png and study.json into the current folder.
"""

import json
import sys
from pathlib import Path

import matplotlib
import numpy as np

import neuros

PROJECT = Path(__file__).resolve().parent
REWARD = "nodes.teacher.environment.REWARD"
LEARN = "nodes.brain.environment.LEARN"
EXPECT_S = "nodes.brain.environment.EXPECT_S"
CONDITIONS = {
    "reward": {},
    "reward inverted": {REWARD: -1},
    "no reward": {REWARD: 0},
    "nothing is expected": {EXPECT_S: "inf"},
}
FROZEN = {LEARN: 0, REWARD: 0}
ANOTHER = 1000  # is added to a seed for lamps and noise that were not learnt from
LAST = 10


def run(seed, settings, restore=None):
    """The finished run: one session, in this process."""
    project = neuros.Project.from_file(PROJECT)
    with project.session(backend="local", seed=seed, set=settings, restore=restore) as session:
        weights = session.probe("brain.weights")
        while session.step(1000):
            pass
        finished = session.close()
    return finished, weights.array()


def towards(finished):
    """Whether each episode has ended with a look towards the lamp."""
    return np.array(finished.node_results["teacher"]["towards"], float)


def interval(values, random):
    """Mean over seeds (the first axis), and its 95 % interval, from 2000 resamples of seeds."""
    values = np.asarray(values, float)
    means = values[random.integers(0, len(values), (2000, len(values)))].mean(1)
    return np.stack([values.mean(0), *np.quantile(means, [0.025, 0.975], axis=0)]).tolist()


def study(seeds):
    """For each condition, the episodes of each seed; weights over time; shares with frozen ones."""
    learnt = {name: [] for name in CONDITIONS}
    frozen = {"before": [], **{name: [] for name in CONDITIONS}}
    weights = []
    for seed in seeds:
        naive, _ = run(seed + ANOTHER, FROZEN)
        frozen["before"].append(towards(naive).mean())
        for name, settings in CONDITIONS.items():
            finished, over_time = run(seed, settings)
            tested, _ = run(seed + ANOTHER, FROZEN, restore={"brain.weights": finished})
            learnt[name].append(towards(finished))
            frozen[name].append(towards(tested).mean())
            if name == "reward":
                weights.append(over_time)
            last, test = 100 * learnt[name][-1][-LAST:].mean(), 100 * frozen[name][-1]
            print(f"seed {seed}, {name}: the last {LAST} {last:.0f} %, frozen {test:.0f} %")
    return learnt, frozen, np.array(weights)


def draw(learnt, frozen, weights, file):
    matplotlib.use("Agg")
    from matplotlib import pyplot

    random = np.random.default_rng(1)
    figure, (curves, growth, tests) = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for number, (name, episodes) in enumerate(learnt.items()):
        blocks = np.array(episodes).reshape(len(episodes), -1, 5).mean(2)  # of five episodes each
        mean, low, high = 100 * np.array(interval(blocks, random))
        at = 5 * np.arange(len(mean)) + 3
        curves.plot(at, mean, "o-", label=name, color=f"C{number}")
        curves.fill_between(at, low, high, alpha=0.2, color=f"C{number}")
    curves.set(xlabel="episode", ylabel="to the lamp / %", ylim=(-3, 103), title="learning")
    curves.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    cells = weights.shape[2] // 2
    means = weights.reshape(*weights.shape[:2], 2, cells, 2, cells).mean((3, 5))
    for crossed, name in ((True, "to the motor across"), (False, "to the motor of its side")):
        sides = [(0, 1), (1, 0)] if crossed else [(0, 0), (1, 1)]
        mean, low, high = interval(np.mean([means[:, :, a, b] for a, b in sides], axis=0), random)
        (line,) = growth.plot(1 + np.arange(len(mean)), mean, label=name)
        growth.fill_between(1 + np.arange(len(mean)), low, high, alpha=0.2, color=line.get_color())
    growth.set(xlabel="simulated time / s", ylabel="weight / pA", title="weights, with reward")
    growth.legend(fontsize="small")
    for number, (name, shares) in enumerate(frozen.items()):
        mean, low, high = 100 * np.array(interval(shares, random))
        color = "grey" if name == "before" else f"C{number - 1}"
        tests.bar(number, mean, yerr=[[mean - low], [high - mean]], color=color, capsize=4)
        tests.plot(np.full(len(shares), number), 100 * np.array(shares), "k.", markersize=4)
    names = [name.replace(" ", "\n") for name in frozen]
    tests.set_xticks(range(len(names)), names, fontsize="small")
    tests.set(ylabel="to the lamp / %", ylim=(-3, 103), title="frozen weights, other lamps")
    figure.savefig(file, dpi=100)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    learnt, frozen, weights = study(range(1, count + 1))
    draw(learnt, frozen, weights, "study.png")
    random = np.random.default_rng(1)
    table = {f"{name}, frozen": interval(shares, random) for name, shares in frozen.items()}
    for name, episodes in learnt.items():
        table[f"{name}, last {LAST}"] = interval(np.array(episodes)[:, -LAST:].mean(1), random)
    Path("study.json").write_text(json.dumps(table, indent=2))
    for name, (mean, low, high) in table.items():
        print(f"{name}: {100 * mean:.0f} % ({100 * low:.0f} to {100 * high:.0f})")


if __name__ == "__main__":
    main()
