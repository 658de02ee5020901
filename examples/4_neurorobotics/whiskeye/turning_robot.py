"""What the variants of the robot share: the model, the turn, and when it is over."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from neuros.simulators.mujoco import MuJoCo

LOOK_AHEAD_RAD = math.pi / 2  # of the gimbal: the two cameras of the head look forward and up


@dataclass(frozen=True)
class TurningRobot:
    """The simulator, and the simulated time after which the run is over, in seconds.

    Attributes:
        rates_rad_s: yaw rates, each for ``vary_s`` simulated seconds; empty: the rate stays.
    """

    sim: MuJoCo
    duration_s: float
    rates_rad_s: Sequence[float] = ()
    vary_s: float = 0.0

    @property
    def is_done(self) -> bool:
        """Whether the simulated time has come (half a step of tolerance for rounding)."""
        return self.sim.sim_time > self.duration_s - self.sim.timestep / 2

    def turn(self) -> None:
        """Set the rate of this time."""
        if self.rates_rad_s:
            index = int((self.sim.sim_time + self.sim.timestep / 2) / self.vary_s)
            self.sim.actuate("pose_theta", self.rates_rad_s[index % len(self.rates_rad_s)])

    def end(self, node: Any) -> None:
        """End the project, drained."""
        node.shutdown(f"{self.duration_s:g} s simulated")


def start_turning(node: Any) -> TurningRobot:
    """Load the model and set its targets: RATE in rad/s for DURATION in simulated seconds.

    With VARY_SECONDS above 0, a rate between -RATE and RATE, drawn with SEED, for so long each.
    """
    sim = MuJoCo(node, "whiskeye.xml")
    rate_rad_s = float(os.environ.get("RATE", "1.0"))
    duration_s = float(os.environ.get("DURATION", "20"))
    vary_s = float(os.environ.get("VARY_SECONDS", "0"))
    sim.actuate("pose_theta", rate_rad_s)
    sim.actuate("neck_gmbl", LOOK_AHEAD_RAD)
    rates_rad_s: list[float] = []
    if vary_s > 0:
        draw = random.Random(os.environ.get("SEED", "1"))
        count = math.ceil(duration_s / vary_s)
        rates_rad_s = [draw.uniform(-rate_rad_s, rate_rad_s) for _ in range(count)]
    robot = TurningRobot(sim, duration_s, rates_rad_s, vary_s)
    node.set_user_data(robot)
    return robot
