"""What a URDF or SDF file says, read by ElementTree and multiplied by hand.

Nothing of the converter is used, nor of MuJoCo. A file that needs more than the formats' simple
part (includes, nested models, frames) is :class:`NotRead`.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

Matrix = npt.NDArray[np.float64]
_MOMENTS = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
_SINGLE = ("revolute", "continuous", "prismatic")


class NotRead(Exception):
    """A file that this reader does not know enough for."""


@dataclass
class Body:
    """A link: its place in the world, shape (4, 4), and its shapes by tag.

    Attributes:
        mass: kg.
        centre: of mass, in the link's frame, shape (3,), metres.
        inertia: about the centre, along the axes of the link, shape (3, 3), kg m².
    """

    place: Matrix
    mass: float
    centre: Matrix
    inertia: Matrix
    shapes: dict[str, int] = field(default_factory=dict)


@dataclass
class Hinge:
    """A joint with one axis; anchor and axis are in the world, shape (3,).

    Attributes:
        limits: rad or m; infinite, or of 1e16, where there is none.
        effort: largest force or torque; infinite where there is none.
    """

    kind: str
    child: str
    anchor: Matrix
    axis: Matrix
    limits: tuple[float, float]
    effort: float
    damping: float
    friction: float


@dataclass
class Description:
    """Bodies and joints by name; joints of several axes or none are counted only."""

    bodies: dict[str, Body] = field(default_factory=dict)
    hinges: dict[str, Hinge] = field(default_factory=dict)
    joints: int = 0


def turn(axis: Matrix, angle: float) -> Matrix:
    """Rotation about a unit axis through the origin, after Rodrigues; shape (4, 4)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return result


def shift(vector: Matrix) -> Matrix:
    result = np.eye(4)
    result[:3, 3] = vector
    return result


def matrix_of(pose: Sequence[float]) -> Matrix:
    """x, y, z, roll, pitch, yaw as a matrix: turned about the fixed axes x, then y, then z."""
    x_axis, y_axis, z_axis = np.eye(3)
    turned = turn(z_axis, pose[5]) @ turn(y_axis, pose[4]) @ turn(x_axis, pose[3])
    return shift(np.array(pose[:3])) @ turned


def tree_of(file: Path) -> ElementTree.Element:
    """The root of an XML file, without comments and declarations, which may hold anything."""
    text = file.read_text("utf-8", "replace")
    bare = re.sub(r"<!--.*?-->|<\?.*?\?>", "", text, flags=re.DOTALL)
    bare = re.sub(r"(</?|\s)\w+:(?=\w+[\s=>/])", r"\1", bare)  # prefixes that nobody declares
    return ElementTree.fromstring(bare.strip("\0\ufeff \n\r\t"))


def read(file: Path) -> Description:
    """What a file says. Raises :class:`NotRead`."""
    root = tree_of(file)
    try:
        return _read_urdf(root) if root.tag == "robot" else _read_sdf(root)
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise NotRead(repr(error)) from error


def _read_urdf(root: ElementTree.Element) -> Description:
    result = Description()
    above = {_link(joint, "child"): joint for joint in root.findall("joint")}
    places: dict[str, Matrix] = {}

    def place(name: str) -> Matrix:
        if name not in places:
            joint = above.get(name)
            here = np.eye(4) if joint is None else place(_link(joint, "parent")) @ _origin(joint)
            places[name] = here
        return places[name]

    for link in root.findall("link"):
        mass, at = 0.0, np.eye(4)
        inertia: dict[str, str] = {}
        if (inertial := link.find("inertial")) is not None:
            at = _origin(inertial)
            mass = _value(inertial, "mass", "value", 0.0)
            if (moments := inertial.find("inertia")) is not None:
                inertia = dict(moments.attrib)
        entries = {key: float(inertia.get(f"i{key}", 0)) for key in _MOMENTS}
        result.bodies[link.attrib["name"]] = _body(
            link, place(link.attrib["name"]), mass, at, entries
        )
    for joint in root.findall("joint"):
        result.joints += 1
        kind, child = joint.attrib["type"], _link(joint, "child")
        if kind not in _SINGLE:
            continue
        axis, here = joint.find("axis"), place(child)
        direction = np.array([1.0, 0, 0] if axis is None else _numbers(axis.get("xyz", "1 0 0")))
        limits = -math.inf, math.inf
        if kind != "continuous":
            limits = (_value(joint, "limit", "lower", 0.0), _value(joint, "limit", "upper", 0.0))
        effort = _value(joint, "limit", "effort", math.inf)
        more = [_value(joint, "dynamics", key, 0.0) for key in ("damping", "friction")]
        unit = here[:3, :3] @ direction / np.linalg.norm(direction)
        result.hinges[joint.attrib["name"]] = Hinge(
            kind, child, here[:3, 3], unit, limits, effort, *more
        )
    return result


def _read_sdf(root: ElementTree.Element) -> Description:
    if any(root.iter("include")) or any(root.iter("frame")) or any(root.iter("placement_frame")):
        raise NotRead("it has includes or frames")
    world = root.find("world")
    result = Description()
    is_old = root.get("version", "1.9") in ("1.0", "1.1", "1.2", "1.3", "1.4")
    for model in (root if world is None else world).findall("model"):
        prefix = "" if world is None else f"{model.attrib['name']}/"
        _read_model(result, model, prefix, is_old=is_old)
    return result


def _read_model(
    result: Description, model: ElementTree.Element, prefix: str, *, is_old: bool
) -> None:
    if model.find("model") is not None:
        raise NotRead("it has nested models")
    named = {e.attrib["name"]: e for e in model if e.tag in ("link", "joint")}

    def place(name: str) -> Matrix:
        element = named[name]
        base = ""
        if (pose := element.find("pose")) is not None:
            base = pose.get("relative_to") or pose.get("frame") or ""
        if element.tag == "joint":
            base = base or element.findtext("child", "").strip()
        return (place(base) if base not in ("", "__model__") else np.eye(4)) @ _pose(element)

    own, is_static = _pose(model), model.findtext("static", "0").strip() in ("1", "true")
    for link in model.findall("link"):
        mass, at, inertia = 1.0, np.eye(4), dict.fromkeys(("xx", "yy", "zz"), 1.0)
        if is_static:
            mass = 0.0  # what never moves needs none
        elif (inertial := link.find("inertial")) is not None:
            mass, at = float(inertial.findtext("mass", "1")), _pose(inertial)
            for key in _MOMENTS:
                inertia[key] = float(inertial.findtext(f"inertia/i{key}", str(inertia.get(key, 0))))
        body = _body(link, own @ place(link.attrib["name"]), mass, at, inertia)
        result.bodies[prefix + link.attrib["name"]] = body
    for joint in model.findall("joint"):
        result.joints += 1
        axis = joint.find("axis")
        if joint.attrib["type"] not in _SINGLE or axis is None:
            continue
        here = own @ place(joint.attrib["name"])
        xyz, rotation = axis.find("xyz"), here[:3, :3]
        is_of_model = axis.findtext("use_parent_model_frame", str(is_old)).strip().lower()
        if is_of_model in ("1", "true") or (xyz is not None and xyz.get("expressed_in")):
            rotation = own[:3, :3]
            if xyz is not None and (frame := xyz.get("expressed_in", "")) not in ("", "__model__"):
                rotation = (own @ place(frame))[:3, :3]
        direction = np.array(_numbers("0 0 1" if xyz is None else xyz.text or "0 0 1"))
        lower = float(axis.findtext("limit/lower", "-1e16"))
        limits = lower, float(axis.findtext("limit/upper", "1e16"))
        if joint.attrib["type"] == "continuous":
            limits = -math.inf, math.inf
        effort = float(axis.findtext("limit/effort", "-1"))
        more = [float(axis.findtext(f"dynamics/{key}", "0")) for key in ("damping", "friction")]
        unit = rotation @ direction / np.linalg.norm(direction)
        child = prefix + joint.findtext("child", "").strip()
        result.hinges[prefix + joint.attrib["name"]] = Hinge(
            joint.attrib["type"], child, here[:3, 3], unit, limits,
            effort if effort >= 0 else math.inf, *more,
        )  # fmt: skip


def _body(
    link: ElementTree.Element, place: Matrix, mass: float, at: Matrix, entries: dict[str, float]
) -> Body:
    tensor = np.zeros((3, 3))
    for key, (row, column) in _MOMENTS.items():
        tensor[row, column] = tensor[column, row] = entries.get(key, 0.0)
    inertia = at[:3, :3] @ tensor @ at[:3, :3].T
    shapes = {tag: len(link.findall(f"{tag}/geometry/*")) for tag in ("collision", "visual")}
    return Body(place, mass, at[:3, 3], inertia, shapes)


def _link(joint: ElementTree.Element, side: str) -> str:
    return joint.find(side).attrib["link"]  # type: ignore[union-attr]


def _value(owner: ElementTree.Element, tag: str, key: str, default: float) -> float:
    element = owner.find(tag)
    return default if element is None else float(element.get(key, default))


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _origin(owner: ElementTree.Element) -> Matrix:
    origin = owner.find("origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = (origin.get(key, "0 0 0") for key in ("xyz", "rpy"))
    return matrix_of(_numbers(f"{xyz} {rpy}"))


def _pose(owner: ElementTree.Element) -> Matrix:
    return matrix_of(_numbers(owner.findtext("pose") or "0 0 0 0 0 0"))
