"""Draws both headings and the error with neuros.visualise: no hook waits for the picture.

Nothing is lost, and robot and network are not held up either: compare with `strict.json`, whose
visualiser draws in its hooks.
"""

import math

from heading_error import compare, heading_error, yaw_of

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds
from neuros.visualise import VisualiseLines, VisualiseRotations

TRUTH, ESTIMATE, ERROR = "true heading", "estimate of the network", "error"


class Headings:
    """Both series, {stamp in ns: heading in rad}, and their figures."""

    def __init__(self, node):
        self.truths, self.estimates = {}, {}
        self.angles = VisualiseRotations("WhiskEye: head direction", duration=None, node=node)
        self.angles.add_quaternion(TRUTH, "0.6")
        self.angles.add_radians(ESTIMATE, "C3")
        self.errors = VisualiseLines("error", None, y_label="error (deg)", below=self.angles)
        self.errors.add_line(ERROR)


@neuros_initialise()
def start(node):
    node.set_user_data(Headings(node))


@neuros_function(inputs="truth")
def show_truth(node, pose):
    headings = node.get_user_data()
    q, stamp = pose.pose.orientation, to_nanoseconds(pose)
    headings.truths[stamp] = yaw_of(q.x, q.y, q.z, q.w)
    headings.angles.plot(TRUTH, q, stamp * 1e-9)


@neuros_function(inputs="estimate")
def show_estimate(node, estimate):
    headings = node.get_user_data()
    stamp = to_nanoseconds(estimate)
    headings.estimates[stamp] = estimate.vector.z
    headings.angles.plot(ESTIMATE, estimate.vector.z, stamp * 1e-9)


@neuros_finalise()
def report(node):
    headings = node.get_user_data()
    if headings is None:  # ended before the start
        return
    comparison = compare(headings.estimates, headings.truths)
    for place, time_s in enumerate(comparison.time_s):
        headings.errors.plot(ERROR, math.degrees(comparison.error_rad[place]), time_s)
    error = heading_error(comparison)
    headings.angles.caption(f"RMS {error.rms_deg:.2f} deg" if error.samples else "")
    for name in ("samples", "rms_deg", "max_deg", "gain", "drift_deg_s"):
        node.set_result(name, getattr(error, name))
    node.get_logger().info(f"head-direction error: {error}; picture: {headings.angles.file}")
