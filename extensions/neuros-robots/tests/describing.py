"""Short SDF files for tests, and their conversions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import pytest
from neuros_robots.elements import Finder
from neuros_robots.sdf import Converted, convert_sdf

from neuros.errors import DescriptionError

BOX = "<geometry><box><size>1 2 3</size></box></geometry>"
CUBE = """\
v -1 -1 -1\nv 1 -1 -1\nv -1 1 -1\nv 1 1 -1\nv -1 -1 1\nv 1 -1 1\nv -1 1 1\nv 1 1 1
f 1 3 4\nf 1 4 2\nf 5 6 8\nf 5 8 7\nf 1 2 6\nf 1 6 5\nf 3 7 8\nf 3 8 4\nf 1 5 7\nf 1 7 3
f 2 4 8\nf 2 8 6
"""


class Folder:
    """Where a test writes its files."""

    def __init__(self, path: Path, *search: Path) -> None:
        self.path, self.search = path, search

    def write(self, name: str, text: str) -> Path:
        file = self.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, "utf-8")
        return file

    def convert(self, inside: str, version: str = "1.9") -> Converted:
        """The conversion of what stands in ``<sdf>``."""
        file = self.write("model.sdf", f'<sdf version="{version}">\n{inside}\n</sdf>')
        return convert_sdf(file, Finder(self.search))

    def model(self, inside: str, version: str = "1.9", **attributes: str) -> Any:
        """The compiled model of what stands in one ``<model name="robot">``."""
        more = "".join(f' {key}="{value}"' for key, value in attributes.items())
        text = f'<model name="robot"{more}>\n{inside}\n</model>'
        return self.convert(text, version).spec.compile()

    def problems(self, inside: str) -> list[str]:
        """What is wrong with one ``<model name="robot">``."""
        with pytest.raises(DescriptionError) as caught:
            self.model(inside)
        return [str(problem).partition("model.sdf:")[2] for problem in caught.value.problems]

    def notes(self, inside: str) -> dict[str, str]:
        """What is not taken over of one ``<model name="robot">``: reasons by line and path."""
        converted = self.convert(f'<model name="robot">\n{inside}\n</model>')
        return {
            f"{note.place.rpartition(':')[2]} {note.path.removeprefix('model[robot]/')}": note.why
            for note in converted.differences
        }


def positions(model: Any) -> Any:
    """The state of a model in its initial position, kinematics done."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def link(name: str, inside: str = "", pose: str = "", mass: float = 1) -> str:
    """A link with a proper inertial."""
    placed = f"<pose>{pose}</pose>" if pose else ""
    moments = "<inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia>"
    inertial = f"<inertial><mass>{mass}</mass>{moments}</inertial>"
    return f'<link name="{name}">{placed}{inertial}{inside}</link>'


def joint(
    kind: str, parent: str, child: str, axis: str = "", name: str = "joint", more: str = ""
) -> str:
    axis = f"<axis>{axis}</axis>" if axis else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>'
        f"{axis}{more}</joint>"
    )
