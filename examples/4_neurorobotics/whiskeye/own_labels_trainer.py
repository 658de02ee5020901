"""Trains from the headings that the ring tells: nobody tells the robot how it really stands.

The ring drifts, so these labels are off, and the more the longer it gathers views. Beside it, a
network with the same first weights learns the same views with their true headings. Both are tested
with the true headings of views that were held out. ``weights.npz`` has what the ring has taught.
"""

from __future__ import annotations

import os

import numpy as np
from heading_error import yaw_of
from trainer import Examples, accuracy, report, shown, train
from views import view_of

from neuros.hooks import neuros_function, neuros_initialise
from neuros.time import to_nanoseconds


class Pairs(Examples):
    """Joins views and the headings that the ring tells for their stamps."""

    def __init__(self):
        super().__init__()
        self.told = {}  # {stamp in ns: heading in rad}, as long as a view of the stamp may come
        self.seen = {}  # {stamp in ns: (view, true heading in rad, position in m)}

    def join(self, wanted):
        """Take what is complete, up to so many views; whether they are all there now."""
        if len(self.views) == wanted:  # on its way while the network learnt
            return False
        for stamp in sorted(self.told.keys() & self.seen.keys()):
            view, heading_rad, position_m = self.seen.pop(stamp)
            self.views.append(view)
            self.headings_rad.append(heading_rad)
            self.positions_m.append(position_m)
            self.labels_rad.append(self.told[stamp])
            self.told = {ns: rad for ns, rad in self.told.items() if ns > stamp}
        return len(self.views) == wanted


@neuros_initialise()
def start(node):
    node.set_user_data(Pairs())


@neuros_function(inputs="estimate")
def keep_heading(node, estimate):
    node.get_user_data().told[to_nanoseconds(estimate)] = estimate.vector.z
    learn_if_complete(node)


@neuros_function(inputs=["left_eye", "right_eye", "label"])
def keep_view(node, left, right, label):
    q, position = label.pose.orientation, label.pose.position
    truth = yaw_of(q.x, q.y, q.z, q.w), (position.x, position.y)
    node.get_user_data().seen[to_nanoseconds(label)] = (view_of(left, right), *truth)
    learn_if_complete(node)


def learn_if_complete(node):
    """Train both networks once all views are there, and end the project."""
    pairs, wanted = node.get_user_data(), int(os.environ.get("VIEWS", "600"))
    if not pairs.join(wanted):
        return
    labels = accuracy(np.array(pairs.labels_rad), np.array(pairs.headings_rad))
    node.set_result("labels_rms_deg", labels["rms_deg"])
    node.get_logger().info(f"RMS error of the labels: {shown(labels['rms_deg'])}")
    saved, figures = train(node, pairs)
    report(node, saved, figures)
    pairs.labels_rad = []
    _, true = train(node, pairs)
    for held in ("headings", "places"):
        rms_deg = true[f"held_out_{held}"]["network"]["rms_deg"]
        node.set_result(f"{held}_truth_rms_deg", rms_deg)
        node.get_logger().info(f"held-out {held}, labels are true: network {shown(rms_deg)}")
    node.shutdown(f"{wanted} views learnt")
