"""Images of the model's cameras, rendered without a display by EGL, else by OSMesa.

OpenGL is imported for the first camera: a simulation without any needs none. A user's own choice in
``MUJOCO_GL`` is respected.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.errors import EnvironmentFault
from neuros.installation.machine import install_opengl, offscreen_opengl

_MAX_GEOMS = 20_000
_SMALL_WORLD = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="eye" pos="0 0 3"/>
    <geom size="1"/>
  </worldbody>
</mujoco>
"""
_NAMES = {"egl": "EGL", "osmesa": "OSMesa", "glfw": "GLFW"}


def choose_opengl() -> str:
    """The OpenGL to render with: ``"egl"``, ``"osmesa"``, ``"glfw"``, or ``""`` for none.

    ``MUJOCO_GL`` wins over the libraries found. Systems other than Linux have GLFW's only.
    """
    if not sys.platform.startswith("linux"):
        return "glfw"
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in _NAMES:
        return wanted
    return offscreen_opengl() or ("glfw" if os.environ.get("DISPLAY") else "")


def import_opengl() -> Any:
    """The class of OpenGL contexts: its objects have ``make_current`` and ``free``.

    Raises ``EnvironmentFault`` where there is no OpenGL to render with.
    """
    choice = choose_opengl()
    with _opengl_faults():
        # mujoco.GLContext was fixed when mujoco was imported, so each module is imported here.
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
def _opengl_faults() -> Iterator[None]:
    """Turn the errors of PyOpenGL and MuJoCo about a missing library into ``EnvironmentFault``."""
    try:
        yield
    except Exception as error:
        # PyOpenGL stores None for a library it has not found, and fails later with any error.
        text = " ".join(str(error).split())
        chosen = os.environ.get("MUJOCO_GL")
        choice = f", with MUJOCO_GL={chosen}" if chosen else ""
        raise EnvironmentFault(
            f"a camera cannot render: no usable OpenGL{choice} ({text}): {install_opengl()}"
        ) from error


@dataclass
class _Resources:
    """OpenGL's objects for one model; they belong to the thread that made them."""

    model: Any
    gl: Any
    context: Any
    scene: Any
    option: Any = field(default_factory=mujoco.MjvOption)
    camera: Any = field(default_factory=mujoco.MjvCamera)


class Cameras:
    """Renders a model's cameras; one OpenGL context serves all cameras and sizes.

    The first image makes the context; the same thread must close it. ``fine`` adds shadows and
    reflections, which cost about three times as much.
    """

    def __init__(self, model: Any, *, fine: bool = False) -> None:
        self._model = model
        self._fine = fine
        self._resources: _Resources | None = None
        self._pixels: dict[tuple[int, ...], npt.NDArray[np.uint8]] = {}

    def use(self, model: Any) -> None:
        """Render another model from the next image on; callable from any thread between images."""
        self._model = model

    def render(self, data: Any, camera: int, image: npt.NDArray[np.uint8]) -> None:
        """Fill ``image`` with a camera's picture: RGB, shape (height, width, 3), top row first."""
        height, width, _ = image.shape
        held, area = self._draw(data, camera, width, height)
        pixels = self._pixels.get(image.shape)
        if pixels is None:
            pixels = self._pixels[image.shape] = np.empty(image.shape, np.uint8)
        mujoco.mjr_readPixels(pixels, None, area, held.context)
        image[:] = pixels[::-1]  # OpenGL counts rows from the bottom

    def depth(self, data: Any, camera: int, width: int, height: int) -> npt.NDArray[np.float32]:
        """Metres along the optical axis, shape (height, width), top row first.

        ``inf`` where nothing is in front of the model's far plane, ``-inf`` at its near plane.
        """
        held, area = self._draw(data, camera, width, height)
        read = np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(None, read, area, held.context)
        eye = held.scene.camera[0]
        near, far = float(eye.frustum_near), float(eye.frustum_far)
        # Depth is 1 at the near plane and 0 at the far one, and linear in 1 / distance.
        inverse = read[::-1].astype(np.float64) * (1 / near - 1 / far) + 1 / far
        found = np.where(read[::-1] > 0, 1 / inverse, np.inf)
        return np.where(read[::-1] < 1, found, -np.inf).astype(np.float32)

    def _draw(self, data: Any, camera: int, width: int, height: int) -> tuple[_Resources, Any]:
        if self._resources is not None and self._resources.model is not self._model:
            self.close()
        if self._resources is None:
            self._resources = self._open()
        held = self._resources
        held.gl.make_current()
        held.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        held.camera.fixedcamid = camera
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, held.option, None, held.camera, every, held.scene)
        area = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, held.scene, held.context)
        return held, area

    def close(self) -> None:
        """Free the OpenGL context; the next image opens a new one."""
        held, self._resources = self._resources, None
        if held is not None:
            held.gl.make_current()
            held.context.free()
            held.gl.free()

    def _open(self) -> _Resources:
        buffer = self._model.vis.global_
        make_context = import_opengl()
        with _opengl_faults():
            gl = make_context(buffer.offwidth, buffer.offheight)
            gl.make_current()
            context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        scene = mujoco.MjvScene(self._model, maxgeom=_MAX_GEOMS)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._fine
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._fine
        return _Resources(self._model, gl, context, scene)


def render_one_picture() -> int:
    """Render a small picture in a process of its own, and print the OpenGL that rendered it.

    Returns the exit code: 4 with the reason on standard error if rendering fails.
    """
    model = mujoco.MjModel.from_xml_string(_SMALL_WORLD)
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
