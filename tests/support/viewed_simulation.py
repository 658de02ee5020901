"""A simulation with NEUROS_GUI=1, for the test of the viewer: a program of its own.

Prints a line whenever its state changes; a line of input adds a wall to the world; ends at the end
of its input.
"""

from __future__ import annotations

import select
import sys

from simulated_node import WORLD, SimulatedNode, imu

from neuros.simulators.mujoco import MuJoCo

LOOK_S = 0.02
STANDING_LOOKS = 20
WALL = """<mujoco><worldbody><body name="wall"><geom type="box" size="1 .1 1"/></body></worldbody>
</mujoco>"""


def main() -> None:
    node = SimulatedNode({"imu": imu("turn_imu")}, environment={"NEUROS_GUI": "1"})
    sim = MuJoCo(node, WORLD)
    for warning in node.log.warnings:
        print(warning, flush=True)
    sim.run_asynchronous(1.0)
    before_s, looks, state = -1.0, 0, ""
    while True:
        if select.select([sys.stdin], [], [], LOOK_S)[0]:
            name = sys.stdin.readline().strip()
            if not name:
                break
            sim.spawn_entity(WALL, (0, 5, 1), name)
            print(f"spawned {name}", flush=True)
        if sim.sim_time != before_s:
            before_s, looks, new = sim.sim_time, 0, "moving"
        else:
            looks += 1
            new = "standing" if looks >= STANDING_LOOKS else state
        if new != state:
            state = new
            print(state, flush=True)
    node.close()
    assert not node.failures, node.failures
    print("closed", flush=True)


if __name__ == "__main__":
    main()
