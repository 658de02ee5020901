"""Walks with and without coupling and touch, and draws it: python study.py [SEEDS]

It writes study.png and study.json into the current folder.
"""

import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import matplotlib
import numpy as np

import neuros

PROJECT = Path(__file__).resolve().parent
STEP_S = 0.02
SECONDS = 12.0
BEGUN_S = 4.0  # what is before does not count
BAND_HZ = 0.4, 4.0
TROT = np.array([0.0, np.pi, 0.0, np.pi])  # the phase of each leg: diagonal ones move together
COUPLING = "nodes.brain.environment.COUPLING_PA"
FEEDBACK = "nodes.brain.environment.FEEDBACK_PA"
COUPLINGS = {"coupled": -8, "not coupled": 0}
FEEDBACKS = {"no touch": 0, "touch is stance": 100, "touch is swing": -100}
CONDITIONS = [(coupling, feedback) for coupling in COUPLINGS for feedback in FEEDBACKS]
SHOWN = CONDITIONS[0], CONDITIONS[3], CONDITIONS[5]


def settings(condition):
    coupling, feedback = condition
    return {COUPLING: COUPLINGS[coupling], FEEDBACK: FEEDBACKS[feedback]}


def run(seed, changes, seconds=SECONDS):
    """Power of the legs (steps, 4) and position of the torso (steps, 3): one session."""
    changes = {**changes, "nodes.body.environment.SECONDS": seconds}
    project = neuros.Project.from_file(PROJECT)
    with project.session(backend="local", seed=seed, set=changes) as session:
        power, position = session.probe("brain.power"), session.probe("body.position")
        while session.step(1000):
            pass
        session.close()
    return power.array(), position.array()


def phases(power):
    """The phase of each leg's rhythm (rad), from the analytic signal within BAND_HZ."""
    spectrum = np.fft.fft(power, axis=0)
    frequencies = np.fft.fftfreq(len(power), STEP_S)
    spectrum[(frequencies < BAND_HZ[0]) | (frequencies > BAND_HZ[1])] = 0.0
    return np.angle(np.fft.ifft(spectrum, axis=0))


def trot(phase):
    """How much it is a trot, 0 to 1: the length of the mean of exp(i (phase - TROT)) over the legs.

    The order parameter of Y. Kuramoto, "Chemical Oscillations, Waves, and Turbulence", 1984. Four
    legs with random phases have 0.45.
    """
    return np.abs(np.exp(1j * (phase - TROT)).mean(1))


def measured(power, position):
    """Trot (0 to 1), frequency (Hz), and speed forwards (m/s), from BEGUN_S on."""
    begun = round(BEGUN_S / STEP_S)
    phase = phases(power)[begun:]
    turns = np.diff(np.unwrap(phase, axis=0), axis=0)
    walked = position[-1, 0] - position[begun, 0]
    return {
        "trot": float(trot(phase).mean()),
        "frequency_hz": float(turns.mean() / (2 * np.pi * STEP_S)),
        "speed_m_s": float(walked / (STEP_S * (len(position) - 1 - begun))),
    }


def measured_run(seed, condition):
    """What :func:`measured` finds, and the phases of the legs."""
    power, position = run(seed, settings(condition))
    return measured(power, position), phases(power)


def interval(values, random):
    """Mean over seeds, and its 95 % interval, from 2000 resamples of seeds."""
    values = np.asarray(values, float)
    means = values[random.integers(0, len(values), (2000, len(values)))].mean(1)
    return [float(values.mean()), *np.quantile(means, [0.025, 0.975]).tolist()]


def study(seeds):
    """What each seed has measured in each condition, and the phases of the first seed.

    Runs are spread over processes: NEST has one kernel in each.
    """
    spawn = multiprocessing.get_context("spawn")
    found, shown = {}, {}
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), spawn) as pool:
        runs = {
            condition: [pool.submit(measured_run, seed, condition) for seed in seeds]
            for condition in CONDITIONS
        }
        for condition, futures in runs.items():
            results = [future.result() for future in futures]
            found[condition] = [measures for measures, _ in results]
            shown[condition] = results[0][1]
            print(*condition, [f"{each['trot']:.2f}" for each in found[condition]], flush=True)
    return found, shown


def draw(found, shown, file):
    matplotlib.use("Agg")
    from matplotlib import pyplot

    random = np.random.default_rng(1)
    figure = pyplot.figure(figsize=(13, 6.5), layout="constrained")
    upper, lower = figure.subfigures(2, 1)
    first = upper.subplots(1, len(SHOWN), sharey=True)
    for axes, condition in zip(first, SHOWN, strict=True):
        phase = shown[condition]
        at = STEP_S * np.arange(len(phase))
        for leg, name in enumerate(("hind left", "hind right", "front right"), 1):
            relative = (np.degrees(phase[:, leg] - phase[:, 0]) + 90) % 360 - 90
            axes.plot(at, relative, ".", markersize=2, label=name)
        axes.set(title=", ".join(condition), xlabel="simulated time / s", ylim=(-90, 270))
        axes.set_yticks(range(-90, 271, 90))
    first[0].set_ylabel("phase after front left / degrees")
    upper.legend(
        *first[0].get_legend_handles_labels(), markerscale=4, ncols=3, loc="outside lower center"
    )
    labels = {"trot": "trot, 0 to 1", "speed_m_s": "speed forwards / m/s"}
    for axes, (key, label) in zip(lower.subplots(1, 2), labels.items(), strict=True):
        for number, condition in enumerate(CONDITIONS):
            values = [each[key] for each in found[condition]]
            mean, low, high = interval(values, random)
            color = "C0" if condition[0] == "coupled" else "C1"
            axes.bar(number, mean, yerr=[[mean - low], [high - mean]], color=color, capsize=4)
            axes.plot(np.full(len(values), number), values, "k.", markersize=4)
        texts = [f"{a}\n{b}".replace(" is ", " is\n") for a, b in CONDITIONS]
        axes.set_xticks(range(len(texts)), texts, fontsize="small")
        axes.set_ylabel(label)
    figure.savefig(file, dpi=100)
    pyplot.close(figure)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    found, shown = study(range(1, count + 1))
    random = np.random.default_rng(1)
    table = {
        ", ".join(condition): {
            key: interval([each[key] for each in runs], random) for key in runs[0]
        }
        for condition, runs in found.items()
    }
    Path("study.json").write_text(json.dumps(table, indent=2))
    for name, measures in table.items():
        texts = [
            f"{key} {m:.2f} ({low:.2f} to {high:.2f})" for key, (m, low, high) in measures.items()
        ]
        print(name, *texts, sep="; ")
    draw(found, shown, "study.png")


if __name__ == "__main__":
    main()
