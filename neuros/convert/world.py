"""A world: gravity, time step, magnetic field and lights."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from neuros.convert.building import Building
from neuros.convert.elements import Element
from neuros.convert.materials import light_colour
from neuros.convert.numbers import is_true, number, vector
from neuros.convert.poses import Pose
from neuros.convert.scopes import Link, Scope

_GRAVITY = (0.0, 0.0, -9.8)
_MAGNETIC_FIELD_T = (5.5645e-6, 22.8758e-6, -42.3884e-6)
_TYPES = mujoco.mjtLightType
_LIGHTS = {
    "directional": _TYPES.mjLIGHT_DIRECTIONAL,
    "point": _TYPES.mjLIGHT_POINT,
    "spot": _TYPES.mjLIGHT_SPOT,
}


def read_world(building: Building, scope: Scope) -> None:
    """Options of the whole model, from a ``<world>``, with SDF's defaults."""
    world, report, option = scope.element, building.report, building.spec.option
    option.gravity = vector(world, "gravity", report, _GRAVITY)
    option.magnetic = vector(world, "magnetic_field", report, _MAGNETIC_FIELD_T)
    engines = world.each("physics")
    for unused in engines[1:]:
        report.note(unused, "the first <physics> counts")
    if engines:
        option.timestep = number(engines[0], "max_step_size", report, 0.001, positive=True)
    else:
        option.timestep = 0.001


def add_lights(building: Building, scope: Scope) -> None:
    """Lights of a world, of models and of links."""
    for inner in scope.and_models():
        for element in inner.element.each("light"):
            _add_light(building, element, inner.read_pose(element, inner.pose), None)
        for link in inner.links.values():
            for element in link.element.each("light"):
                _add_light(building, element, inner.read_pose(element, link.pose), link)


def _add_light(building: Building, element: Element, pose: Pose, link: Link | None) -> None:
    report, kind = building.report, element.attributes.get("type", "point")
    if kind not in _LIGHTS:
        report.problem(element, f"'{kind}' is not a light", f"there are: {', '.join(_LIGHTS)}")
        return
    seen_from = Pose() if link is None else link.pose
    local = seen_from.inverse() @ pose
    light: Any = building.body(link).add_light(pos=local.position, type=_LIGHTS[kind])
    light.name = building.name("light", element.name, element)
    direction = np.array(vector(element, "direction", report, (0.0, 0.0, -1.0)))
    if direction.any():
        light.dir = local.rotation @ (direction / np.linalg.norm(direction))
    light.diffuse = light_colour(element, "diffuse", report, 1.0)
    light.specular = light_colour(element, "specular", report, 0.1)
    light.castshadow = is_true(element, "cast_shadows", report, default=False)
    _read_attenuation(building, element, light)
    spot = element.child("spot")
    if spot is not None and kind == "spot":
        light.cutoff = math.degrees(number(spot, "outer_angle", report, 0.0)) or 45.0
        light.exponent = number(spot, "falloff", report, 0.0)


def _read_attenuation(building: Building, element: Element, light: Any) -> None:
    attenuation = element.child("attenuation")
    if attenuation is None:
        return
    names = ("constant", "linear", "quadratic")
    light.attenuation = [
        number(attenuation, name, building.report, default)
        for name, default in zip(names, (1.0, 0.0, 0.0), strict=True)
    ]
    light.range = number(attenuation, "range", building.report, 10.0, positive=True)
