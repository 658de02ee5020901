"""The predictive coding network that a run of ``training.json`` has trained, as a node.

For each pair of pictures it sends ``odom_correction``: the heading in ``vector.z`` in radians; in
``vector.x`` the mean squared error of the view that it predicts, by which the receiver judges
whether to trust it; in ``vector.y`` how far the heading is off at such an error, as one standard
deviation in radians, which the training measured at views that it had held out. And it sends
``prediction_error``: ``x``, ``y`` and ``z`` are the mean squared errors of view, first and second
layer; and ``predicted_view``: what it expects to see there, both eyes side by side. For a pair
without pixels the heading is NaN, and there is nothing else: nothing was seen.
"""

from __future__ import annotations

import math
from array import array

from predictive_coding import PredictiveCodingNetwork
from views import heading_of, picture_of, view_of

from neuros.errors import NodeError
from neuros.hooks import Optional, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds

HOW = (
    "it has no weights: train it with training.json, and give it what that has learnt: "
    "--restore pcn.weights=<run folder>/trainer/weights.npz"
)


class Eyes:
    """Pairs the pictures of both eyes by stamp: some may be lost on the way."""

    def __init__(self):
        self._waiting = {}  # {stamp in ns: (eye, picture)}

    def pairs(self, left, right):
        """All pairs that are complete now, oldest first."""
        complete = []
        for eye, picture in enumerate((left, right)):
            stamp = to_nanoseconds(picture)
            other = self._waiting.pop(stamp, None)
            if other is None:
                self._waiting[stamp] = (eye, picture)
            else:
                complete.append((other[1], picture) if eye else (picture, other[1]))
        for stamp in sorted(self._waiting)[:-2]:  # what is older has lost its other half
            del self._waiting[stamp]
        return complete


class Predictor:
    """The network of a training run, and how far a heading is off per prediction error of its view.

    Attributes:
        weights: what ``trainer.py`` has written.
    """

    def __init__(self, weights):
        self.weights = weights
        self.network = PredictiveCodingNetwork.of_weights(weights)
        self._rad_per_error = float(weights["rad_per_error"])

    def packets(self, node, left, right):
        """All outputs for a pair of pictures; of one without pixels ``odom_correction`` alone."""
        correction = node.make_packet("odom_correction")
        correction.header = left.header
        if not left.height:
            correction.vector.x, correction.vector.z = math.inf, math.nan
            return correction, None, None
        codes, errors, predicted = self.network.infer(view_of(left, right)[None])
        correction.vector.x, correction.vector.z = float(errors[0, 0]), heading_of(codes[0])
        correction.vector.y = self._rad_per_error * correction.vector.x
        error = node.make_packet("prediction_error")
        error.header = left.header
        error.vector.x, error.vector.y, error.vector.z = map(float, errors[0])
        pixels = picture_of(predicted[0], left, right)
        view = node.make_packet("predicted_view")
        view.header, view.encoding = left.header, "rgb8"
        view.height, view.width, view.step = *pixels.shape[:2], 3 * pixels.shape[1]
        view.data = array("B", pixels.tobytes())
        return correction, error, view


@neuros_initialise()
def start(node):
    own = {"eyes": Eyes()}
    node.set_user_data(own)
    node.keep(
        "weights",
        lambda: own["predictor"].weights,
        lambda weights: own.update(predictor=Predictor(weights)),
    )
    if "predictor" not in own:
        raise NodeError(HOW)


@neuros_function(
    inputs=["left_eye", "right_eye"],
    outputs=[Optional(name) for name in ("odom_correction", "prediction_error", "predicted_view")],
)
def look(node, left, right):
    own = node.get_user_data()
    pairs = own["eyes"].pairs(left, right)
    return own["predictor"].packets(node, *pairs[-1]) if pairs else None
