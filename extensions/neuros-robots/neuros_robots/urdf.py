"""URDF to an ``MjSpec``.

Each element of URDF becomes the element of SDF that means the same, at its place in the file and
with URDF's defaults; from there on both formats are one. See http://wiki.ros.org/urdf/XML.

The frame of a joint is that of its child link. The root link stands in the world.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from neuros.errors import Problem
from neuros_robots import bodies, links
from neuros_robots.elements import Element, Finder, NotFound, Report, parse
from neuros_robots.frames import (
    Branch,
    Frame,
    Joint,
    Link,
    Pose,
    Scope,
    from_quaternion,
    read_pose,
)
from neuros_robots.mjcf import Building, Converted, Meshes, finished, message_of

_DRIVES = "declare drives in the node file: `joint` and `drive`"
_GAZEBO = "an extension for Gazebo"
_LEFT_OUT = {
    "gazebo": _GAZEBO,
    "transmission": _DRIVES,
    "ros2_control": _DRIVES,
    "safety_controller": "MuJoCo has no such limits",
    "calibration": "nothing to calibrate in a simulation",
}
_XACRO = re.compile(r"\$[{(]")
_SHAPES: Mapping[str, Mapping[str, int]] = {
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
}
"""Attributes of a shape, and how many numbers each has."""
_LIMITED = ("revolute", "prismatic")
_OF_MUJOCO = ("compiler", "option", "size")
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_OF_LINK = ("sensor", "gravity")  # in <gazebo reference="link">: elements of SDF
_OF_MESHES = ("meshdir", "assetdir", "texturedir", "strippath")


def read_urdf(file: Path, finder: Finder) -> Converted:
    """Read a URDF file.

    Raises:
        DescriptionError: with every problem of the file.
    """
    report = Report()
    root = parse(file, report)
    if isinstance(root, Problem):
        report.problems.append(root)
        report.raise_any()
    assert isinstance(root, Element)
    _refuse_xacro(root)
    if root.tag != "robot":
        root.problem(f"a URDF file begins with <robot>, not with <{root.tag}>")
    report.raise_any()
    root.is_read = True
    spec = _base(root)
    robot = _Robot(root, finder)
    building = Building(spec, Meshes(spec, finder))
    branches = robot.branches(building)
    bodies.add_tree(building, robot.scope, branches)
    for element in root.descendants():
        if element.tag in _LEFT_OUT:
            unused = [child for child in element.children if not child.is_read]
            for part in [element] if len(unused) == len(element.children) else unused:
                part.omit(_LEFT_OUT[element.tag])
            element.is_read = True
    made = [link.element for link in robot.scope.links.values()]
    made += [branch.joint.element for branch in branches if branch.joint is not None]
    return replace(finished(building, [root, *made]), may_move=True)


def _refuse_xacro(root: Element) -> None:
    """Report what only xacro understands, and nothing else: the rest follows from it."""
    found = [
        element
        for element in root.descendants()
        if element.tag.startswith("xacro:")
        or any(map(_XACRO.search, (element.text, *element.attributes.values())))
        if not any(above.tag in _LEFT_OUT for above in element.and_ancestors())
    ]
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        name = found[0].file.name
        whole = name if name.endswith(".xacro") else f"{name}.xacro"
        found[0].problem(
            f"this is xacro that was not expanded{more}", f"`xacro {whole} > robot.urdf` makes URDF"
        )
        root.report.raise_any()


def _base(root: Element) -> Any:
    """The spec with the settings of a ``<mujoco>`` element, which is MuJoCo's own extension."""
    block = root.child("mujoco")
    settings = [] if block is None else [c for c in block.children if c.tag in _OF_MUJOCO]
    for element in settings:
        element.mark_all_read()
    rows = "".join(map(_xml, settings))
    try:
        spec = mujoco.MjSpec.from_string(f"<mujoco>{rows}</mujoco>")
    except ValueError as error:
        (block or root).problem(f"MuJoCo cannot read it: {message_of(error)}")
        spec = mujoco.MjSpec()
    spec.modelname = root.name or "robot"
    return spec


def _xml(element: Element) -> str:
    """An element as text, but for the folders of files, which are found here."""
    words = "".join(
        f" {key}={quoteattr(text)}"
        for key, text in element.attributes.items()
        if key not in _OF_MESHES
    )
    return f"<{element.tag}{words}>{''.join(map(_xml, element.children))}</{element.tag}>"


class _Robot:
    """The links and joints of a file, as those of a model of SDF, which is ``scope``."""

    def __init__(self, root: Element, finder: Finder) -> None:
        self.scope = Scope(root)
        self._root, self._finder = root, finder
        compiler = root.child("mujoco", "compiler")
        self._mesh_folder = "" if compiler is None else compiler.attributes.get("meshdir", "")
        self._links = _named(root, "link")
        self._joints = _named(root, "joint")
        self._materials = {
            material.name: material
            for owner in (*root.descendants(), root)  # those of the robot itself come last, and win
            for material in (c for c in owner.children if c.tag == "material")
            if any(child.tag in ("color", "texture") for child in material.children)
        }
        for material in root.each("material"):
            material.each("color")  # read, even if no link has it
        if not self._links:
            root.problem("there is no <link> in it")

    def branches(self, building: Building) -> list[Branch]:
        """The tree of all links, parents first."""
        below = self._below()
        ends = {child for joints in below.values() for _, child in joints}
        roots = [name for name in self._links if name not in ends]
        placed = {name: Pose() for name in roots}
        result = []
        waiting = deque(roots)
        self._read_gazebo()
        for name in roots:
            link = self._add_link(name, Pose())
            if name == "world":
                building.bodies[id(link)] = building.spec.worldbody
                links.add_shapes(building, link, is_solid=False)
                links.add_link_sensors(building, link)
                for inertial in link.element.each("inertial"):
                    inertial.mark_all_read()  # it does not move
                continue
            if name != roots[0]:
                link.element.remark(f"'{name}' has no joint: it stands in the world, as the root")
            held = self._links[name].made("joint", name=f"world to {name}", type="fixed")
            result.append(Branch(link, None, Joint(held, self.scope, None, link, Pose())))
        moving = set[str]()
        while waiting:
            parent = waiting.popleft()
            for element, child in below.get(parent, ()):
                placed[child] = placed[parent] @ read_pose(element.made("joint", *_pose(element)))
                link = self._add_link(child, placed[child])
                above: Link | None = self.scope.links[parent]
                kind = element.type
                if kind == "floating":
                    # MuJoCo has free joints of bodies in the world only.
                    if parent in moving:
                        kind = "carried"
                    else:
                        above = None
                if kind != "fixed" or parent in moving:
                    moving.add(child)
                made = self._joint(element, kind)
                joint = Joint(made, self.scope, above, link, link.pose)
                result.append(Branch(link, above, joint))
                waiting.append(child)
        for name in self._links:
            if name not in placed:
                self._links[name].problem(f"'{name}' is below itself: the joints form a circle")
        self.scope.element = self._root.made("robot", *(b.joint.element for b in result if b.joint))
        return result

    def _below(self) -> dict[str, list[tuple[Element, str]]]:
        """The joints below each link, each with its child."""
        below: dict[str, list[tuple[Element, str]]] = {}
        held: dict[str, Element] = {}
        for joint in self._joints.values():
            is_right = bodies.is_known(joint, bodies.URDF_TYPES)
            ends = [self._end(joint, side) for side in ("parent", "child")]
            parent, child = ends
            if not is_right or parent is None or child is None:
                continue
            if child in held:
                joint.problem(
                    f"the link '{child}' has two parents: in URDF it has one",
                    f"see joint '{held[child].name}' in {held[child].place}",
                )
                continue
            held[child] = joint
            below.setdefault(parent, []).append((joint, child))
        return below

    def _end(self, joint: Element, side: str) -> str | None:
        element = joint.child(side)
        name = "" if element is None else element.attributes.get("link", "")
        if not name:
            joint.problem(f"<{side}> is missing: which link is the {side}?")
        elif name not in self._links:
            known = ", ".join(sorted(self._links)[:8])
            (element or joint).problem(
                f"the {side} of joint '{joint.name}' is '{name}', and there is no such link",
                f"there are: {known}" if known else "",
            )
        return name if name in self._links else None

    # ---- elements of SDF

    def _read_gazebo(self) -> None:
        """Sort the content of ``<gazebo>`` elements by the link or joint that they refer to."""
        self._extensions: dict[str, list[Element]] = {}
        for block in self._root.children:
            if block.tag != "gazebo":
                continue
            name = block.attributes.get("reference", "")
            if not name:
                self.scope.self_collides |= block.is_true("self_collide")
            elif name in self._links or name in self._joints:
                self._extensions.setdefault(name, []).extend(block.children)

    def _add_link(self, name: str, pose: Pose) -> Link:
        source, extensions = self._links[name], self._extensions.get(name, ())
        content = [self._inertial(source)]
        for tag in ("collision", "visual"):
            for index, shape in enumerate(source.each(tag)):
                before = len(source.report.problems)
                made = self._shape(shape, shape.name or f"{tag}{index or ''}")
                if tag == "visual" and source.report.listed(before):
                    continue
                content.append(made)
                made.children += _surface(extensions) if tag == "collision" else ()
        made = source.made("link", *content, name=name)
        for element in extensions:
            if element.tag in _OF_LINK:
                made.children.append(element)
            elif element.tag == "turnGravityOff":
                element.is_read = True
                is_off = element.text.lower() in ("true", "1")
                made.children.append(element.made("gravity", "false" if is_off else "true"))
        link = Link(name, made, self.scope, pose, is_static=False)
        self.scope.links[name] = link
        self.scope.frames[name] = Frame(made, "", pose)
        return link

    def _inertial(self, link: Element) -> Element:
        """URDF's default is no mass at all."""
        inertial = link.child("inertial") or link
        mass = inertial.child("mass") or inertial.made("mass")
        inertia = inertial.child("inertia") or inertial.made("inertia")
        moments = [inertia.made(key, _text(_numbers(inertia, key, (0.0,)))) for key in _MOMENTS]
        return inertial.made(
            "inertial",
            *(() if inertial is link else _pose(inertial)),
            mass.made("mass", _text(_numbers(mass, "value", (0.0,)))),
            inertia.made("inertia", *moments),
        )

    def _shape(self, source: Element, name: str) -> Element:
        content = _pose(source)
        geometry = source.child("geometry")
        if geometry is not None:
            content.append(geometry.made("geometry", *map(self._geometry, geometry.children[:1])))
        material = source.child("material")
        if material is not None:
            content += self._material(material)
        return source.made(source.tag, *content, name=name)

    def _geometry(self, shape: Element) -> Element:
        shape.is_read = True
        if shape.tag == "mesh":
            uri = shape.made("uri", self._mesh(shape))
            scale = shape.made("scale", _text(_numbers(shape, "scale", (1.0, 1.0, 1.0))))
            return shape.made("mesh", uri, scale)
        content = []
        for key, count in _SHAPES.get(shape.tag, {}).items():
            if key not in shape.attributes:
                shape.problem(f"{key} is missing")
            content.append(shape.made(key, _text(_numbers(shape, key, (1.0,) * count))))
        return shape.made(shape.tag, *content)

    def _mesh(self, mesh: Element) -> str:
        """The URI of a mesh, or its path in the folder for meshes that the file names."""
        uri = mesh.attributes.get("filename", "")
        if self._mesh_folder:
            beside = str(Path(self._mesh_folder) / Path(uri).name)
            try:
                self._finder.find_file(uri, mesh.file.parent)
            except NotFound:
                return beside
        return uri

    def _material(self, material: Element) -> list[Element]:
        defined = material if material.children else self._materials.get(material.name)
        if defined is None:
            material.remark(f"there is no material '{material.name}': it is grey")
            return []
        color = defined.child("color")
        for texture in [c for c in defined.children if c.tag == "texture" and not c.is_read]:
            uri = texture.attributes.get("filename", "")
            try:
                self._finder.find_file(uri, texture.file.parent)
                texture.omit("a texture: MuJoCo shows the colour alone")
            except NotFound as error:
                texture.omit(f"the texture is missing: {error}")
        if color is None:
            return []
        rgba = _text(_numbers(color, "rgba", (0.7, 0.7, 0.7, 1.0)))
        return [defined.made("material", color.made("diffuse", rgba))]

    def _joint(self, joint: Element, kind: str) -> Element:
        axis = joint.child("axis")
        direction = (1.0, 0.0, 0.0) if axis is None else _numbers(axis, "xyz", (1.0, 0.0, 0.0))
        content: list[Element] = []
        if kind in ("revolute", "continuous", "prismatic"):
            xyz = (axis or joint).made("xyz", _text(direction))
            content.append(joint.made("axis", xyz, *self._dynamics(joint)))
        elif kind in ("planar", "carried"):
            turned = _basis(direction) if kind == "planar" else ((1, 0, 0), (0, 1, 0), (0, 0, 1))
            tags = ("x", "y", "turn" if kind == "planar" else "z")
            for tag, vector in zip(tags, turned, strict=True):
                content.append(joint.made(tag, joint.made("xyz", _text(vector))))
        made = joint.made("joint", *content, name=joint.name, type=kind)
        made.children += [e for e in self._extensions.get(joint.name, ()) if e.tag == "sensor"]
        for child in joint.children:
            if child.tag in ("axis", "limit", "dynamics", "mimic") and not child.is_read:
                child.is_read = True  # of a joint that it means nothing for
                if kind != "fixed" and child.tag != "axis":
                    child.omit(f"not used for a {joint.type} joint")
        return made

    def _dynamics(self, joint: Element) -> list[Element]:
        """Limits, damping, friction, and the joint that it follows."""
        limit, dynamics, mimic = map(joint.child, ("limit", "dynamics", "mimic"))
        content = []
        values = {} if limit is None else limit.attributes
        keys: list[str] = [key for key in ("effort", "velocity") if key in values]
        keys += ("lower", "upper") if joint.type in _LIMITED else ()  # 0 where they are missing
        place = limit or joint
        rows = [
            place.made(key, _text(place.numbers((0.0,), key) if key in values else (0.0,)))
            for key in keys
        ]
        is_given = bool({"lower", "upper"} & {*values})
        content.append(place.made("limit", "" if is_given else "URDF's default", *rows))
        if dynamics is not None:
            rows = [
                dynamics.made(key, _text(_numbers(dynamics, key, (0.0,))))
                for key in ("damping", "friction")
            ]
            content.append(dynamics.made("dynamics", *rows))
        if mimic is not None:
            rows = [
                mimic.made(key, _text(_numbers(mimic, key, (default,))))
                for key, default in (("multiplier", 1.0), ("offset", 0.0))
            ]
            content.append(mimic.made("mimic", *rows, joint=mimic.attributes.get("joint", "")))
        return content


def _named(root: Element, tag: str) -> dict[str, Element]:
    """The elements of a tag by name; problems are reported."""
    found: dict[str, Element] = {}
    for element in root.each(tag):
        if not element.name:
            element.problem(f"the <{tag}> has no name")
        elif element.name in found:
            place = found[element.name].place
            element.problem(f"the name '{element.name}' occurs twice", f"see {place}")
        else:
            found[element.name] = element
    return found


def _pose(owner: Element) -> list[Element]:
    origin = owner.child("origin")
    if origin is None:
        return []
    position = _numbers(origin, "xyz", (0.0, 0.0, 0.0))
    if "quat_xyzw" in origin.attributes:  # since URDF 1.1
        turned = _numbers(origin, "quat_xyzw", (0.0, 0.0, 0.0, 1.0))
        return [origin.made("pose", _text((*position, *turned)), rotation_format="quat_xyzw")]
    return [origin.made("pose", _text((*position, *_numbers(origin, "rpy", (0.0, 0.0, 0.0)))))]


def _surface(extensions: Sequence[Element]) -> list[Element]:
    """The friction of collisions that ``<gazebo reference="link">`` sets."""
    along, across = ([e for e in extensions if e.tag in tags] for tags in (("mu1", "mu"), ("mu2",)))
    if not along:
        return []
    rows = [
        part.made(tag, part.text)
        for tag, part in zip(("mu", "mu2"), along[:1] + across[:1], strict=False)
    ]
    for element in (*along, *across):
        element.is_read = True
    ode = along[0].made("ode", *rows)
    return [along[0].made("surface", along[0].made("friction", ode))]


def _numbers(element: Element, key: str, default: Sequence[float]) -> tuple[float, ...]:
    """The finite numbers in an attribute, as many as ``default`` has, which stands for none."""
    return element.finite(default, key) if key in element.attributes else tuple(default)


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _basis(normal: Sequence[float]) -> list[list[float]]:
    """Two directions across a vector, and the vector itself."""
    length = math.hypot(*normal)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    if length:
        mujoco.mju_quatZ2Vec(quaternion, np.array(normal) / length)
    return [[*axis] for axis in from_quaternion((0, 0, 0), quaternion).rotation.T]
