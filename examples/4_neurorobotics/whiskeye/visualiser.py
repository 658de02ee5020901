"""Draws the estimated and the true heading while they arrive; tells the error at the end.

Files in the node's folder of the run: head_direction.png, .csv (both series, every digit), .json.
One hook per series: neither waits for the other, and what is kept does not depend on their order.
"""

import csv
import json
import os
from dataclasses import asdict

from heading_error import heading_error, yaw_of
from heading_plot import HeadingPlot

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds


class Headings:
    """Both series, {stamp in ns: heading in rad}, and their picture."""

    def __init__(self, plot):
        self.estimates = {}
        self.truths = {}
        self.plot = plot

    def redraw_if_due(self):
        self.plot.redraw_if_due(self.estimates, self.truths)


@neuros_initialise()
def start(node):
    every_packet = os.environ.get("REDRAW_EVERY_PACKET", "0") != "0"
    plot = HeadingPlot(every_time=every_packet)
    if plot.remark:
        node.get_logger().warning(plot.remark)
    node.set_user_data(Headings(plot))


@neuros_function(inputs="estimate")
def keep_estimate(node, estimate):
    headings = node.get_user_data()
    headings.estimates[to_nanoseconds(estimate)] = estimate.vector.z
    headings.redraw_if_due()


@neuros_function(inputs="truth")
def keep_truth(node, pose):
    headings = node.get_user_data()
    q = pose.pose.orientation
    headings.truths[to_nanoseconds(pose)] = yaw_of(q.x, q.y, q.z, q.w)
    headings.redraw_if_due()


@neuros_finalise()
def report(node):
    headings = node.get_user_data()
    if headings is None:  # ended before the start
        return
    error = heading_error(headings.plot.redraw(headings.estimates, headings.truths))
    write_csv(node.run_dir / "head_direction.csv", headings.estimates, headings.truths)
    for name, value in asdict(error).items():
        node.set_result(name, value)
    counts = {"estimates": len(headings.estimates), "truths": len(headings.truths)}
    result = {**asdict(error), **counts}
    (node.run_dir / "head_direction.json").write_text(json.dumps(result, indent=2) + "\n")
    picture = node.run_dir / "head_direction.png"
    headings.plot.save(picture, str(error))
    headings.plot.close()
    node.get_logger().info(f"head-direction error: {error}; picture: {picture}")


def write_csv(path, estimates, truths):
    """One row per stamp; repr() keeps every bit, so that two runs can be compared with cmp."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["stamp_ns", "estimate_rad", "truth_rad"])
        for stamp in sorted({*estimates, *truths}):
            pair = (series.get(stamp) for series in (estimates, truths))
            rows.writerow([stamp, *("" if value is None else repr(value) for value in pair)])
