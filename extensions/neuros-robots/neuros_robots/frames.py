"""Poses, named frames, and the tree of links; in SDF every model and world is a scope of names.

A frame is a link, a joint, a nested model or a ``<frame>``; its pose is relative to another frame
of its scope, or of a scope within (``arm::hand``). The own frame of a scope is called ``__model__``
(in a world: ``world``). See http://sdformat.org, "Pose frame semantics".

SDF joins any two links; in MuJoCo each body has one parent. :func:`grow` makes the tree: it begins
with the links that joints attach to the world, then with links that are no joint's child. A joint
that is reached from its child is turned round. Joints that close a loop are left over.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
import numpy.typing as npt

from neuros_robots.elements import Element

Vector = npt.NDArray[np.float64]
_OWN = ("", "__model__", "world")
_KINDS = ("link", "joint", "frame", "model")


@dataclass(frozen=True, eq=False)
class Pose:
    """Position and rotation of a frame, seen from another.

    Attributes:
        position: of its origin, shape (3,), metres.
        rotation: its axes as columns, shape (3, 3).
    """

    position: Vector = field(default_factory=lambda: np.zeros(3))
    rotation: Vector = field(default_factory=lambda: np.eye(3))

    def __matmul__(self, other: Pose) -> Pose:
        """Chain two poses; ``other`` is seen from this pose's frame."""
        return Pose(self.rotation @ other.position + self.position, self.rotation @ other.rotation)

    def inverse(self) -> Pose:
        """The pose of the other frame, seen from this one."""
        return Pose(-self.rotation.T @ self.position, self.rotation.T)

    @property
    def quaternion(self) -> Vector:
        """The rotation as w, x, y, z, shape (4,)."""
        result = np.zeros(4)
        mujoco.mju_mat2Quat(result, np.ascontiguousarray(self.rotation).ravel())
        return result


def from_rpy(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Pose:
    """A pose in metres and radians, turned about the fixed axes x, y and z, in this order."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return Pose(np.array([x, y, z], float), about_z @ about_y @ about_x)


def from_quaternion(position: Sequence[float], wxyz: Sequence[float] | Vector) -> Pose:
    """A pose in metres; the quaternion (w, x, y, z) may have any length but 0."""
    matrix, quaternion = np.zeros(9), np.array(wxyz, float)
    mujoco.mju_normalize4(quaternion)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return Pose(np.array(position, float), matrix.reshape(3, 3))


def read_pose(owner: Element) -> Pose:
    """The pose in the ``<pose>`` of ``owner``, relative to the frame that it names."""
    element = owner.child("pose")
    if element is None or not element.text:
        return Pose()
    if element.attributes.get("rotation_format") == "quat_xyzw":
        x, y, z, qx, qy, qz, qw = element.finite((0, 0, 0, 0, 0, 0, 1))
        if not math.hypot(qx, qy, qz, qw):
            element.problem("the quaternion is zero")
            return Pose()
        return from_quaternion((x, y, z), (qw, qx, qy, qz))
    x, y, z, *angles = element.finite((0,) * 6)
    if element.has("degrees"):
        angles = [math.radians(angle) for angle in angles]
    return from_rpy(x, y, z, *angles)


@dataclass(eq=False)
class Frame:
    """A named frame; ``raw`` is its pose relative to the frame ``base`` of its scope."""

    element: Element
    base: str
    raw: Pose


@dataclass(eq=False)
class Link:
    """A rigid body.

    Attributes:
        name: the name in MuJoCo: the names of the models around it, and its own, by slashes.
        pose: in the world.
    """

    name: str
    element: Element
    scope: Scope
    pose: Pose
    is_static: bool


@dataclass(eq=False)
class Scope:
    """A model, or a world.

    Attributes:
        prefix: of the names of its elements in MuJoCo: empty, or ``arm/hand/``.
        pose: in the world.
        models: the models in it, by name.
    """

    element: Element
    parent: Scope | None = None
    prefix: str = ""
    pose: Pose = field(default_factory=Pose)
    is_static: bool = False
    self_collides: bool = False
    frames: dict[str, Frame] = field(default_factory=dict)
    models: dict[str, Scope] = field(default_factory=dict)
    links: dict[str, Link] = field(default_factory=dict)
    _places: dict[str, Pose | None] = field(default_factory=dict)

    @property
    def is_world(self) -> bool:
        return self.parent is None

    @property
    def outermost(self) -> Scope:
        """The model around it that is in no other model."""
        return self if self.parent is None or self.parent.is_world else self.parent.outermost

    def and_models(self) -> Iterator[Scope]:
        """This scope, and all within, outer ones first."""
        yield self
        for model in self.models.values():
            yield from model.and_models()

    def each(self, tag: str) -> Iterator[tuple[Scope, Element]]:
        """All elements of one tag in this scope and those within."""
        for scope in self.and_models():
            yield from ((scope, element) for element in scope.element.each(tag))

    def place(self, name: str, asking: Element) -> Pose:
        """The pose of a frame in this scope's own frame; problems are reported at ``asking``."""
        head, _, rest = name.partition("::")
        if rest:
            if head in self.models:
                return self.place(head, asking) @ self.models[head].place(rest, asking)
            asking.problem(f"there is no model '{head}' for '{name}'")
            return Pose()
        if head in _OWN and (head != "world" or self.is_world):
            return Pose()
        if head not in self.frames:
            self._unknown(name, asking)
            return Pose()
        # From the farthest base on; not by recursion, which long chains would exhaust.
        bases: dict[str, None] = {}
        base = head
        while base in self.frames and base not in self._places and base not in bases:
            bases[base] = None
            base = self.frames[base].base.partition("::")[0]
        for each in reversed(bases):
            if each not in self._places:
                self._places[each] = None
                self._places[each] = self._placed(each)
        place = self._places[head]
        if place is None:
            asking.problem(f"'{name}' is placed relative to itself")
            return Pose()
        return place

    def _placed(self, name: str) -> Pose:
        frame = self.frames[name]
        place = self.place(frame.base, frame.element) @ frame.raw
        model = self.models.get(name) if frame.element.tag == "model" else None
        anchor = model and model.element.attributes.get("placement_frame")
        if model and anchor:
            return place @ model.place(anchor, model.element).inverse()
        return place

    def read_pose(self, owner: Element, default: Pose) -> Pose:
        """The pose in the world of an element without a name (a collision, a sensor).

        It is relative to ``default``, a pose in the world, unless it names another frame.
        """
        base = relative_to(owner)
        if base:
            default = self.pose @ self.place(base, owner)
        return default @ read_pose(owner)

    def body(self, name: str, asking: Element) -> Link | None:
        """The link that a frame is attached to; ``None`` is the world. Problems are reported."""
        seen: set[tuple[int, str]] = set()
        scope: Scope = self
        while (id(scope), name) not in seen:
            seen.add((id(scope), name))
            head, _, rest = name.partition("::")
            if name == "world" or (scope.is_world and name in _OWN):
                return None
            if rest and head in scope.models:
                scope, name = scope.models[head], rest
            elif name in _OWN:
                name = scope.canonical()
                if not name:
                    break
            elif name in scope.links:
                return scope.links[name]
            elif name in scope.frames:
                element = scope.frames[name].element
                if element.tag == "model":
                    scope, name = scope.models[name], "__model__"
                elif element.tag == "joint":
                    name = element.text_of("child")
                else:
                    name = element.attributes.get("attached_to") or "__model__"
            else:
                scope._unknown(name, asking)
                return None
        asking.problem(f"'{name or self.element.name}' is attached to no link")
        return None

    def canonical(self) -> str:
        """The name of the link that represents the model: the one it names, or the first."""
        named = self.element.attributes.get("canonical_link")
        if named:
            return named
        if self.links:
            return next(iter(self.links))
        inner = (f"{name}::__model__" for name, model in self.models.items() if model.canonical())
        return next(inner, "")

    def _unknown(self, name: str, asking: Element) -> None:
        names = ", ".join(sorted(self.frames)[:8])
        hint = f"there are: {names}" if names else ""
        asking.problem(f"there is no link, joint, frame or model '{name}'", hint)


def relative_to(owner: Element) -> str:
    """The frame that the pose of ``owner`` is relative to; empty if it names none."""
    pose = owner.child("pose")
    if pose is None:
        return ""
    # Until SDF 1.6 the attribute was called "frame".
    return pose.attributes.get("relative_to") or pose.attributes.get("frame") or ""


def read_scope(element: Element, parent: Scope | None = None, prefix: str = "") -> Scope:
    """A world or model with all its contents; poses in the world are not set yet."""
    scope = Scope(element, parent, prefix)
    placement = element.child("placement_frame")
    if placement is not None:
        element.attributes["placement_frame"] = placement.text
    if parent is not None:
        scope.is_static = element.is_true("static") or parent.is_static
        scope.self_collides = element.is_true("self_collide")
    for kind in _KINDS:
        for child in element.each(kind):
            _add_frame(scope, child)
    for child in element.each("model"):
        if child.name and child.name not in scope.models:
            # A model that stands alone in its file needs no prefix.
            inner = "" if scope.is_world and element.tag != "world" else f"{prefix}{child.name}/"
            scope.models[child.name] = read_scope(child, scope, inner)
    return scope


def place_all(scope: Scope) -> None:
    """Place every model and link in the world."""
    for name, model in scope.models.items():
        model.pose = scope.pose @ scope.place(name, model.element)
        place_all(model)
    for name in scope.frames:
        scope.place(name, scope.frames[name].element)  # reports problems of unused frames, too
    for name, link in scope.links.items():
        link.pose = scope.pose @ scope.place(name, link.element)


def _add_frame(scope: Scope, element: Element) -> None:
    if not element.name:
        element.problem(f"the <{element.tag}> has no name")
        return
    if element.name in scope.frames:
        first = scope.frames[element.name].element
        element.problem(f"the name '{element.name}' occurs twice", f"see {first.place}")
        return
    default = ""
    if element.tag == "joint":
        default = element.text_of("child")
    elif element.tag == "frame":
        default = element.attributes.get("attached_to", "")
    base = relative_to(element) or default
    scope.frames[element.name] = Frame(element, base, read_pose(element))
    if element.tag == "link":
        name = scope.prefix + element.name
        scope.links[element.name] = Link(name, element, scope, Pose(), scope.is_static)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links, ``None`` being the world; ``anchor`` is its pose in the world."""

    element: Element
    scope: Scope
    parent: Link | None
    child: Link | None
    anchor: Pose

    @property
    def name(self) -> str:
        return self.scope.prefix + self.element.name

    @property
    def type(self) -> str:
        return self.element.type


@dataclass(frozen=True, eq=False)
class Branch:
    """A link and its joint to ``parent`` (``None``: the world), or without a joint."""

    link: Link
    parent: Link | None = None
    joint: Joint | None = None
    is_turned: bool = False


def grow(links: Sequence[Link], joints: Sequence[Joint]) -> tuple[list[Branch], list[Joint]]:
    """The tree of all links, parents first, and the joints that close loops.

    Links of static models hang on the world, without a joint.
    """
    loops, used = list[Joint](), set[int]()
    seen = {id(link) for link in links if link.is_static}
    branches = [Branch(link) for link in links if link.is_static]
    at: dict[int | None, list[Joint]] = {}
    for joint in joints:
        for end in {_key(joint.parent), _key(joint.child)}:
            at.setdefault(end, []).append(joint)

    def spread(start: Link | None) -> None:
        waiting = deque([start])
        while waiting:
            link = waiting.popleft()
            for joint in at.get(_key(link), ()):
                if id(joint) in used:
                    continue
                used.add(id(joint))
                is_turned = _key(joint.parent) != _key(link)
                other = joint.parent if is_turned else joint.child
                if other is None or other.is_static or id(other) in seen:
                    loops.append(joint)
                    continue
                seen.add(id(other))
                branches.append(Branch(other, link, joint, is_turned))
                waiting.append(other)

    spread(None)
    children = {_key(joint.child) for joint in joints}
    for link in sorted(links, key=lambda link: id(link) in children):
        if id(link) not in seen:
            seen.add(id(link))
            branches.append(Branch(link))
            spread(link)
    return branches, loops


def _key(link: Link | None) -> int | None:
    """The key of a link; static links and the world share one."""
    return None if link is None or link.is_static else id(link)
