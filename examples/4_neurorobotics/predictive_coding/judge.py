"""Compares the estimated heading with the true one, stamp by stamp, and says how far it is off."""

import json
import math
import os

import numpy as np
from view import yaw_of

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise

CHANCE_DEG = 180.0 / math.sqrt(3.0)
"""RMS error of a heading drawn at random: uniform from -180 to 180 degrees."""


@neuros_initialise()
def start(node):
    node.set_user_data([])


# Both are lossless and come in order, one for each picture: the n-th belongs to the n-th.
@neuros_function(inputs=["estimate", "truth"])
def compare(node, estimate, truth):
    stamps = [each.header.stamp for each in (estimate, truth)]
    if stamps[0] != stamps[1]:
        raise ValueError(f"an estimate for {stamps[0]} beside a truth of {stamps[1]}")
    off_rad = math.remainder(estimate.vector.z - yaw_of(truth.pose.orientation), math.tau)
    node.get_user_data().append((math.degrees(off_rad), estimate.vector.x))


@neuros_finalise()
def report(node):
    if not node.get_user_data():
        return
    off_deg, image_error = np.array(node.get_user_data()).T
    found = {
        "views": len(off_deg),
        "rms_deg": float(np.sqrt(np.mean(off_deg**2))),
        "median_deg": float(np.median(np.abs(off_deg))),
        "max_deg": float(np.max(np.abs(off_deg))),
        "chance_deg": CHANCE_DEG,
        "image_error": float(np.mean(image_error)),
    }
    for name, value in found.items():
        node.set_result(name, value)
    (node.run_dir / "heading.json").write_text(json.dumps(found, indent=2) + os.linesep)
    node.get_logger().info(
        f"heading from {found['views']} views: RMS {found['rms_deg']:.2f} deg, "
        f"median {found['median_deg']:.2f} deg, maximum {found['max_deg']:.2f} deg "
        f"(by chance {CHANCE_DEG:.0f} deg); image error {found['image_error']:.3f}"
    )
