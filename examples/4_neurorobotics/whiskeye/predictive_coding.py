"""A predictive coding network in NumPy: it learns what it sees, and where its head points then.

Every layer predicts the one below it, and is corrected by how far its prediction is off::

    view (1152) <- causes (320) <- causes (160) <- causes (80) -> heading code (180)

A generative model: *causes* ``c`` are inferred for each view by descending the energy, half the sum
of squared errors of all predictions ``f(c) W``; then the weights descend the same energy at these
causes, with rates after Adam. Both rules are local: a weight changes by the error it predicts into,
times the cause it predicts from. The read-out of the heading is not local: it is solved in closed
form, a ridge regression over all views that were learnt. While it learns the heading is given, and
is predicted like the view, from the uppermost causes. Afterwards the causes are inferred from the
view alone, and the heading is read off the causes of all layers: where place changes the view as
well, the uppermost ones alone tell it half as exactly.

Rao & Ballard, *Nature Neuroscience* 2, 79 (1999); Dora, Pennartz & Bohte, ICANN (2018); for place
and heading of a robot Struckmeier et al., arXiv:1909.07201 (2019). Written anew, and smaller.
No ROS and no NeuROS in here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

LAYERS = (320, 160, 80)
LEAK = np.float32(0.2)  # slope of the leaky ReLU below 0
STEP, MOMENTUM = np.float32(0.08), np.float32(0.8)  # of inference
DECAY = np.float32(0.01)  # pulls the uppermost causes to 0
START = 0.1  # causes before inference
CODE_WEIGHT = np.float32(0.3)  # of the heading's error against the view's, while learning
LEARNING_STEPS, INFERENCE_STEPS = 30, 60
OUTLIER = np.float32(3 * 1.4826)  # three standard deviations, of errors that are mostly Gaussian
WIDTH_STEPS = 10  # after which the width of the errors of a view is taken anew
READING_PENALTY = 0.03  # on the weights by which the heading is read off
BATCH = 24
LEARNING_RATES = (2e-3, 2e-4)  # first and last epoch, geometric in between


class PredictiveCodingNetwork:
    """Learns pairs of view and code, and then infers the code of a view.

    Args:
        pixels: values per view.
        codes: values per code.
        seed: of the first weights and of the order in which examples are learnt.
    """

    def __init__(self, pixels: int, codes: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        sizes = (pixels, *LAYERS)
        self._down = [self._drawn(*pair) for pair in zip(sizes[1:], sizes, strict=False)]
        self._code = self._drawn(LAYERS[-1], codes)
        self._read = np.zeros((sum(LAYERS) + 1, codes), np.float32)
        self._mean = np.zeros(pixels, np.float32)

    @classmethod
    def of_weights(cls, weights: Mapping[str, Any]) -> PredictiveCodingNetwork:
        """The network that :attr:`weights` were taken from. Raises ``KeyError`` for others."""
        network = cls(*weights["down0"].shape[1:], weights["read"].shape[1], seed=0)
        network._down = [weights[f"down{layer}"] for layer in range(len(LAYERS))]
        network._code, network._read = weights["code"], weights["read"]
        network._mean = weights["mean"]
        return network

    @property
    def weights(self) -> dict[str, Floats]:
        """All that it has learnt, by name."""
        down = {f"down{layer}": weights for layer, weights in enumerate(self._down)}
        return {**down, "code": self._code, "read": self._read, "mean": self._mean}

    def learn(
        self,
        views: Floats,
        codes: Floats,
        epochs: int,
        rates: tuple[float, float] = LEARNING_RATES,
    ) -> Iterator[float]:
        """Learn ``(n, pixels)`` and ``(n, codes)``; yields each epoch's mean squared view error.

        It starts from what has been learnt before, but nothing of that is protected: what is not
        among the views is forgotten.
        """
        self._mean = views.mean(axis=0)
        views = views - self._mean
        adam = Adam([*self._down, self._code])
        first, last = rates
        for epoch in range(epochs):
            rate = first * (last / first) ** (epoch / max(1, epochs - 1))
            order = self._rng.permutation(len(views))
            batches = np.array_split(order, max(1, len(order) // BATCH))
            errors = []
            for some in batches:
                rises, error = self._rises(views[some], codes[some])
                adam.climb(rises, rate)
                errors.append(error)
            yield float(np.mean(errors))
        self._learn_to_read(views, codes)

    @property
    def computed_by(self) -> str:
        """The library, and what it computes on."""
        return "NumPy on the processor"

    def infer(self, views: Floats) -> tuple[Floats, Floats, Floats]:
        """Codes ``(n, codes)`` of views ``(n, pixels)``, errors ``(n, 3)``, and predicted views.

        The errors and the predicted views are those of :meth:`causes`.
        """
        readable, errors, predicted = self.causes(views)
        return readable @ self._read, errors, predicted

    def causes(self, views: Floats, robust: bool = False) -> tuple[Floats, Floats, Floats]:
        """What the heading is read off ``(n, 561)``, errors ``(n, 3)``, and predicted views.

        The errors are the mean squared ones of the view and of the two layers above it: how well
        the network knows what it sees. The first is large for what it never saw. The predicted
        views ``(n, pixels)`` are what it expects to see for the causes that it infers.

        Args:
            views: ``(n, pixels)``.
            robust: whether pixels with errors that are large for this view count less: what is in
                front of the room is not explained by causes of the room.
        """
        layers = self._see(views - self._mean, robust=robust)
        missed = self._errors(layers)
        errors = np.stack([np.mean(np.square(each), axis=1) for each in missed], axis=1)
        return _readable(layers), errors, views - missed[0]

    def _drawn(self, causes: int, predicted: int) -> Floats:
        drawn = self._rng.normal(0.0, 1.0 / np.sqrt(causes), (causes, predicted))
        return drawn.astype(np.float32)

    def _errors(self, layers: list[Floats]) -> list[Floats]:
        """What of each layer the one above does not predict."""
        return [
            below - _active(above) @ weights
            for below, above, weights in zip(layers, layers[1:], self._down, strict=False)
        ]

    def _see(
        self,
        views: Floats,
        codes: Floats | None = None,
        steps: int = INFERENCE_STEPS,
        robust: bool = False,
    ) -> Any:
        """Descend the energy from causes that are all alike, with momentum; view and causes."""
        causes = [np.full((len(views), size), START, np.float32) for size in LAYERS]
        speeds = [np.zeros_like(cause) for cause in causes]
        for step in range(2 * steps if robust else steps):
            errors = self._errors([views, *causes])
            if robust and step >= steps:
                # Student's t in the place of a Gaussian, as wide as most errors of the view are.
                if step % WIDTH_STEPS == 0:
                    width = OUTLIER * np.median(np.abs(errors[0]), axis=1, keepdims=True)
                errors[0] /= 1 + np.square(errors[0] / width)
            for layer, (cause, speed) in enumerate(zip(causes, speeds, strict=True)):
                pull = errors[layer] @ self._down[layer].T
                if layer + 1 == len(causes) and codes is not None:
                    missed = codes - _active(cause) @ self._code
                    pull += CODE_WEIGHT * (missed @ self._code.T)
                pull *= np.where(cause > 0, np.float32(1), LEAK)
                pull -= errors[layer + 1] if layer + 1 < len(causes) else DECAY * cause
                speed *= MOMENTUM
                speed += STEP * pull
            for cause, speed in zip(causes, speeds, strict=True):
                cause += speed
        return [views, *causes]

    def _rises(self, views: Floats, codes: Floats) -> tuple[list[Floats], float]:
        """How fast the energy falls with each weight, at the causes of some views; view error."""
        layers = self._see(views, codes, LEARNING_STEPS)
        errors = self._errors(layers)
        missed = codes - _active(layers[-1]) @ self._code
        rises = [_active(above).T @ e for above, e in zip(layers[1:], errors, strict=True)]
        rises.append(CODE_WEIGHT * (_active(layers[-1]).T @ missed))
        return rises, float(np.mean(np.square(errors[0])))

    def _learn_to_read(self, views: Floats, codes: Floats) -> None:
        """Let the code be predicted from the causes that the view alone brings about."""
        causes = _readable(self._see(views)).astype(np.float64)
        penalty = READING_PENALTY * np.eye(causes.shape[1])
        read = np.linalg.solve(causes.T @ causes + penalty, causes.T @ codes)
        self._read = read.astype(np.float32)


class Adam:
    """Climbs, in place; after Kingma & Ba, "Adam", ICLR (2015), with its usual constants."""

    def __init__(self, weights: list[Floats]) -> None:
        self._weights = weights
        self._means = [np.zeros_like(each) for each in weights]
        self._squares = [np.zeros_like(each) for each in weights]
        self._count = 0

    def climb(self, rises: list[Floats], rate: float) -> None:
        self._count += 1
        step = np.float32(rate * np.sqrt(1 - 0.999**self._count) / (1 - 0.9**self._count))
        for weights, mean, square, rise in zip(
            self._weights, self._means, self._squares, rises, strict=True
        ):
            mean += np.float32(0.1) * (rise - mean)
            square += np.float32(0.001) * (np.square(rise) - square)
            weights += step * mean / (np.sqrt(square) + np.float32(1e-7))


def _readable(layers: list[Floats]) -> Floats:
    """What the heading is read off: the causes of all layers, and a 1 ``(n, 561)``."""
    ones = np.ones((len(layers[0]), 1), np.float32)
    return np.hstack([*(_active(causes) for causes in layers[1:]), ones])


def _active(causes: Floats) -> Floats:
    return np.where(causes > 0, causes, LEAK * causes)
