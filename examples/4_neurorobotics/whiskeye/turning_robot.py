"""What the variants of the robot share: the model, the turn, and when it is over."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

from neuros.simulators.mujoco import MuJoCo

LOOK_AHEAD_RAD = math.pi / 2  # of the gimbal: the two cameras of the head look forward and up


@dataclass(frozen=True)
class TurningRobot:
    """The simulator, and the simulated time after which the run is over, in seconds."""

    sim: MuJoCo
    duration_s: float

    @property
    def is_done(self) -> bool:
        """Whether the simulated time has come (half a step of tolerance for rounding)."""
        return self.sim.sim_time > self.duration_s - self.sim.timestep / 2

    def end(self, node: Any) -> None:
        """End the project, drained."""
        node.shutdown(f"{self.duration_s:g} s simulated")


def start_turning(node: Any) -> TurningRobot:
    """Load the model and set its targets: RATE in rad/s for DURATION in simulated seconds."""
    sim = MuJoCo(node, "whiskeye.xml")
    sim.actuate("pose_theta", float(os.environ.get("RATE", "1.0")))
    sim.actuate("neck_gmbl", LOOK_AHEAD_RAD)
    robot = TurningRobot(sim, float(os.environ.get("DURATION", "20")))
    node.set_user_data(robot)
    return robot
