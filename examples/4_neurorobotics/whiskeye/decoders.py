"""Features of views for one read-out: pixels, random features, a small CNN, and the causes of the
predictive coding network. Each is learnt from the same views; headings are read off by the same
ridge regression, whose penalty the same validation views choose.

NumPy only; no ROS, no node and no simulator in here.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from predictive_coding import Adam, PredictiveCodingNetwork
from views import CODES, HEIGHT, PIXELS, WIDTH, code_of, heading_of

Floats = NDArray[np.float32]

RANDOM = 560  # features, as many as the network has causes
COMPONENTS = 80  # of the views, as many as the network has causes in its uppermost layer
PENALTIES = np.geomspace(1e-3, 1e3, 7)
CHANNELS, HIDDEN = (16, 32), 160
EPOCHS, BATCH, RATES = 15, 24, (2e-3, 2e-4)


class Pixels:
    """The views themselves.

    Its uncertainty besides: how much of a view the main components of all learnt ones miss.
    """

    name = "pixels"

    def __init__(self, views: Floats, codes: Floats, seed: int) -> None:
        self._mean = views.mean(axis=0)
        self._components = np.linalg.svd(views - self._mean, full_matrices=False)[2][:COMPONENTS]

    def look(self, views: Floats) -> tuple[Floats, Floats | None]:
        """What headings are read off, ``(n, features)``, and how new each view is, ``(n,)``.

        New is how much of a view is missed, mean squared; ``None``: not known.
        """
        centred = views - self._mean
        missed = centred - centred @ self._components.T @ self._components
        return views, np.mean(np.square(missed), axis=1)


class RandomFeatures:
    """Random projections of the views, cut off at 0."""

    name = "random features"

    def __init__(self, views: Floats, codes: Floats, seed: int) -> None:
        rng = np.random.default_rng(seed)
        drawn = rng.normal(0.0, 1.0 / np.sqrt(PIXELS), (PIXELS, RANDOM))
        self._weights = drawn.astype(np.float32)
        self._bias = rng.normal(0.0, 0.5, RANDOM).astype(np.float32)

    def look(self, views: Floats) -> tuple[Floats, Floats | None]:
        """As of :class:`Pixels`."""
        return np.maximum(views @ self._weights + self._bias, 0.0), None


class SmallCNN:
    """Two layers of convolutions and one of 160 cells, learnt end to end by Adam.

    Each convolution is cut off at 0, and its maps are averaged over 2 x 2. The read-out has the
    second maps and the cells.
    """

    name = "small CNN"

    def __init__(self, views: Floats, codes: Floats, seed: int) -> None:
        rng = np.random.default_rng(seed)
        first, second = CHANNELS
        self._flat = (HEIGHT // 4) * (WIDTH // 4) * second
        shapes = [(25 * 6, first), (9 * first, second), (self._flat, HIDDEN), (HIDDEN, CODES)]
        self._weights = [
            w
            for rows, columns in shapes
            for w in (
                rng.normal(0.0, np.sqrt(2.0 / rows), (rows, columns)).astype(np.float32),
                np.zeros(columns, np.float32),
            )
        ]
        adam = Adam(self._weights)
        for epoch in range(EPOCHS):
            rate = RATES[0] * (RATES[1] / RATES[0]) ** (epoch / (EPOCHS - 1))
            for some in np.array_split(rng.permutation(len(views)), len(views) // BATCH):
                adam.climb(self._rises(views[some], codes[some]), rate)

    def look(self, views: Floats) -> tuple[Floats, Floats | None]:
        """As of :class:`Pixels`."""
        *_, maps, cells = self._forward(views)
        return np.hstack([maps, cells]), None

    def _forward(self, views: Floats) -> Sequence[Floats]:
        """What each layer has as input, the last maps in a row, and the cells."""
        w1, b1, w2, b2, w3, b3, *_ = self._weights
        picture = views.reshape(-1, 2, HEIGHT, WIDTH, 3).transpose(0, 2, 3, 1, 4)
        patches1 = _patches(picture.reshape(-1, HEIGHT, WIDTH, 6), 5)
        maps1 = np.maximum(patches1 @ w1 + b1, 0)
        patches2 = _patches(_halved(maps1), 3)
        maps2 = np.maximum(patches2 @ w2 + b2, 0)
        flat = _halved(maps2).reshape(-1, self._flat)
        return patches1, maps1, patches2, maps2, flat, np.maximum(flat @ w3 + b3, 0)

    def _rises(self, views: Floats, codes: Floats) -> list[Floats]:
        """How fast the mean squared error falls with each weight."""
        patches1, maps1, patches2, maps2, flat, cells = self._forward(views)
        *_, w2, _, w3, _, w4, b4 = self._weights
        missed = (codes - (cells @ w4 + b4)) / np.float32(len(views))
        to_cells = (missed @ w4.T) * (cells > 0)
        to_flat = (to_cells @ w3.T).reshape(-1, HEIGHT // 4, WIDTH // 4, CHANNELS[1])
        to_maps2 = _doubled(to_flat) * (maps2 > 0)
        to_maps1 = _doubled(_unpatched(to_maps2 @ w2.T, CHANNELS[0], 3)) * (maps1 > 0)
        pairs = ((patches1, to_maps1), (patches2, to_maps2), (flat, to_cells), (cells, missed))
        return [
            rise
            for below, above in pairs
            for rise in (
                below.reshape(-1, below.shape[-1]).T @ above.reshape(-1, above.shape[-1]),
                above.reshape(-1, above.shape[-1]).sum(axis=0),
            )
        ]


class Causes:
    """What the predictive coding network infers, of all layers; new is what it does not predict."""

    name = "predictive coding"

    def __init__(self, views: Floats, codes: Floats, seed: int) -> None:
        self._network = PredictiveCodingNetwork(PIXELS, CODES, seed)
        for _ in self._network.learn(views, codes, EPOCHS):
            pass
        self._is_robust = False

    def robust(self) -> Causes:
        """The same network; pixels with errors that are large for a view count less."""
        other = copy.copy(self)
        other.name, other._is_robust = "predictive coding, robust", True
        return other

    def look(self, views: Floats) -> tuple[Floats, Floats | None]:
        """As of :class:`Pixels`."""
        features, errors, _ = self._network.causes(views, self._is_robust)
        return features, errors[:, 0]


class ReadOut:
    """Ridge regression from features to a bump of 180 cells.

    Args:
        features, codes: of the views that are learnt from, ``(n, features)`` and ``(n, 180)``.
        validation: features and headings (rad) of views by which the penalty is chosen.
    """

    def __init__(self, features: Floats, codes: Floats, validation: tuple[Floats, Floats]) -> None:
        self._scale = float(np.sqrt(np.mean(np.square(features)))) + 1e-12
        rows = self._rows(features)
        gram, towards = rows.T @ rows, rows.T @ codes.astype(np.float64)
        self.rms_deg = np.inf
        for penalty in PENALTIES:
            weights = np.linalg.solve(gram + penalty * np.eye(len(gram)), towards)
            told_rad = headings_of(self._rows(validation[0]) @ weights)
            rms_deg = rms(off_deg(told_rad, validation[1]))
            if rms_deg < self.rms_deg:
                self.rms_deg, self.penalty, self._weights = rms_deg, float(penalty), weights

    def read(self, features: Floats) -> tuple[Floats, Floats]:
        """Headings in rad, and how little the bump looks like one of a heading, each ``(n,)``."""
        codes = self._rows(features) @ self._weights
        told_rad = headings_of(codes)
        bumps = np.array([code_of(heading) for heading in told_rad])
        return told_rad, np.mean(np.square(codes - bumps), axis=1).astype(np.float32)

    def _rows(self, features: Floats) -> NDArray[np.float64]:
        ones = np.ones((len(features), 1))
        return np.hstack([features / self._scale, ones]).astype(np.float64)


def headings_of(codes: NDArray[np.floating]) -> Floats:
    """The headings that codes ``(n, 180)`` stand for, in rad."""
    return np.array([heading_of(code) for code in codes], np.float32)


def off_deg(told_rad: NDArray[np.floating], true_rad: NDArray[np.floating]) -> Floats:
    """Errors in degrees, from -180 to 180."""
    return np.degrees(np.angle(np.exp(1j * (told_rad - true_rad)))).astype(np.float32)


def rms(errors: NDArray[np.floating]) -> float:
    """Root of the mean square; of no errors NaN."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else float("nan")


def _patches(maps: Floats, side: int) -> Floats:
    """The surroundings of each pixel in a row, zeros beyond the margin: ``(n, h, w, side^2 c)``."""
    _, height, width, _ = maps.shape
    padded = np.pad(maps, ((0, 0), *[(side // 2, side // 2)] * 2, (0, 0)))
    return np.concatenate(
        [padded[:, y : y + height, x : x + width] for y in range(side) for x in range(side)], axis=3
    )


def _unpatched(patches: Floats, channels: int, side: int) -> Floats:
    """The adjoint of :func:`_patches`."""
    count, height, width, _ = patches.shape
    half = side // 2
    padded = np.zeros((count, height + 2 * half, width + 2 * half, channels), np.float32)
    parts = np.split(patches, side * side, axis=3)
    for number, part in enumerate(parts):
        y, x = divmod(number, side)
        padded[:, y : y + height, x : x + width] += part
    return padded[:, half : half + height, half : half + width]


def _halved(maps: Floats) -> Floats:
    count, height, width, channels = maps.shape
    return maps.reshape(count, height // 2, 2, width // 2, 2, channels).mean(axis=(2, 4))


def _doubled(rises: Floats) -> Floats:
    """The adjoint of :func:`_halved`."""
    return rises.repeat(2, axis=1).repeat(2, axis=2) / np.float32(4)
