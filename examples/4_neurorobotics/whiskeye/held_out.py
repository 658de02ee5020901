"""Which views the network never learns from: those of some headings, and those of some places.

Headings: 4 degrees of every 24. Places: three discs of 0.2 m, which the robot crosses with all
headings. What is left is learnt. Numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

EVERY_DEG, HELD_DEG = 24.0, 4.0
PLACES_M = ((0.4, 0.2), (-0.3, 0.4), (-0.1, -0.45))
PLACE_RADIUS_M = 0.2

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Split:
    """Masks ``(n,)`` over the views; no view is in two of them.

    Attributes:
        learnt: to learn from.
        headings: at places that are learnt from, at headings that are not.
        places: at places that are not learnt from, at headings that are.
    """

    learnt: Mask
    headings: Mask
    places: Mask


def split(headings_rad: NDArray[np.floating], positions_m: NDArray[np.floating]) -> Split:
    """Split views by headings ``(n,)`` and positions ``(n, 2)``."""
    odd_heading = np.degrees(headings_rad) % EVERY_DEG < HELD_DEG
    away_m = np.linalg.norm(positions_m[:, None] - np.array(PLACES_M), axis=2)
    odd_place = np.any(away_m < PLACE_RADIUS_M, axis=1)
    return Split(~odd_heading & ~odd_place, odd_heading & ~odd_place, odd_place & ~odd_heading)
