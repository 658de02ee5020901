"""From whatever the plugin names as its model to a compiled one."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco

from neuros.convert.find import Finder, NotFound, finder
from neuros.convert.sdf import convert_sdf
from neuros.convert.urdf import read_urdf
from neuros.errors import DescriptionError, ModelError
from neuros.ports import NodeContext
from neuros.simulators.mujoco.declarations import (
    CommandDeclaration,
    Problems,
    SensorDeclaration,
)
from neuros.simulators.mujoco.drives import add_drive

_DESCRIPTIONS: Mapping[str, Callable[[Path, Finder], Any]] = {
    ".urdf": read_urdf,
    ".sdf": convert_sdf,
    ".world": convert_sdf,
}


def load_spec(node: NodeContext, model: Any) -> tuple[Any, str]:
    """An ``MjSpec`` of our own, and what to call it in messages.

    ``model`` is the path of an MJCF, URDF or SDF file, MJCF as text, or an ``MjSpec``, which is
    copied. What of a URDF or SDF file has no counterpart in MuJoCo is logged as a warning.
    """
    if isinstance(model, mujoco.MjSpec):
        return model.copy(), f"MjSpec '{model.modelname}'"
    if isinstance(model, str) and model.lstrip().startswith("<"):
        where = f"XML text in {node.description.plugin}"
        return _parsed(lambda: mujoco.MjSpec.from_string(model), where), where
    if isinstance(model, str | Path):
        path = _resolve(node, str(model))
        return _from_file(node, path), str(path)
    raise ModelError(
        f"a model is the path of a file, MJCF as text, or a mujoco.MjSpec, "
        f"not a {type(model).__name__}"
    )


def timestep_of(model: Path | str) -> float:
    """The timestep of a model in MJCF, a file or its text, in seconds.

    Raises:
        ValueError: if it is none.
    """
    spec = mujoco.MjSpec.from_file if isinstance(model, Path) else mujoco.MjSpec.from_string
    return float(spec(str(model)).option.timestep)


def _resolve(node: NodeContext, model: str) -> Path:
    """The file, also if it lies in a folder that Gazebo's variables name."""
    try:
        return node.resolve_path(model)
    except ModelError:
        if Path(model).suffix.lower() not in _DESCRIPTIONS:
            raise
        try:
            return _finder(node).find(model, node.description.plugin.parent)
        except NotFound:
            pass
        raise


def _finder(node: NodeContext) -> Finder:
    return finder((), {**os.environ, **node.description.environment})


def _from_file(node: NodeContext, path: Path) -> Any:
    kind = path.suffix.lower()
    if kind == ".xml":
        return _parsed(lambda: mujoco.MjSpec.from_file(str(path)), str(path))
    if kind == ".mjcf":  # MuJoCo goes by the name: it knows .xml only
        spec = _parsed(lambda: mujoco.MjSpec.from_string(path.read_text("utf-8")), str(path))
        spec.modelfiledir = str(path.parent)
        return spec
    if kind not in _DESCRIPTIONS:
        known = ", ".join((".xml", ".mjcf", *_DESCRIPTIONS))
        raise ModelError(f"{path}: a model is a file in MJCF, URDF or SDF ({known})")
    try:
        described = _DESCRIPTIONS[kind](path, _finder(node))
    except DescriptionError as error:
        raise ModelError(str(error)) from error
    if described.not_taken:
        count = sum(note.count for note in described.not_taken)
        rows = "".join(f"\n  {note}" for note in described.not_taken)
        things = "1 thing is" if count == 1 else f"{count} things are"
        node.get_logger().warning(
            f"{path.name}: {things} not taken over, or not as in the file:{rows}"
        )
    return described.spec


def joints_of(spec: Any) -> set[str]:
    """The names of all joints."""
    return {joint.name for joint in spec.joints}


def add_drives(
    spec: Any, joints: Collection[str], commands: Iterable[CommandDeclaration], problems: Problems
) -> None:
    """Add the actuators that the node file declares for some of ``joints``; problems are reported.

    Joints that are missing are found when the commands are bound.
    """
    for command in commands:
        if command.drive is None:
            continue
        for name in command.actuators:
            if name in joints and (fault := add_drive(spec, name, command.drive)):
                problems.add(command.pointer, fault)


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
