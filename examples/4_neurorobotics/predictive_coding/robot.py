"""The robot: turns in the arena, and shows the network what it sees.

For LEARN_S simulated seconds it sends each picture together with its true heading, as ``example``
and ``label``. Then it turns the other way at another speed and sends pictures alone, as ``view``:
whoever receives them has no means of knowing the heading but to look.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from arena import arena

from neuros.hooks import Optional, neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

LEARN_RATE_RAD_S, TEST_RATE_RAD_S = 1.0, -0.7


@dataclass
class Robot:
    """The simulator, and for how many seconds each part lasts."""

    sim: MuJoCo
    learn_s: float
    test_s: float


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, arena(int(os.environ.get("ARENA_SEED", "1"))))
    sim.actuate("turn", LEARN_RATE_RAD_S)
    learn_s, test_s = (float(os.environ[name]) for name in ("LEARN_S", "TEST_S"))
    node.set_user_data(Robot(sim, learn_s, test_s))


@neuros_function(
    outputs=[Optional("example"), Optional("label"), Optional("view"), Optional("pose")]
)
def turn(node):
    robot = node.get_user_data()
    robot.sim.step_to_next()
    # Both sensors fire together.
    picture, pose = robot.sim.read("view"), robot.sim.read("pose")
    now_s = robot.sim.sim_time
    if now_s < robot.learn_s + robot.sim.timestep / 2:
        return picture, pose, None, None
    robot.sim.actuate("turn", TEST_RATE_RAD_S)
    if now_s > robot.learn_s + robot.test_s - robot.sim.timestep / 2:
        node.shutdown(f"{now_s:g} s simulated")
    return None, None, picture, pose
