"""The same experiment in one loop without NeuROS: how fast it could be at best.

The same model, network, figure and cadence of the figure as in project.json; what NeuROS adds or
gains (nodes side by side) is the ratio to this. Prints one line of JSON, with the wall time of
each part; ``overlap_bound`` is what could be gained at best by physics beside the network:
(physics + network) / network.

    python floor.py --duration 20 --rate 1 --seed 1
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from head_direction import HeadDirectionNetwork
from heading_error import heading_error, yaw_of
from heading_plot import HeadingPlot

IMU_PERIOD_S = 0.02
FOLDER = Path(__file__).resolve().parent


class OneLoop:
    """Physics, network and figure, one after the other.

    Attributes:
        physics_s, network_s: wall time of these parts so far.
        estimates, truths: headings in rad by stamps in ns.
    """

    def __init__(
        self, model: Any, data: Any, network: HeadDirectionNetwork, plot: HeadingPlot
    ) -> None:
        self._model, self._data, self._network, self._plot = model, data, network, plot
        self._steps = round(IMU_PERIOD_S / model.opt.timestep)
        self._imu, self._velocity = model.site("imu_body").id, np.zeros(6)
        self._body = data.body("body")
        self._stamp_ns = 0
        self.physics_s = self.network_s = 0.0
        self.estimates: dict[int, float] = {}
        self.truths: dict[int, float] = {}

    def cycle(self) -> None:
        """From one reading of the IMU to the next."""
        model, data, velocity = self._model, self._data, self._velocity
        self._stamp_ns += round(IMU_PERIOD_S * 1e9)
        start = time.perf_counter()
        mujoco.mj_step(model, data, self._steps)
        mujoco.mj_forward(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, self._imu, velocity, 1)
        w, x, y, z = self._body.xquat.tolist()
        self.truths[self._stamp_ns] = yaw_of(x, y, z, w)
        self.physics_s += time.perf_counter() - start
        self._plot.redraw_if_due(self.estimates, self.truths)
        start = time.perf_counter()
        self.estimates[self._stamp_ns] = self._network.step(float(velocity[2]), IMU_PERIOD_S)
        self.network_s += time.perf_counter() - start
        self._plot.redraw_if_due(self.estimates, self.truths)


def run(duration_s: float = 20.0, rate_rad_s: float = 1.0, seed: int = 1) -> dict[str, Any]:
    """Simulate; only the loop is timed, not the construction of model, network and figure."""
    model = mujoco.MjModel.from_xml_path(str(FOLDER / "whiskeye.xml"))
    data = mujoco.MjData(model)
    data.actuator("pose_theta").ctrl = rate_rad_s
    data.actuator("neck_gmbl").ctrl = math.pi / 2
    network = HeadDirectionNetwork(seed)
    network.settle()
    plot = HeadingPlot()
    loop = OneLoop(model, data, network, plot)

    start = time.perf_counter()
    for _ in range(round(duration_s / IMU_PERIOD_S)):
        loop.cycle()
    wall_s = time.perf_counter() - start

    return {
        "simulated_s": duration_s,
        "wall_s": wall_s,
        "real_time_factor": duration_s / wall_s,
        "physics_s": loop.physics_s,
        "network_s": loop.network_s,
        "plot_s": wall_s - loop.physics_s - loop.network_s,
        "overlap_bound": (loop.physics_s + loop.network_s) / loop.network_s,
        "redraws": plot.redraws,
        **asdict(heading_error(plot.redraw(loop.estimates, loop.truths))),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=20.0, help="simulated seconds")
    parser.add_argument("--rate", type=float, default=1.0, help="yaw rate in rad/s")
    parser.add_argument("--seed", type=int, default=1, help="of the network")
    arguments = parser.parse_args()
    print(json.dumps(run(arguments.duration, arguments.rate, arguments.seed)))


if __name__ == "__main__":
    main()
