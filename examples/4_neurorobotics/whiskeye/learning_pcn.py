"""The predictive coding network goes on learning: views that it does not know yet.

A view whose prediction error is above ``GATE`` is kept, with the heading that the ring tells for
its stamp: nobody else knows it. When there are ``NEW_VIEWS`` of them, the network learns them, and
again the old views that ``weights.npz`` has kept of its training, so that it does not forget.
Every fourth of the new views it does not learn but is tested with, as with the old test views.
The errors before and after are results, and ``learning.json`` in the node's folder of the run. What
it knows at the end is kept: another run goes on from there.
"""

from __future__ import annotations

import json
import os

import numpy as np
from pcn import HOW, Predictor
from views import code_of, heading_of, view_of

from neuros.errors import NodeError
from neuros.hooks import Optional, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds

RATES = (1e-3, 2e-4)  # of learning, first and last epoch: what it knows is not thrown away
TESTED_EVERY = 4


class Learner:
    """Gathers what is new, and learns it beside what is old."""

    def __init__(self):
        self.predictor = None
        self._waiting = None  # (stamp in ns, view) of a view whose heading is not known yet
        self._new = []  # (view, heading in rad)
        self.rounds = []

    def go_on(self, weights):
        """Go on from what has been learnt."""
        self.predictor = Predictor(weights)
        self._old = [weights[name] for name in ("old_views", "old_rad")]
        self._tested = [weights[name] for name in ("test_views", "test_rad")]

    def weights(self):
        """What has been learnt, and what is learnt again beside the next new views."""
        old = dict(zip(("old_views", "old_rad"), self._old, strict=True))
        return {**self.predictor.weights, **self.predictor.network.weights, **old}

    def keep(self, stamp, view):
        self._waiting = stamp, view

    def name(self, stamp, heading_rad):
        """The heading at a stamp; whether there is enough to learn now."""
        if self._waiting and self._waiting[0] == stamp:
            self._new.append((self._waiting[1], heading_rad))
            self._waiting = None
        return len(self._new) == int(os.environ.get("NEW_VIEWS", "200"))

    def learn(self):
        """Learn the new views and the old ones; returns the errors before and after."""
        views = np.array([view for view, _ in self._new])
        headings_rad = np.array([heading for _, heading in self._new], np.float32)
        held = np.arange(len(views)) % TESTED_EVERY == 0
        tests = {"new": (views[held], headings_rad[held]), "old": self._tested}
        before = {name: self._errors(*test) for name, test in tests.items()}
        fresh = (views[~held], headings_rad[~held])
        old = [np.concatenate(pair) for pair in zip(self._old, fresh, strict=True)]
        self._old, self._new = old, []
        codes = np.array([code_of(heading) for heading in old[1]])
        epochs = int(os.environ.get("EPOCHS", "12"))
        for _ in self.predictor.network.learn(old[0].astype(np.float32), codes, epochs, RATES):
            pass
        after = {name: self._errors(*test) for name, test in tests.items()}
        self.rounds.append({"learnt": int((~held).sum()), "before": before, "after": after})
        return before, after

    def _errors(self, views, headings_rad):
        """RMS and median error in degrees, and the median prediction error of the views."""
        codes, errors, _ = self.predictor.network.infer(views.astype(np.float32))
        told_rad = np.array([heading_of(code) for code in codes])
        off_deg = np.abs(np.degrees(np.angle(np.exp(1j * (told_rad - headings_rad)))))
        return {
            "rms_deg": float(np.sqrt(np.mean(off_deg**2))),
            "median_deg": float(np.median(off_deg)),
            "view_error": float(np.median(errors[:, 0])),
        }


@neuros_initialise()
def start(node):
    learner = Learner()
    node.set_user_data(learner)
    node.keep("weights", learner.weights, learner.go_on)
    if learner.predictor is None:
        raise NodeError(HOW)


@neuros_function(
    inputs=["left_eye", "right_eye", "heading"],
    outputs=["odom_correction", Optional("prediction_error"), Optional("predicted_view")],
)
def look(node, left, right, heading):
    learner = node.get_user_data()
    if learner.name(to_nanoseconds(heading), heading.vector.z):
        before, after = learner.learn()
        report(node, learner, before, after)
    packets = learner.predictor.packets(node, left, right)
    if left.height and packets[0].vector.x > float(os.environ.get("GATE", "0.07")):
        learner.keep(to_nanoseconds(left), view_of(left, right))
    return packets


def report(node, learner, before, after):
    """Say what a round of learning has changed."""
    (node.run_dir / "learning.json").write_text(json.dumps(learner.rounds, indent=2) + "\n")
    for name in ("new", "old"):
        first, last = before[name], after[name]
        node.set_result(f"{name}_views_before_deg", first["rms_deg"])
        node.set_result(f"{name}_views_after_deg", last["rms_deg"])
        node.get_logger().info(
            f"{name} views: RMS error {first['rms_deg']:.2f} deg before, "
            f"{last['rms_deg']:.2f} deg after; prediction error {first['view_error']:.3f} before, "
            f"{last['view_error']:.3f} after"
        )
