"""Forward kinematics of SDF by hand: 4 x 4 matrices, nothing of the converter.

A random model is written as SDF and kept as numbers at the same time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hypothesis import strategies as st

from tests.corpus.independent import Matrix, matrix_of, shift, turn


@dataclass
class DrawnJoint:
    name: str
    type: str
    parent: str
    child: str
    place: Matrix
    axis: Matrix


@dataclass
class DrawnModel:
    """A model of random links, joints and frames; places are in the frame of the model.

    ``order`` is that of the links in the document, those of an inner model last.
    """

    name: str
    pose: list[float]
    placement: str = ""
    places: dict[str, Matrix] = field(default_factory=dict)
    inertias: dict[str, tuple[float, Matrix, Matrix]] = field(default_factory=dict)
    joints: list[DrawnJoint] = field(default_factory=list)
    elements: list[str] = field(default_factory=list)
    order: list[str] = field(default_factory=list)

    @property
    def matrix(self) -> Matrix:
        """Where the model's own frame is in what it is part of."""
        own = self.places[self.placement] if self.placement else np.eye(4)
        return matrix_of(self.pose) @ np.linalg.inv(own)

    @property
    def text(self) -> str:
        placement = f' placement_frame="{self.placement}"' if self.placement else ""
        inside = "\n".join(self.elements)
        return f'<model name="{self.name}"{placement}>{written(self.pose)}\n{inside}\n</model>'


def written(pose: list[float], relative_to: str = "") -> str:
    base = f' relative_to="{relative_to}"' if relative_to else ""
    return f"<pose{base}>{' '.join(map(repr, map(float, pose)))}</pose>"


metres = st.floats(-2, 2, width=32).map(lambda value: round(value, 3))
angles = st.floats(-3, 3, width=32).map(lambda value: round(value, 3))
poses = st.tuples(metres, metres, metres, angles, angles, angles).map(list)
axes = st.tuples(metres, metres, metres).filter(lambda axis: math.hypot(*axis) > 0.1)


@st.composite
def models(draw: Callable[..., Any], name: str = "robot", *, nested: bool = True) -> DrawnModel:
    """A model with up to four links in a tree, frames between them, and perhaps one inside it."""
    model = DrawnModel(name, draw(poses))
    if nested and draw(st.booleans()):
        inner = draw(models("inner", nested=False))
        model.elements.append(inner.text)
        model.places["inner"] = inner.matrix
        for known, place in inner.places.items():
            model.places[f"inner::{known}"] = inner.matrix @ place
        for link, inertia in inner.inertias.items():
            model.inertias[f"inner::{link}"] = inertia
        model.order = [f"inner::{link}" for link in inner.order]
        for joint in inner.joints:
            place, axis = inner.matrix @ joint.place, inner.matrix[:3, :3] @ joint.axis
            ends = f"inner::{joint.parent}", f"inner::{joint.child}"
            model.joints.append(DrawnJoint(f"inner::{joint.name}", joint.type, *ends, place, axis))
    links: list[str] = []
    for index in range(draw(st.integers(1, 4))):
        _draw_frame(draw, model, f"frame{index}")
        _draw_link(draw, model, f"link{index}")
        if links:
            _draw_joint(draw, model, f"joint{index}", draw(st.sampled_from(links)), f"link{index}")
        links.append(f"link{index}")
    model.elements = draw(st.permutations(model.elements))
    own = [text.split('"')[1] for text in model.elements if text.startswith("<link")]
    model.order = [*own, *(name for name in model.order if "::" in name)]
    model.placement = draw(st.sampled_from(["", *model.places]))
    return model


def _draw_base(draw: Callable[..., Any], model: DrawnModel) -> tuple[str, Matrix]:
    base = draw(st.sampled_from(["", *model.places]))
    return base, model.places[base] if base else np.eye(4)


def _draw_frame(draw: Callable[..., Any], model: DrawnModel, name: str) -> None:
    base, place = _draw_base(draw, model)
    pose = draw(poses)
    if base and draw(st.booleans()):
        text = f'<frame name="{name}" attached_to="{base}">{written(pose)}</frame>'
    else:
        text = f'<frame name="{name}">{written(pose, base)}</frame>'
    model.elements.append(text)
    model.places[name] = place @ matrix_of(pose)


def _draw_link(draw: Callable[..., Any], model: DrawnModel, name: str) -> None:
    base, place = _draw_base(draw, model)
    pose, inside = draw(poses), draw(poses)
    mass, points = draw(st.floats(0.1, 9)), np.array(draw(st.lists(axes, min_size=3, max_size=3)))
    # Of points with a mass each, so that a body can have it, and of a ball, so that it is no rod.
    tensor = 0.1 * np.eye(3) + sum(np.dot(p, p) * np.eye(3) - np.outer(p, p) for p in points)
    entries = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
    moments = "".join(f"<i{key}>{float(tensor[at])!r}</i{key}>" for key, at in entries.items())
    model.elements.append(
        f'<link name="{name}">{written(pose, base)}<inertial>{written(inside)}'
        f"<mass>{mass!r}</mass><inertia>{moments}</inertia></inertial></link>"
    )
    model.places[name] = place @ matrix_of(pose)
    model.inertias[name] = mass, matrix_of(inside), tensor


def _draw_joint(
    draw: Callable[..., Any], model: DrawnModel, name: str, parent: str, child: str
) -> None:
    base, place = _draw_base(draw, model)
    pose, axis = draw(poses), np.array(draw(axes))
    kind = draw(st.sampled_from(["revolute", "prismatic", "continuous"]))
    expressed = draw(st.sampled_from(["", "__model__", *model.places]))
    if draw(st.booleans()):
        parent, child = child, parent  # a link may be the child of two joints
    place = (place if base else model.places[child]) @ matrix_of(pose)
    frame = {"": place, "__model__": np.eye(4), **model.places}[expressed]
    attribute = f' expressed_in="{expressed}"' if expressed else ""
    xyz = " ".join(repr(float(value)) for value in axis)
    model.elements.append(
        f'<joint name="{name}" type="{kind}">{written(pose, base)}<parent>{parent}</parent>'
        f"<child>{child}</child><axis><xyz{attribute}>{xyz}</xyz></axis></joint>"
    )
    direction = frame[:3, :3] @ (axis / np.linalg.norm(axis))
    model.joints.append(DrawnJoint(name, kind, parent, child, place, direction))
    model.places[name] = place


def moved(model: DrawnModel, positions: dict[str, float]) -> dict[str, Matrix]:
    """Where the links are in the world once every joint is at its position.

    Of links that joints join, the first that is no joint's child stays where it is.
    """
    world = {name: model.matrix @ model.places[name] for name in model.inertias}
    result: dict[str, Matrix] = {}
    children = {joint.child for joint in model.joints}
    for start in sorted(model.order, key=lambda name: name in children):
        if start in result:
            continue
        result[start] = world[start]
        waiting = [start]
        while waiting:
            here = waiting.pop()
            for joint in model.joints:
                for near, far, sign in (
                    (joint.parent, joint.child, 1),
                    (joint.child, joint.parent, -1),
                ):
                    if near != here or far in result:
                        continue
                    motion = _motion(model.matrix, joint, sign * positions[joint.name])
                    at_rest = np.linalg.inv(world[near]) @ motion @ world[far]
                    result[far] = result[near] @ at_rest
                    waiting.append(far)
    return result


def _motion(model: Matrix, joint: DrawnJoint, position: float) -> Matrix:
    """How a joint moves things in the world, while the model is otherwise at rest."""
    place, axis = model @ joint.place, model[:3, :3] @ joint.axis
    if joint.type == "prismatic":
        return shift(axis * position)
    origin = shift(place[:3, 3])
    return origin @ turn(axis, position) @ np.linalg.inv(origin)
