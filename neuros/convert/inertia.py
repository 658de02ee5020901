"""Masses and inertias of links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from neuros.convert.elements import Element
from neuros.convert.numbers import number
from neuros.convert.poses import Vector, read_pose
from neuros.convert.report import Report

_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_DEFAULTS = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Inertia:
    """Of a link, in its own frame.

    Attributes:
        mass: kg.
        centre: of mass, shape (3,), metres.
        matrix: about the centre of mass and along the link's axes, shape (3, 3), kg m².
    """

    mass: float
    centre: Vector
    matrix: Vector


def is_computed(link: Element) -> bool:
    """Whether the mass is to be computed from shapes and densities (SDF 1.11)."""
    inertial = link.child("inertial")
    return inertial is not None and inertial.attributes.get("auto", "false") in ("true", "1")


def read_inertia(link: Element, report: Report) -> Inertia:
    """What ``<inertial>`` says, SDF's defaults where it says nothing: 1 kg and 1 kg m²."""
    inertial = link.child("inertial")
    if inertial is None:
        report.remark(link, "no <inertial>: it gets SDF's 1 kg, and 1 kg m² about each axis")
        return Inertia(1.0, np.zeros(3), np.eye(3))
    pose = read_pose(inertial, report)
    mass = number(inertial, "mass", report, 1.0, positive=True)
    values = dict(zip(_ENTRIES, _DEFAULTS, strict=True))
    element = inertial.child("inertia")
    if element is not None:
        values = {key: number(element, key, report, values[key]) for key in _ENTRIES}
    ixx, iyy, izz, ixy, ixz, iyz = values.values()
    matrix = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    matrix = _possible(matrix, element or inertial, report)
    return Inertia(mass, pose.position, pose.rotation @ matrix @ pose.rotation.T)


def set_inertia(body: Any, inertia: Inertia) -> None:
    """Give it to a body of the spec."""
    matrix = inertia.matrix
    body.explicitinertial = True
    body.mass, body.ipos = inertia.mass, inertia.centre
    body.fullinertia = [*np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2]]


def _possible(matrix: Vector, element: Element, report: Report) -> Vector:
    """The matrix, or one that a rigid body can have."""
    if not np.isfinite(matrix).all():
        report.problem(element, "every moment of inertia must be finite")
        return np.eye(3)
    least, middle, most = np.linalg.eigvalsh(matrix)
    if least <= 0:
        report.problem(
            element,
            f"no body has this inertia: its principal moments are {least:.3g}, {middle:.3g} and"
            f" {most:.3g} kg m², and each must be positive",
        )
        return np.eye(3)
    if least + middle < most * (1 - _TOLERANCE):
        mean = float(np.trace(matrix)) / 3
        report.remark(
            element,
            f"no body has this inertia (its largest principal moment, {most:.3g} kg m², exceeds the"
            f" sum of the others): MuJoCo gets {mean:.3g} kg m² about every axis",
        )
        return np.eye(3) * mean
    return matrix
