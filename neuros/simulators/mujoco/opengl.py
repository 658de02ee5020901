"""Which OpenGL a camera renders with: EGL, else OSMesa; neither needs a display.

It is imported for the first camera: a simulation without any needs none. A user's own choice in
``MUJOCO_GL`` is respected.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from neuros.errors import EnvironmentFault
from neuros.installation.machine import install_opengl, offscreen_opengl

_BACKENDS = ("egl", "osmesa", "glfw")


def choose_opengl() -> str:
    """``"egl"``, ``"osmesa"`` or ``"glfw"``: what ``MUJOCO_GL`` names, else what there is here.

    ``""`` where there is nothing; systems other than Linux have one OpenGL, which GLFW finds.
    """
    if not sys.platform.startswith("linux"):
        return "glfw"
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in _BACKENDS:
        return wanted
    return offscreen_opengl() or ("glfw" if os.environ.get("DISPLAY") else "")


def import_opengl() -> Any:
    """The class of OpenGL contexts: its objects have ``make_current`` and ``free``.

    Raises ``EnvironmentFault`` where there is no OpenGL to render with.
    """
    choice = choose_opengl()
    with opengl_faults():
        # Asked for directly: mujoco.GLContext was fixed when mujoco was imported.
        if choice == "egl":
            from mujoco.egl import GLContext
        elif choice == "osmesa":
            from mujoco.osmesa import GLContext
        elif choice == "glfw":
            from mujoco import GLContext
        else:
            raise ImportError("there is neither EGL with libGL or libGLESv2, nor OSMesa")
    return GLContext


@contextmanager
def opengl_faults() -> Iterator[None]:
    """Turn what PyOpenGL and MuJoCo raise where a library is missing into ``EnvironmentFault``."""
    try:
        yield
    except Exception as error:
        # PyOpenGL takes what it has not found for None, and fails with whatever that leads to.
        text = " ".join(str(error).split())
        chosen = os.environ.get("MUJOCO_GL")
        choice = f", with MUJOCO_GL={chosen}" if chosen else ""
        raise EnvironmentFault(
            f"a camera cannot render: no usable OpenGL{choice} ({text}): {install_opengl()}"
        ) from error
