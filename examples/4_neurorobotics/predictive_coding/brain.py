"""The network as a node: gathers examples, learns them, then tells the heading from pictures."""

from __future__ import annotations

import os
from time import perf_counter

import numpy as np
from network import PredictiveCodingNetwork
from view import CODES, PIXELS, code_of, heading_of, pixels_of, yaw_of

from neuros.hooks import neuros_function, neuros_initialise
from neuros.snn import derive_seed


class Brain:
    """The examples until they are learnt; then the network that has learnt them."""

    def __init__(self, seed):
        self.images, self.codes = [], []
        self._network = PredictiveCodingNetwork(PIXELS, CODES, seed)
        self._mean = None

    @property
    def has_learnt(self):
        return self._mean is not None

    def learn(self, epochs):
        """Mean squared error of the images that it predicts, in the first and the last epoch."""
        images = np.array(self.images)
        self._mean = images.mean(axis=0)
        errors = self._network.learn(images - self._mean, np.array(self.codes), epochs)
        return errors[0], errors[-1]

    def look(self, pixels):
        """The heading in radians, and the mean squared error of the image that goes with it."""
        codes, error = self._network.infer((pixels - self._mean)[None])
        return heading_of(codes[0]), error


@neuros_initialise()
def start(node):
    node.set_user_data(Brain(derive_seed(int(os.environ.get("SEED", "1")), node.name)))


@neuros_function(inputs=["example", "label"])
def gather(node, example, label):
    brain = node.get_user_data()
    brain.images.append(pixels_of(example))
    brain.codes.append(code_of(yaw_of(label.pose.orientation)))


@neuros_function(inputs="view", outputs="estimate")
def look(node, view):
    brain = node.get_user_data()
    if not brain.has_learnt:  # the first picture without a heading: the robot waits meanwhile
        learn(node, brain)
    heading_rad, error = brain.look(pixels_of(view))
    estimate = node.make_packet("estimate")
    estimate.header = view.header
    estimate.vector.x = error
    estimate.vector.z = heading_rad
    return estimate


def learn(node, brain):
    began_s = perf_counter()
    first, last = brain.learn(int(os.environ.get("EPOCHS", "40")))
    node.get_logger().info(
        f"learnt {len(brain.images)} examples in {perf_counter() - began_s:.1f} s: "
        f"image error {first:.3f} -> {last:.3f}"
    )
