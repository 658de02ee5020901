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
SEED = "nodes.chair.environment.SEED"
ERROR = "nodes.chair.environment.ERROR"
SCALE = "nodes.chair.environment.SCALE"
SECONDS = "nodes.chair.environment.SECONDS"
LEARN = "nodes.brain.environment.LEARN"
SLOWEST_MS = "nodes.brain.environment.SLOWEST_MS"
CONDITIONS = {
    "error": {},
    "error inverted": {ERROR: -1},
    "no error": {ERROR: 0},
    "fast granule cells": {SLOWEST_MS: 5},
}
TESTS = {"other turns": {}, "half as fast": {SCALE: 0.5}}
FROZEN = {LEARN: 0, ERROR: 0, SECONDS: 20}
ANOTHER = 1000  # is added to the seed of the chair for turns that were not learnt from
PERCENTS = [10, 20, 50, 100, 200, 500]
LAST = 2  # blocks of 5 s


def run(seed, settings, restore=None):
    """The finished run: one session, in this process."""
    project = neuros.Project.from_file(PROJECT)
    settings = {SEED: seed, "nodes.brain.environment.SEED": seed, **settings}
    with project.session(backend="local", set=settings, restore=restore) as session:
        while session.step(1000):
            pass
        return session.close()


def slips(finished):
    """The slip of each 5 s, as a share of the head's turns."""
    return np.array(finished.node_results["chair"]["slip"])


def interval(values, random):
    """Mean over seeds (the first axis), and its 95 % interval, from 2000 resamples of seeds."""
    values = np.asarray(values, float)
    means = values[random.integers(0, len(values), (2000, len(values)))].mean(1)
    return np.stack([values.mean(0), *np.quantile(means, [0.025, 0.975], axis=0)]).tolist()


def study(seeds):
    """For each condition, the slips of each seed while it learns; for each test, frozen ones."""
    learnt = {name: [] for name in CONDITIONS}
    frozen = {test: {name: [] for name in ("before", *CONDITIONS)} for test in TESTS}
    for seed in seeds:
        for name, settings in {"before": {}, **CONDITIONS}.items():
            restore = None
            if name != "before":
                finished = run(seed, settings)
                learnt[name].append(slips(finished))
                restore = {"brain.weights": finished}
            for test, changes in TESTS.items():
                other = {**settings, **FROZEN, **changes, SEED: seed + ANOTHER}
                frozen[test][name].append(slips(run(seed, other, restore)).mean())
            found = [f"{test} {100 * each[name][-1]:.0f} %" for test, each in frozen.items()]
            print(f"seed {seed}, {name}: {', '.join(found)}", flush=True)
    return learnt, frozen


def draw(learnt, frozen, file):
    matplotlib.use("Agg")
    from matplotlib import pyplot

    random = np.random.default_rng(1)
    figure, (curves, *tests) = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for number, (name, slip) in enumerate(learnt.items()):
        mean, low, high = 100 * np.array(interval(slip, random))
        at_s = 5 * np.arange(len(mean)) + 2.5
        curves.plot(at_s, mean, "o-", label=name, color=f"C{number}")
        curves.fill_between(at_s, low, high, alpha=0.2, color=f"C{number}")
    curves.set(xlabel="simulated time / s", title="learning")
    show_percents(curves)
    curves.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    for axes, (test, of_conditions) in zip(tests, frozen.items(), strict=True):
        for number, (name, slip) in enumerate(of_conditions.items()):
            mean, low, high = 100 * np.array(interval(slip, random))
            color = "grey" if name == "before" else f"C{number - 1}"
            axes.bar(number, mean, yerr=[[mean - low], [high - mean]], color=color, capsize=4)
            axes.plot(np.full(len(slip), number), 100 * np.array(slip), "k.", markersize=4)
        names = [name.replace(" ", "\n") for name in of_conditions]
        axes.set_xticks(range(len(names)), names, fontsize="small")
        show_percents(axes)
        axes.set_title(f"frozen weights, {test}")
    figure.savefig(file, dpi=100)


def show_percents(axes):
    axes.set_yscale("log")
    axes.set_yticks(PERCENTS, PERCENTS)
    axes.minorticks_off()
    axes.set(ylabel="slip / % of the turns", ylim=(PERCENTS[0], PERCENTS[-1]))


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    learnt, frozen = study(range(1, count + 1))
    draw(learnt, frozen, "study.png")
    random = np.random.default_rng(1)
    table = {
        f"{name}, frozen, {test}": interval(slip, random)
        for test, of_conditions in frozen.items()
        for name, slip in of_conditions.items()
    }
    for name, slip in learnt.items():
        table[f"{name}, last {5 * LAST} s"] = interval(np.array(slip)[:, -LAST:].mean(1), random)
    Path("study.json").write_text(json.dumps(table, indent=2))
    for name, (mean, low, high) in table.items():
        print(f"{name}: {100 * mean:.0f} % ({100 * low:.0f} to {100 * high:.0f})")


if __name__ == "__main__":
    main()
