"""What the network is compared with: the nearest of the views, and a linear regression."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

RIDGE = 10.0


def nearest_neighbour(views: Floats, headings_rad: Floats, asked: Floats) -> Floats:
    """For each view the heading of that one of ``views`` which differs least from it, ``(n,)``."""
    distances = np.sum(views**2, axis=1) - 2.0 * asked @ views.T  # but for a term of the asked one
    return headings_rad[np.argmin(distances, axis=1)]


def linear_regression(views: Floats, headings_rad: Floats, asked: Floats) -> Floats:
    """Headings whose sine and cosine are linear in the view, with a small penalty, ``(n,)``."""
    mean = views.mean(axis=0)
    centred = (views - mean).astype(np.float64)
    targets = np.stack([np.cos(headings_rad), np.sin(headings_rad)], axis=1)
    covariance = centred.T @ centred + RIDGE * np.eye(centred.shape[1])
    weights = np.linalg.solve(covariance, centred.T @ (targets - targets.mean(axis=0)))
    cosine, sine = ((asked - mean) @ weights + targets.mean(axis=0)).T
    return np.arctan2(sine, cosine).astype(np.float32)
