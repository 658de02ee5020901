"""What the robots in the room share: the model, and the way that they take."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from wandering import Wanderer

from neuros.simulators.mujoco import MuJoCo
from neuros.snn import derive_seed

LOOK_AHEAD_RAD = math.pi / 2  # of the gimbal: the two cameras of the head look forward and up
ROBOT = "whiskeye/"  # as room.xml attaches it


class WanderingRobot:
    """WhiskEye in ``room.xml``: RATE, SPEED, SEED and NEUROS_RANDOMISE_DIRECTION of the node.

    After CHANGE_S simulated seconds each cue of the room has the colour of the one before it.

    Args:
        first_way: is added to SEED: with one SEED, training and test take different ways.
    """

    def __init__(self, node: Any, first_way: int = 0) -> None:
        self.sim = MuJoCo(node, "room.xml")
        self.sim.actuate(f"{ROBOT}neck_gmbl", LOOK_AHEAD_RAD)
        self._wanderer = Wanderer(
            float(os.environ.get("RATE", "1.0")),
            randomise=os.environ.get("NEUROS_RANDOMISE_DIRECTION", "0") != "0",
            speed_m_s=float(os.environ.get("SPEED", "0.2")),
            seed=derive_seed(first_way + int(os.environ.get("SEED", "1")), node.name),
        )
        self._change_s = float(os.environ.get("CHANGE_S", "inf"))
        self.steer()

    def steer(self) -> None:
        """Set the velocities of the base for where the robot is now."""
        place = (float(self.sim.data.joint(f"{ROBOT}pose_{axis}").qpos[0]) for axis in "xy")
        velocities = self._wanderer.velocities(self.sim.sim_time, *place)
        for axis, velocity in zip(("x", "y", "theta"), velocities, strict=True):
            self.sim.actuate(f"{ROBOT}pose_{axis}", velocity)
        if self.sim.sim_time >= self._change_s:
            self._change_s = math.inf
            cues = (self.sim.model.geom_bodyid == 0) & (self.sim.model.geom_matid < 0)
            colours = self.sim.model.geom_rgba
            colours[cues] = np.roll(colours[cues], 1, axis=0)
