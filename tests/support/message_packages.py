"""ROS packages with messages, written for tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

MANIFEST = """\
<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>1.0.0</version>
  <description>A package of a test</description>
  <maintainer email="nobody@example.org">Nobody</maintainer>
  <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
{depends}  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


def write_package(
    workspace: Path, name: str, files: Mapping[str, str], depends: Sequence[str] = ()
) -> Path:
    """Write a package; ``files`` are the texts of its interfaces by their paths in it."""
    folder = workspace / name
    folder.mkdir(parents=True)
    rows = "".join(f"  <depend>{each}</depend>\n" for each in depends)
    (folder / "package.xml").write_text(MANIFEST.format(name=name, depends=rows))
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder


@dataclass(frozen=True)
class CustomMessages:
    """A project with message packages, which are built.

    Attributes:
        environment: of runs that find them built.
        outputs: what two programs printed that were told to build them at the same time.
        pythons: the folder of each package for Python's path, by its name.
    """

    project: Path
    environment: dict[str, str]
    outputs: tuple[str, str]
    pythons: dict[str, Path]
