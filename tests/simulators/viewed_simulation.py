"""A simulation with NEUROS_GUI=1, for the test of the viewer: a program of its own.

Prints a line whenever its state changes; ends at the end of its input.
"""

from __future__ import annotations

import select
import sys

from simulated_node import WORLD, SimulatedNode, imu

from neuros.simulators.mujoco import MuJoCo

LOOK_S = 0.02


def main() -> None:
    node = SimulatedNode({"imu": imu("turn_imu")}, environment={"NEUROS_GUI": "1"})
    sim = MuJoCo(node, WORLD)
    for warning in node.log.warnings:
        print(warning, flush=True)
    sim.run_asynchronous(1.0)
    before_s, state = -1.0, ""
    while not select.select([sys.stdin], [], [], LOOK_S)[0]:
        new = "standing" if sim.sim_time == before_s else "moving"
        before_s = sim.sim_time
        if new != state:
            state = new
            print(state, flush=True)
    node.close()
    assert not node.failures, node.failures
    print("closed", flush=True)


if __name__ == "__main__":
    main()
