"""Rooms like that of ``room.xml``, drawn from a seed, and what the eyes of WhiskEye see in them.

MuJoCo and NumPy; no ROS and no node in here.
"""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from views import averaged

from neuros.simulators.mujoco.cameras import Cameras

ROOM = Path(__file__).parent / "room.xml"
ROBOT = "whiskeye/"
LOOK_AHEAD_RAD = math.pi / 2  # of the gimbal, as the robot holds it
PANEL_M = (0.4, 1.5)  # width of the panels of a wall
PILLARS, TOWERS = 6, 11


def room(seed: int) -> Any:
    """A ``mujoco.MjSpec``: robot, floor and light of ``room.xml``, and cues drawn from the seed."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_file(str(ROOM))
    colours = np.unique([g.rgba for g in spec.worldbody.geoms if g.name != "ground"], axis=0)
    for geom in list(spec.worldbody.geoms):
        if geom.name != "ground":
            spec.delete(geom)

    def add(kind: Any, place: Any, size: Any, angle_rad: float = 0.0) -> None:
        spec.worldbody.add_geom(
            type=kind,
            pos=place,
            size=size,
            quat=[math.cos(angle_rad / 2), 0, 0, math.sin(angle_rad / 2)],
            rgba=colours[rng.integers(len(colours))],
            contype=0,
            conaffinity=2,
            group=1,
        )

    walls_m = rng.uniform(2.5, 3.8, 4)  # east, north, west, south
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    for wall in range(4):
        angle = wall * math.pi / 2
        away, end = walls_m[wall], walls_m[(wall + 1) % 4]
        along = -walls_m[wall - 1]
        while along < end:
            width = min(rng.uniform(*PANEL_M), end - along)
            height, middle = rng.uniform(0.35, 1.2), along + width / 2
            place = away * _direction(angle) + middle * _direction(angle + math.pi / 2)
            add(box, [*place, height], [0.05, width / 2, height], angle)
            along += width
    for number in range(PILLARS):
        angle = math.tau * (number + rng.uniform(0.1, 0.9)) / PILLARS
        height, radius = rng.uniform(0.25, 0.65), rng.uniform(0.15, 0.25)
        add(cylinder, [*(2.3 * _direction(angle)), height], [radius, height, 0])
    for number in range(TOWERS):
        angle = math.tau * (number + rng.uniform(0.1, 0.9)) / TOWERS
        height, width = rng.uniform(2.3, 4.5), rng.uniform(0.5, 1.5)
        add(box, [*(rng.uniform(9, 15) * _direction(angle)), height], [0.1, width, height], angle)
    return spec


class Eyes:
    """Both eyes of the robot in a room, wherever it is put; the robot itself is not drawn.

    Args:
        spec: of the room.
    """

    def __init__(self, spec: Any) -> None:
        spec.visual.quality.offsamples = 0
        self._model = model = spec.compile()
        robot = (model.geom_bodyid != 0).nonzero()[0]
        model.geom_rgba[robot, 3], model.geom_matid[robot] = 0.0, -1
        self._data = mujoco.MjData(model)
        self._data.joint(f"{ROBOT}neck_gmbl").qpos[0] = LOOK_AHEAD_RAD
        self._base = [model.joint(f"{ROBOT}pose_{axis}").qposadr[0] for axis in ("x", "y", "theta")]
        self._eyes = [model.camera(f"{ROBOT}{name}").id for name in ("cam0", "cam1")]
        self._cameras = Cameras(model)

    def see(self, poses: NDArray[np.floating]) -> NDArray[np.float32]:
        """Mean colours, in grey levels from 0 to 255, ``(n, 1152)``.

        Args:
            poses: x and y in metres, heading in radians, ``(n, 3)``.
        """
        return np.array([self._see(pose) for pose in poses], np.float32)

    def recolour(self) -> None:
        """Each cue has the colour of the one before it from now on."""
        cues = (self._model.geom_bodyid == 0) & (self._model.geom_matid < 0)
        self._model.geom_rgba[cues] = np.roll(self._model.geom_rgba[cues], 1, axis=0)

    def close(self) -> None:
        """Free OpenGL."""
        self._cameras.close()

    def _see(self, pose: NDArray[np.floating]) -> NDArray[np.float64]:
        self._data.qpos[self._base] = pose
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        pictures = [np.empty((60, 80, 3), np.uint8) for _ in self._eyes]
        for eye, picture in zip(self._eyes, pictures, strict=True):
            self._cameras.render(self._data, eye, picture)
        return averaged(*(SimpleNamespace(data=p, height=60, width=80) for p in pictures))


def _direction(angle_rad: float) -> NDArray[np.float64]:
    return np.array([math.cos(angle_rad), math.sin(angle_rad)])
