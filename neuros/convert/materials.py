"""Colours of visuals."""

from __future__ import annotations

from collections.abc import Mapping

from neuros.convert.elements import Element
from neuros.convert.numbers import number, vector
from neuros.convert.report import Report

_GREY = (0.7, 0.7, 0.7, 1.0)

# The diffuse colours of Gazebo's own materials, as far as a colour is all that they are.
_SCRIPTS: Mapping[str, tuple[float, float, float]] = {
    "Gazebo/Black": (0, 0, 0),
    "Gazebo/Blue": (0, 0, 1),
    "Gazebo/DarkGray": (0.175, 0.175, 0.175),
    "Gazebo/DarkGrey": (0.175, 0.175, 0.175),
    "Gazebo/FlatBlack": (0.1, 0.1, 0.1),
    "Gazebo/Gray": (0.7, 0.7, 0.7),
    "Gazebo/Green": (0, 1, 0),
    "Gazebo/Grey": (0.7, 0.7, 0.7),
    "Gazebo/Indigo": (0.33, 0, 0.5),
    "Gazebo/Orange": (1, 0.5088, 0.0468),
    "Gazebo/Purple": (1, 0, 1),
    "Gazebo/Red": (1, 0, 0),
    "Gazebo/Turquoise": (0, 1, 1),
    "Gazebo/White": (1, 1, 1),
    "Gazebo/Yellow": (1, 1, 0),
}


def colour(visual: Element, report: Report) -> tuple[float, ...]:
    """Red, green, blue and opacity of a visual, each from 0 to 1."""
    opacity = 1.0 - number(visual, "transparency", report, 0.0)
    material = visual.child("material")
    red, green, blue, alpha = _GREY if material is None else _diffuse(material, report)
    return (red, green, blue, alpha * opacity)


def _diffuse(material: Element, report: Report) -> tuple[float, ...]:
    script = material.child("script")
    name = None if script is None else script.child("name")
    base = _GREY
    if script is not None:
        if name is not None and name.text in _SCRIPTS:
            script.take_all()
            base = (*_SCRIPTS[name.text], 1.0)
        else:
            report.note(script, "a material script of Gazebo's")
    element = material.child("diffuse")
    if element is None:
        return base
    values = [float(word) for word in element.text.split() if _is_number(word)]
    if len(values) not in (3, 4) or len(values) != len(element.text.split()):
        report.problem(element, "a colour is red, green, blue and opacity, each from 0 to 1")
        return base
    return (*values, 1.0)[:4]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def light_colour(owner: Element, tag: str, report: Report, default: float) -> tuple[float, ...]:
    """Red, green and blue of a light."""
    element = owner.child(tag)
    if element is None:
        return (default,) * 3
    if len(element.text.split()) == 3:
        return vector(owner, tag, report, (default,) * 3)
    return vector(owner, tag, report, (default,) * 3 + (1.0,))[:3]
