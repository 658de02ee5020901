"""State of a conversion while it builds an ``MjSpec``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.meshes import Meshes
from neuros.simulators.convert.report import Report
from neuros.simulators.convert.scopes import Link
from neuros.simulators.convert.values import Pose


@dataclass
class Building:
    """A model under construction.

    Attributes:
        spec: the ``MjSpec``.
        bodies: its bodies by the id of their links.
        geoms: the geoms made from collisions, by the id of their elements.
        colliding_meshes: the <mesh> of collisions, by the names of their geoms.
        masks: what collisions say that they collide with, by the id of their elements.
        joints: the names of the joints made from a joint, by its name.
    """

    spec: Any
    report: Report
    meshes: Meshes
    bodies: dict[int, Any] = field(default_factory=dict)
    geoms: dict[int, Any] = field(default_factory=dict)
    masks: dict[int, int] = field(default_factory=dict)
    colliding_meshes: dict[str, Element] = field(default_factory=dict)
    joints: dict[str, list[str]] = field(default_factory=dict)
    _names: set[tuple[str, str]] = field(default_factory=lambda: {("body", "world")})

    def body(self, link: Link | None) -> Any:
        """The body of a link; the world without one."""
        return self.spec.worldbody if link is None else self.bodies[id(link)]

    def name(self, sort: str, wanted: str, element: Element | None) -> str:
        """A name that no other element of its sort (geom, site, ...) has; a change is noted."""
        name, number = wanted, 1
        while (sort, name) in self._names:
            number += 1
            name = f"{wanted}_{number}"
        self._names.add((sort, name))
        if number > 1 and element is not None:
            self.report.remark(element, f"called '{name}': the name is taken")
        return name

    def names(self, sort: str) -> set[str]:
        """All names given so far to elements of one sort."""
        return {name for kind, name in self._names if kind == sort}


def put(thing: Any, pose: Pose, seen_from: Pose) -> None:
    """Place an element of the spec whose pose in the world is ``pose``."""
    local = seen_from.inverse() @ pose
    thing.pos, thing.quat = local.position, local.quaternion


def set_first(thing: Any, attribute: str, value: float) -> None:
    """Set a number, or the first of several: MuJoCo 4 made polynomials of some numbers."""
    if np.ndim(getattr(thing, attribute)):
        getattr(thing, attribute)[0] = value
    else:
        setattr(thing, attribute, value)
