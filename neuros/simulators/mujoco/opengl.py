"""Which OpenGL a camera renders with: EGL, else OSMesa; neither needs a display.

MuJoCo reads ``MUJOCO_GL`` when it is imported, so :func:`choose_opengl` runs before that. A user's
own choice is respected.
"""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

from neuros.errors import EnvironmentFault

_LIBRARIES = {
    "egl": ("libEGL.so.1",),
    "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),
}


def choose_opengl() -> None:
    """Set ``MUJOCO_GL`` to what this machine has, unless it is set already."""
    if sys.platform.startswith("linux") and not os.environ.get("MUJOCO_GL"):
        backend = _available()
        if backend:
            os.environ["MUJOCO_GL"] = backend


def make_context(width: int, height: int) -> Any:
    """A new OpenGL context that belongs to the calling thread; has ``make_current`` and ``free``.

    Raises ``EnvironmentFault`` where there is no OpenGL to render with.
    """
    choice = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform.startswith("linux") and choice not in ("egl", "osmesa", "glfw"):
        choice = _available()
    try:
        # Asked for directly: a plugin that imported mujoco first has fixed mujoco.GLContext.
        if choice == "egl":
            from mujoco.egl import GLContext
        elif choice == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco import GLContext
        return GLContext(width, height)
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise EnvironmentFault(
            f"a camera cannot render: no usable OpenGL ({error}). Install EGL with software "
            "rendering: apt install libegl1 libgl1-mesa-dri"
        ) from error


def _available() -> str:
    for backend, names in _LIBRARIES.items():
        for name in names:
            try:
                ctypes.CDLL(name)
            except OSError:
                continue
            return backend
    return ""
