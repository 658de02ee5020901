"""Gathers VIEWS views with their headings, trains the network on most of them, and tests it.

Files in the node's folder of the run: ``weights.npz`` (what ``pcn.py`` takes) and ``training.json``
(seeds, sizes and errors, those of the baselines too). Beside the weights, ``weights.npz`` tells how
much to trust them (``rad_per_error``) and keeps some of the views, for ``learning_pcn.py``.
"""

from __future__ import annotations

import json
import math
import os
from time import perf_counter

import numpy as np
from baselines import linear_regression, nearest_neighbour
from heading_error import yaw_of
from held_out import split
from predictive_coding import PredictiveCodingNetwork
from views import CODES, PIXELS, code_of, heading_of, view_of

from neuros.hooks import neuros_function, neuros_initialise
from neuros.snn import derive_seed

PROGRESS_S = 5.0


class Examples:
    """What has been gathered, and the class of the network that is to learn it.

    Attributes:
        views, headings_rad, positions_m: of each example, in order.
        labels_rad: the headings to learn; left empty: the true ones.
    """

    def __init__(self, network_class=PredictiveCodingNetwork):
        self.network_class = network_class
        self.views, self.headings_rad, self.positions_m = [], [], []
        self.labels_rad = []


@neuros_initialise()
def start(node):
    node.set_user_data(Examples())


@neuros_function(inputs=["left_eye", "right_eye", "label"])
def gather(node, left, right, label):
    examples, wanted = node.get_user_data(), int(os.environ.get("VIEWS", "2400"))
    if len(examples.views) == wanted:  # on its way while the network learnt
        return
    q, position = label.pose.orientation, label.pose.position
    examples.views.append(view_of(left, right))
    examples.headings_rad.append(yaw_of(q.x, q.y, q.z, q.w))
    examples.positions_m.append((position.x, position.y))
    if len(examples.views) == wanted:
        report(node, *train(node, examples))
        node.shutdown(f"{wanted} views learnt")


def train(node, examples):
    """What goes into ``weights.npz``, and the figures that go with it."""
    seed, epochs = int(os.environ.get("SEED", "1")), int(os.environ.get("EPOCHS", "20"))
    views = np.array(examples.views, np.float32)
    headings_rad = np.array(examples.headings_rad, np.float32)
    labels_rad = np.array(examples.labels_rad or examples.headings_rad, np.float32)
    parts = split(headings_rad, np.array(examples.positions_m))
    learnt_views, learnt_rad = views[parts.learnt], labels_rad[parts.learnt]
    codes = np.array([code_of(heading) for heading in learnt_rad])
    network = examples.network_class(PIXELS, CODES, derive_seed(seed, node.name))
    node.get_logger().info(f"learns {len(codes)} views with {network.computed_by}")
    began_s = said_s = perf_counter()
    for epoch, error in enumerate(network.learn(learnt_views, codes, epochs), 1):
        if perf_counter() - said_s > PROGRESS_S or epoch == epochs:
            said_s = perf_counter()
            node.get_logger().info(
                f"epoch {epoch} of {epochs}: view error {error:.3f}, {said_s - began_s:.0f} s"
            )
    figures = {"seed": seed, "epochs": epochs, "computed_by": network.computed_by}
    figures["training_s"] = perf_counter() - began_s
    figures["views"] = {"learnt": int(parts.learnt.sum())}
    squares = []
    for name in ("headings", "places"):
        held = getattr(parts, name)
        figures["views"][name] = int(held.sum())
        found, errors, _ = network.infer(views[held])
        told = {
            "network": np.array([heading_of(code) for code in found]),
            "nearest_neighbour": nearest_neighbour(learnt_views, learnt_rad, views[held]),
            "linear_regression": linear_regression(learnt_views, learnt_rad, views[held]),
        }
        figures[f"held_out_{name}"] = {
            method: accuracy(answers, headings_rad[held]) for method, answers in told.items()
        }
        figures[f"held_out_{name}"]["view_error"] = {
            "median": float(np.median(errors[:, 0])) if held.any() else None,
            "p95": float(np.percentile(errors[:, 0], 95)) if held.any() else None,
        }
        squares.extend((off_rad(told["network"], labels_rad[held]) / errors[:, 0]) ** 2)
    # How far a heading is off grows with the prediction error of its view: see README.md. A robot
    # that has only its own labels knows no better ones.
    rad_per_error = float(np.sqrt(np.mean(squares))) if squares else math.inf
    figures["deg_per_error"] = math.degrees(rad_per_error)
    tested = parts.headings | parts.places
    saved = {
        **network.weights,
        "rad_per_error": rad_per_error,
        "old_views": learnt_views.astype(np.float16),
        "old_rad": learnt_rad,
        "test_views": views[tested].astype(np.float16),
        "test_rad": headings_rad[tested],
    }
    return saved, figures


def off_rad(told_rad, true_rad):
    """Errors in rad, wrapped."""
    return np.angle(np.exp(1j * (told_rad - true_rad)))


def accuracy(told_rad, true_rad):
    """RMS, median and maximum of the absolute error, in degrees; of no views ``None``."""
    if not len(true_rad):
        return {"rms_deg": None, "median_deg": None, "max_deg": None}
    off_deg = np.abs(np.degrees(off_rad(told_rad, true_rad)))
    return {
        "rms_deg": float(np.sqrt(np.mean(off_deg**2))),
        "median_deg": float(np.median(off_deg)),
        "max_deg": float(np.max(off_deg)),
    }


def report(node, saved, figures):
    """Write the files, and say how far the network and the baselines are off."""
    np.savez(node.run_dir / "weights.npz", **saved)
    (node.run_dir / "training.json").write_text(json.dumps(figures, indent=2) + "\n")
    log, sizes = node.get_logger(), figures["views"]
    log.info(f"learnt {sizes['learnt']} views in {figures['training_s']:.0f} s")
    for held in ("headings", "places"):
        found = figures[f"held_out_{held}"]
        methods = {name: each for name, each in found.items() if name != "view_error"}
        for name, each in methods.items():
            node.set_result(f"{held}_{name}_rms_deg", each["rms_deg"])
        rms = ", ".join(
            f"{name.replace('_', ' ')} {shown(each['rms_deg'])}" for name, each in methods.items()
        )
        log.info(f"RMS error at {sizes[held]} views of held-out {held}: {rms}")
    log.info(f"weights: {node.run_dir / 'weights.npz'}")


def shown(value_deg):
    """An error as text."""
    return "unknown" if value_deg is None else f"{value_deg:.2f} deg"
