"""SDF and URDF as models of MuJoCo's nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.ports import ModelFormat
from neuros_robots.elements import Finder, NotFound, finder
from neuros_robots.mjcf import Converted
from neuros_robots.sdf import convert_sdf
from neuros_robots.urdf import read_urdf


class _Description(ModelFormat):
    """A format whose files may lie in the folders of Gazebo's variables."""

    def __init__(self, name: str, convert: Callable[[Path, Finder], Converted]) -> None:
        self.name = name
        self._convert = convert

    def find(self, name: str, folder: Path, environ: Mapping[str, str]) -> Path | None:
        try:
            return finder((), environ).find(name, folder)
        except NotFound:
            return None

    def read(self, file: Path, environ: Mapping[str, str]) -> tuple[Any, Sequence[str]]:
        converted = self._convert(file, finder((), environ))
        return converted.spec, [str(note) for note in converted.differences]


URDF = _Description("urdf", read_urdf)
XACRO = _Description("xacro", read_urdf)
SDF = _Description("sdf", convert_sdf)
WORLD = _Description("world", convert_sdf)
