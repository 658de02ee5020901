"""Draws the true heading, those of the ring alone, of vision alone and of the corrected ring.

With neuros.visualise: no hook waits for the picture. Files in the node's folder of the run:
``correction.csv`` (all series, every digit) and ``correction.json`` (the error of each).
"""

import csv
import json
import math
from dataclasses import asdict

from heading_error import compare, heading_error, yaw_of

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds, to_seconds
from neuros.visualise import VisualiseImages, VisualiseLines, VisualiseRing, VisualiseRotations

COLOURS = {"uncorrected": "C0", "vision": "C2", "corrected": "C3"}
NAMES = {"uncorrected": "ring alone", "vision": "vision alone", "corrected": "corrected ring"}
TRUTH, SURPRISE = "true heading", "prediction error of the view"
RING = "bump of the corrected ring"
PREDICTED = "what the network predicts for the left and the right eye"


class Headings:
    """All series, {stamp in ns: heading in rad}, and their figures."""

    def __init__(self, node):
        self.truths = {}
        self.newest_s = 0.0
        self.told = {name: {} for name in NAMES}
        self.angles = VisualiseRotations(
            "WhiskEye: corrected by its eyes", duration=None, node=node
        )
        self.angles.add_quaternion(TRUTH, "0.6")
        for name, colour in COLOURS.items():
            self.angles.add_radians(NAMES[name], colour)
        self.ring = VisualiseRing("bump", duration=None, below=self.angles)
        self.ring.add_ring(RING, COLOURS["corrected"])
        self.surprise = VisualiseLines(SURPRISE, None, y_label="mean square", below=self.angles)
        self.surprise.add_line(SURPRISE)
        self.views = VisualiseImages("predicted view", below=self.angles)
        self.views.add_image(PREDICTED)

    def keep(self, name, packet):
        stamp, heading_rad = to_nanoseconds(packet), packet.vector.z
        if not math.isnan(heading_rad):  # of vision, where there was no picture
            self.told[name][stamp] = heading_rad
            self.angles.plot(NAMES[name], heading_rad, stamp * 1e-9)
            self.newest_s = stamp * 1e-9


@neuros_initialise()
def start(node):
    node.set_user_data(Headings(node))


# One hook per series: none waits for another.
@neuros_function(inputs="truth")
def show_truth(node, pose):
    headings, q, stamp = node.get_user_data(), pose.pose.orientation, to_nanoseconds(pose)
    headings.truths[stamp] = yaw_of(q.x, q.y, q.z, q.w)
    headings.angles.plot(TRUTH, q, stamp * 1e-9)


@neuros_function(inputs="uncorrected")
def show_uncorrected(node, estimate):
    node.get_user_data().keep("uncorrected", estimate)


@neuros_function(inputs="vision")
def show_vision(node, estimate):
    node.get_user_data().keep("vision", estimate)


@neuros_function(inputs="corrected")
def show_corrected(node, estimate):
    node.get_user_data().keep("corrected", estimate)


@neuros_function(inputs="activity")
def show_activity(node, activity):
    headings = node.get_user_data()
    headings.ring.plot(RING, activity.data, headings.newest_s)  # this message has no stamp


@neuros_function(inputs="prediction_error")
def show_prediction_error(node, error):
    node.get_user_data().surprise.plot(SURPRISE, error.vector.x, to_seconds(error))


@neuros_function(inputs="predicted_view")
def show_predicted_view(node, view):
    node.get_user_data().views.plot(PREDICTED, view, to_seconds(view))


@neuros_finalise()
def report(node):
    headings = node.get_user_data()
    if headings is None:  # ended before the start
        return
    found = {}
    for name, told in headings.told.items():
        error = heading_error(compare(told, headings.truths))
        found[name] = asdict(error)
        for figure in ("rms_deg", "max_deg"):
            node.set_result(f"{name}_{figure}", found[name][figure])
        node.get_logger().info(f"{NAMES[name]}: {error}")
    (node.run_dir / "correction.json").write_text(json.dumps(found, indent=2) + "\n")
    write_csv(node.run_dir / "correction.csv", {"truth": headings.truths, **headings.told})


def write_csv(path, series):
    """One row per stamp; repr() keeps every bit, so that two runs can be compared with cmp."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["stamp_ns", *(f"{name}_rad" for name in series)])
        for stamp in sorted(set().union(*series.values())):
            values = (each.get(stamp) for each in series.values())
            rows.writerow([stamp, *("" if value is None else repr(value) for value in values)])
