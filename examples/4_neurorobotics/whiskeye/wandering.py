"""Where the robot drives and how it turns: a function of a seed, the time and its position.

Numpy only: no ROS, no NeuROS. The base is holonomic: it drives in any direction, whatever its
heading.
"""

from __future__ import annotations

import math

import numpy as np

RADIUS_M = 0.8
ARRIVED_M = 0.05
SHORTEST_TURN_S, LONGEST_TURN_S = 1.0, 4.0


class Wanderer:
    """Drives from point to point in a disc, and turns all the while.

    Args:
        rate_rad_s: of the turn; positive to the left.
        randomise: turn to the other side, or not, at moments drawn from 1 to 4 s.
        speed_m_s: of the drive; 0 stays in place.
        seed: of the points and of the turns.
    """

    def __init__(self, rate_rad_s: float, *, randomise: bool, speed_m_s: float, seed: int) -> None:
        self._rate_rad_s, self._speed_m_s = rate_rad_s, speed_m_s
        # Streams of their own: how long a way takes does not change the turns.
        self._places, self._turns = map(
            np.random.default_rng, np.random.SeedSequence(seed).spawn(2)
        )
        self._goal = self._draw_goal()
        self._until_s = self._draw_turn_s() if randomise else math.inf

    def velocities(self, time_s: float, x_m: float, y_m: float) -> tuple[float, float, float]:
        """Velocities of the base from here on: x and y of the world in m/s, yaw in rad/s."""
        while time_s >= self._until_s:
            self._until_s += self._draw_turn_s()
            self._rate_rad_s *= self._turns.choice([-1.0, 1.0])
        away = self._goal - (x_m, y_m)
        distance_m = math.hypot(*away)
        if distance_m < ARRIVED_M:
            self._goal = self._draw_goal()
            away = self._goal - (x_m, y_m)
            distance_m = math.hypot(*away)
        vx, vy = self._speed_m_s * away / max(distance_m, ARRIVED_M)
        return float(vx), float(vy), float(self._rate_rad_s)

    def _draw_goal(self) -> np.ndarray:
        angle, share = self._places.uniform(0.0, math.tau), self._places.uniform()
        return RADIUS_M * math.sqrt(share) * np.array([math.cos(angle), math.sin(angle)])

    def _draw_turn_s(self) -> float:
        return float(self._turns.uniform(SHORTEST_TURN_S, LONGEST_TURN_S))
