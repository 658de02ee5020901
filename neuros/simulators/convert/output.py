"""Result of a conversion, and its MJCF file, with the meshes that had to be made beside it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from neuros.simulators.convert.meshes import Triangles
from neuros.simulators.convert.report import NotTaken

MARK = "made by `neuros convert`"
"""Stands in the first line of every file that is written here, and may be overwritten."""


@dataclass(frozen=True)
class Converted:
    """A description as MuJoCo has it.

    Attributes:
        spec: the ``MjSpec``; its meshes have absolute paths.
        not_taken: what of the description it does not have.
        made_meshes: triangles of those meshes that MuJoCo cannot read itself, by their names.
        bodies, joints: how many there are.
    """

    spec: Any
    not_taken: Sequence[NotTaken]
    made_meshes: dict[str, Triangles]
    bodies: int
    joints: int


def write_mjcf(converted: Converted, source: Path, output: Path) -> list[Path]:
    """Write MJCF, what was not taken over as a comment in it; returns all files written.

    Meshes are named relative to the file. It is compiled once more from the disk before it takes
    its name, so that a file that is there works.

    Raises ``OSError``, and ``ValueError`` if MuJoCo does not read what it wrote.
    """
    spec = converted.spec.copy()
    spec.modelfiledir = str(output.resolve().parent)
    folder = Path(spec.modelfiledir)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for mesh in spec.meshes:
        if mesh.name in converted.made_meshes:
            file = folder / f"{output.stem}_meshes" / f"{_file_name(mesh.name)}.obj"
            while file in written:  # names that differ in what no file name has
                file = file.with_stem(f"{file.stem}_")
            _write_obj(file, converted.made_meshes[mesh.name])
            written.append(file)
            mesh.uservert, mesh.userface, mesh.file = [], [], str(file)
        mesh.file = os.path.relpath(mesh.file, folder)
    draft = folder / f".{output.stem}.draft.xml"
    try:
        draft.write_text(_comment(converted, source) + spec.to_xml(), "utf-8")
        mujoco.MjSpec.from_file(str(draft)).compile()
        draft.replace(output)
    finally:
        draft.unlink(missing_ok=True)
    return [output, *written]


def is_ours(file: Path) -> bool:
    """Whether a file was written here."""
    with file.open(encoding="utf-8", errors="replace") as text:
        return MARK in text.readline()


def _comment(converted: Converted, source: Path) -> str:
    lines = [f"{MARK} from {source.name}"]
    if converted.not_taken:
        lines += ["", "Not taken over, or not as it was:"]
        lines += [f"  {note}" for note in converted.not_taken]
    text = "\n".join(lines).replace("--", "- -")
    return f"<!-- {text}\n-->\n"


def _write_obj(file: Path, triangles: Triangles) -> None:
    vertices, faces = triangles
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    file.write_text("\n".join(lines) + "\n", "ascii")


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in name)
