"""Sites: places with a name, and sensors of MuJoCo's that measure there."""

from __future__ import annotations

from typing import Any

import mujoco

from neuros.convert.building import Building, put
from neuros.convert.elements import Element
from neuros.convert.poses import Pose
from neuros.convert.scopes import Link, Scope

_SITE = mujoco.mjtObj.mjOBJ_SITE


def add_frames(building: Building, scope: Scope) -> None:
    """A site for every ``<frame>``: a place with a name, as the tip of a tool."""
    for inner, element in scope.each("frame"):
        if inner.is_world or element.name not in inner.frames or element.name[:1] == "_":
            continue
        link = inner.body(element.name, element)
        if link is not None:
            site = building.body(link).add_site()
            site.name = building.name("site", inner.prefix + element.name, element)
            put(site, inner.pose @ inner.place(element.name, element), link.pose)


def add_site(
    building: Building,
    link: Link,
    element: Element,
    pose: Pose,
    suffix: str = "",
    wanted: str = "",
) -> str:
    """Add a site to a link, where ``pose`` is in the world; returns its name."""
    site = building.body(link).add_site(group=4)
    name = building.name("site", (wanted or f"{link.name}/{element.name}") + suffix, element)
    site.name = name
    put(site, pose, link.pose)
    return name


def add_sensor(building: Building, name: str, kind: Any, site: str, element: Element) -> Any:
    """Add a sensor of MuJoCo's that measures at a site."""
    unique = building.name("sensor", name, element)
    return building.spec.add_sensor(name=unique, type=kind, objtype=_SITE, objname=site)
