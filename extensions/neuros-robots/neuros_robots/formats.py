"""SDF and URDF as models of MuJoCo's nodes, and robots in any format as projects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.errors import DescriptionError, Problem
from neuros.ports import ModelFormat, RobotChoices
from neuros_robots.elements import Finder, NotFound, Report, finder, parse
from neuros_robots.mjcf import Converted, read_mjcf
from neuros_robots.project import make_project
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

    def make_project(
        self, file: Path, folder: Path, environ: Mapping[str, str], choices: RobotChoices
    ) -> Sequence[str]:
        converted = self._convert(file, finder((), environ))
        return make_project(converted, file, folder, choices)


def _from_xml(file: Path, finder: Finder) -> Converted:
    """A robot in MJCF, or in a description under the name of XML."""
    root = parse(file, Report())
    if isinstance(root, Problem):
        raise DescriptionError([root])
    convert = {"mujoco": read_mjcf, "robot": read_urdf, "sdf": convert_sdf}.get(root.tag)
    if convert is None:
        root.problem(f"a robot is <mujoco>, <robot> (URDF) or <sdf>, not <{root.tag}>")
        root.report.raise_any()
    assert convert is not None
    return convert(file, finder)


XML = _Description("xml", _from_xml)
MJCF = _Description("mjcf", _from_xml)
URDF = _Description("urdf", read_urdf)
XACRO = _Description("xacro", read_urdf)
SDF = _Description("sdf", convert_sdf)
WORLD = _Description("world", convert_sdf)
