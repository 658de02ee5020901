"""Renders one small picture, as a camera of a node would, and says with what.

::

    python -m neuros.simulators.mujoco.frame

A program of its own, since a process has one OpenGL. Exit code 4: it cannot, and standard error
says why.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np

from neuros.errors import EnvironmentFault
from neuros.simulators.mujoco.cameras import Cameras
from neuros.simulators.mujoco.opengl import choose_opengl

_WORLD = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="eye" pos="0 0 3"/>
    <geom size="1"/>
  </worldbody>
</mujoco>
"""
_NAMES = {"egl": "EGL", "osmesa": "OSMesa", "glfw": "GLFW"}


def main() -> int:
    model = mujoco.MjModel.from_xml_string(_WORLD)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    image = np.zeros((30, 40, 3), np.uint8)
    cameras = Cameras(model)
    try:
        cameras.render(data, 0, image)
        if not image.any():
            raise EnvironmentFault("a camera cannot render: its picture is black")
        from OpenGL import GL  # the one that has just been chosen

        print(f"{_NAMES[choose_opengl()]} ({GL.glGetString(GL.GL_RENDERER).decode()})")
    except EnvironmentFault as fault:
        print(fault, file=sys.stderr)
        return 4
    finally:
        cameras.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
