"""What a conversion gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from neuros.convert.meshes import Triangles
from neuros.convert.report import NotTaken


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
