"""From whatever the plugin names as its model to a compiled one."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco

from neuros.errors import ModelError
from neuros.ports import NodeContext
from neuros.simulators.mujoco.declarations import SensorDeclaration


def load_spec(node: NodeContext, model: Any) -> tuple[Any, str]:
    """An ``MjSpec`` of our own, and what to call it in messages.

    ``model`` is the path of an MJCF or URDF file, MJCF as text, or an ``MjSpec``, which is copied.
    """
    if isinstance(model, mujoco.MjSpec):
        return model.copy(), f"MjSpec '{model.modelname}'"
    if isinstance(model, str) and model.lstrip().startswith("<"):
        where = f"XML text in {node.description.plugin}"
        return _parsed(lambda: mujoco.MjSpec.from_string(model), where), where
    if isinstance(model, str | Path):
        path = str(node.resolve_path(str(model)))
        return _parsed(lambda: mujoco.MjSpec.from_file(path), path), path
    raise ModelError(
        f"a model is the path of a file, MJCF as text, or a mujoco.MjSpec, "
        f"not a {type(model).__name__}"
    )


def compile_spec(spec: Any, where: str) -> Any:
    """The ``MjModel``; raises ``ModelError`` that starts with ``where``."""
    return _parsed(spec.compile, where)


def prepare_rendering(spec: Any, sensors: Iterable[SensorDeclaration], *, fine: bool) -> None:
    """Make the off-screen buffer large enough for every camera, and cheap unless ``fine``."""
    cameras = [sensor for sensor in sensors if sensor.kind == "camera"]
    buffer = spec.visual.global_
    for camera in cameras:
        buffer.offwidth = max(buffer.offwidth, camera.width)
        buffer.offheight = max(buffer.offheight, camera.height)
    if cameras and not fine:
        spec.visual.quality.offsamples = 0


def attach(spec: Any, child: Any, position: Iterable[float], name: str) -> None:
    """Add ``child`` to the world at ``position`` (metres); its names get the prefix ``name/``."""
    frame = spec.worldbody.add_frame(pos=[float(value) for value in position])
    spec.attach(child, prefix=f"{name}/", frame=frame)


def _parsed(parse: Any, where: str) -> Any:
    try:
        return parse()
    except (ValueError, RuntimeError, TypeError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        raise ModelError(f"{where}: the model does not compile: {text}") from error
