"""A behaviour: remember a heading, drive, turn away from walls by touch, and turn back to it.

What it knows is the heading that it is told and what its whiskers feel; nothing of the room.
NumPy only: no ROS, no NeuROS.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from enum import Enum

import numpy as np

TOUCH_N = 0.01
STAND_S = 1.0
MEAN_OF = 10  # estimates: one of them scatters by 1 to 2 degrees
BACK_OFF_S = 0.6
TURN_RAD_S = 1.0
TURN_AWAY_S = (1.2, 2.2)
GAIN_PER_S = 2.0
SLOWEST_RAD_S = 0.1  # the ring's bump sticks where it is at less than 0.07 rad/s
ARRIVED_RAD = math.radians(1.0)
GIVE_UP_S = 15.0


class Phase(Enum):
    """What the robot is doing. The first two are over once a heading is remembered."""

    TURN_FIRST = "turns to where it starts"
    REMEMBER = "stands and remembers its heading"
    DRIVE = "drives ahead"
    BACK_OFF = "backs off from a wall"
    TURN_AWAY = "turns away"
    RETURN = "turns back to the remembered heading"
    STAND = "stands"
    DONE = "is done"


class Homing:
    """Drives until it has met a number of walls, and turns back then.

    Args:
        walls: how many are met.
        speed_m_s: of the drive.
        seed: of the first turn, and of how long it turns away from each wall.

    Attributes:
        phase: what it is doing.
        remembered_rad: the heading to turn back to; ``None`` before there is one.
        walls_met: so far.
    """

    def __init__(self, walls: int, speed_m_s: float, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._walls, self._speed_m_s = walls, speed_m_s
        self._recent: deque[float] = deque(maxlen=MEAN_OF)
        self._turn_rad_s = TURN_RAD_S * float(self._random.choice([-1.0, 1.0]))
        self.remembered_rad: float | None = None
        self.walls_met = 0
        self._enter(Phase.TURN_FIRST, float(self._random.uniform(0.5, 2.5)))

    def step(
        self, heading_rad: float, touch_n: Sequence[float], duration_s: float
    ) -> tuple[float, float]:
        """Speed ahead in m/s and yaw rate in rad/s for the next ``duration_s``.

        ``touch_n`` are the forces on the whiskers, first those of the right side, then as many of
        the left one.
        """
        self._recent.append(heading_rad)
        self._left_s -= duration_s
        match self.phase:
            case Phase.DRIVE if max(touch_n) > TOUCH_N:
                self._meet_wall(touch_n)
            case Phase.RETURN if abs(self._off_rad()) < ARRIVED_RAD:
                self._enter(Phase.STAND, STAND_S)
        if self._left_s < duration_s / 2:
            self._go_on()
        return self._velocities()

    def _meet_wall(self, touch_n: Sequence[float]) -> None:
        """Turn to the side that feels less."""
        right_n, left_n = np.sum(np.reshape(touch_n, (2, -1)), axis=1)
        self._turn_rad_s = TURN_RAD_S if right_n > left_n else -TURN_RAD_S
        self.walls_met += 1
        self._enter(Phase.BACK_OFF, BACK_OFF_S)

    def _go_on(self) -> None:
        """What follows when the time of a phase is over."""
        match self.phase:
            case Phase.TURN_FIRST:
                self._enter(Phase.REMEMBER, STAND_S)
            case Phase.REMEMBER:
                self.remembered_rad = self._heading_rad()
                self._enter(Phase.DRIVE)
            case Phase.BACK_OFF:
                self._enter(Phase.TURN_AWAY, float(self._random.uniform(*TURN_AWAY_S)))
            case Phase.TURN_AWAY if self.walls_met < self._walls:
                self._enter(Phase.DRIVE)
            case Phase.TURN_AWAY:
                self._enter(Phase.RETURN, GIVE_UP_S)
            case Phase.RETURN:
                self._enter(Phase.STAND, STAND_S)
            case Phase.STAND:
                self._enter(Phase.DONE)

    def _enter(self, phase: Phase, duration_s: float = math.inf) -> None:
        self.phase, self._left_s = phase, duration_s

    def _velocities(self) -> tuple[float, float]:
        match self.phase:
            case Phase.DRIVE:
                return self._speed_m_s, 0.0
            case Phase.BACK_OFF:
                return -self._speed_m_s, 0.0
            case Phase.TURN_FIRST | Phase.TURN_AWAY:
                return 0.0, self._turn_rad_s
            case Phase.RETURN:
                off_rad = self._off_rad()
                rate_rad_s = min(max(GAIN_PER_S * abs(off_rad), SLOWEST_RAD_S), TURN_RAD_S)
                return 0.0, math.copysign(rate_rad_s, off_rad)
            case _:
                return 0.0, 0.0

    def _heading_rad(self) -> float:
        """The mean of the latest estimates, which may lie on both sides of 180 degrees."""
        return float(np.angle(np.exp(1j * np.array(self._recent)).sum()))

    def _off_rad(self) -> float:
        """From here to the remembered heading, the shorter way."""
        assert self.remembered_rad is not None
        return math.remainder(self.remembered_rad - self._heading_rad(), math.tau)
