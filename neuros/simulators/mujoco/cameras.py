"""Images of the model's cameras, rendered without a display."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.simulators.mujoco.opengl import import_opengl, opengl_faults

_MAX_GEOMS = 20_000


@dataclass
class _Resources:
    """What OpenGL holds for one model: belongs to the thread that made it."""

    model: Any
    gl: Any
    context: Any
    scene: Any
    option: Any = field(default_factory=mujoco.MjvOption)
    camera: Any = field(default_factory=mujoco.MjvCamera)


class Cameras:
    """Renders a model's cameras; one OpenGL context serves all of them, at all sizes.

    The context is made at the first image, in the thread that asks for it, and must be closed in
    that thread. ``fine`` adds shadows and reflections, which cost about three times as much.
    """

    def __init__(self, model: Any, *, fine: bool = False) -> None:
        self._model = model
        self._fine = fine
        self._resources: _Resources | None = None
        self._pixels: dict[tuple[int, ...], npt.NDArray[np.uint8]] = {}

    def use(self, model: Any) -> None:
        """Render another model from the next image on; any thread that has its turn."""
        self._model = model

    def render(self, data: Any, camera: int, image: npt.NDArray[np.uint8]) -> None:
        """Fill ``image`` with what a camera sees: RGB, shape (height, width, 3), top row first."""
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
        height, width, _ = image.shape
        area = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, held.scene, held.context)
        pixels = self._pixels.get(image.shape)
        if pixels is None:
            pixels = self._pixels[image.shape] = np.empty(image.shape, np.uint8)
        mujoco.mjr_readPixels(pixels, None, area, held.context)
        image[:] = pixels[::-1]  # OpenGL counts rows from the bottom

    def close(self) -> None:
        """Free the OpenGL context; the next image makes a new one."""
        held, self._resources = self._resources, None
        if held is not None:
            held.gl.make_current()
            held.context.free()
            held.gl.free()

    def _open(self) -> _Resources:
        buffer = self._model.vis.global_
        make_context = import_opengl()
        with opengl_faults():
            gl = make_context(buffer.offwidth, buffer.offheight)
            gl.make_current()
            context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        scene = mujoco.MjvScene(self._model, maxgeom=_MAX_GEOMS)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._fine
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._fine
        return _Resources(self._model, gl, context, scene)
