"""URDF to an ``MjSpec``, by MuJoCo's reader; meshes are found, unsupported elements listed.

By default MuJoCo merges links without a joint that moves, and drops visuals. Both are switched off,
so that all links keep their names, unless the ``<mujoco>`` element says otherwise.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mujoco

from neuros.errors import Problem
from neuros_robots.bodies import follow_joint
from neuros_robots.elements import Element, Finder, NotFound, Report, parse
from neuros_robots.mjcf import (
    Converted,
    Triangles,
    compile_boxed,
    fill,
    message_of,
    needs_conversion,
    triangles_of,
    why_unread,
)

_DRIVES = "declare drives in the node file: `joint` and `drive`"
_UNSUPPORTED_ELEMENTS = {
    "gazebo": "an extension for Gazebo",
    "transmission": _DRIVES,
    "ros2_control": _DRIVES,
    "safety_controller": "MuJoCo has no such limits",
    "calibration": "nothing to calibrate in a simulation",
}
_NUMBERS = re.compile(
    "xyz|rpy|size|radius|length|scale|value|i[xyz][xyz]|lower|upper|effort|velocity|damping"
    "|friction|rgba|multiplier|offset"
)
_KEPT_NAMES = {"fusestatic": "false", "discardvisual": "false"}


def read_urdf(file: Path, finder: Finder) -> Converted:
    """Read a URDF file.

    Raises:
        DescriptionError: with every missing mesh, or MuJoCo's error about the rest.
    """
    report = Report()
    root = parse(file, report)
    if isinstance(root, Problem):
        report.problems.append(root)
        report.raise_any()
    assert isinstance(root, Element)
    if root.tag != "robot":
        root.problem(f"a URDF file begins with <robot>, not with <{root.tag}>")
    _check_numbers(root)
    unread = _resolve_meshes(root, finder)
    report.raise_any()
    robot = _copy(root)
    block = robot.find("mujoco")
    if block is None:
        block = ElementTree.SubElement(robot, "mujoco")
    compiler = block.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(block, "compiler")
    for key, value in _KEPT_NAMES.items():
        compiler.attrib.setdefault(key, value)
    compiler.attrib.pop("meshdir", None)
    compiler.set("strippath", "false")
    made: dict[str, Triangles] = {}
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, "unicode"))
        for mesh in spec.meshes:
            triangles = triangles_of(Path(mesh.file)) if mesh.file in unread else None
            if triangles is not None:
                mesh.file = ""
                fill(mesh, triangles)
                made[mesh.name] = triangles
        for element in root.descendants():
            if element.tag in _UNSUPPORTED_ELEMENTS:
                element.omit(_UNSUPPORTED_ELEMENTS[element.tag])
            elif element.tag == "mimic" and element.parent is not None:
                _mimic(spec, element, element.parent)
        model, boxed = compile_boxed(spec, made, [])
    except (ValueError, mujoco.FatalError) as error:
        root.problem(f"MuJoCo cannot compile it: {message_of(error)}")
        report.raise_any()
        raise
    links = {element.name: element for element in root.descendants() if element.tag == "link"}
    for geom, slab in boxed:
        links.get(geom.parent.name, root).remark(str(slab))
    return Converted(spec, report.differences(), made, model.nbody - 1, model.njnt)


def _check_numbers(element: Element) -> None:
    """Report infinite numbers, which MuJoCo accepts, and a ``<mimic>`` without numbers."""
    if element.tag in _UNSUPPORTED_ELEMENTS:
        return
    for key, text in element.attributes.items():
        for word in (text.split() or [""]) if _NUMBERS.fullmatch(key) else ():
            try:
                is_wrong = not math.isfinite(float(word))
            except ValueError:
                is_wrong = element.tag == "mimic"  # MuJoCo reports the others
            if is_wrong:
                element.problem(f"{key} must be finite, not '{word}'")
    for child in element.children:
        _check_numbers(child)


def _resolve_meshes(root: Element, finder: Finder) -> set[str]:
    """Give every mesh an absolute path; returns the paths that need conversion."""
    unread: set[str] = set()
    here, compiler = root.file.parent, root.child("mujoco", "compiler")
    folder = Path("" if compiler is None else compiler.attributes.get("meshdir", ""))
    for element in root.descendants():
        if element.tag != "mesh" or "filename" not in element.attributes:
            continue
        uri = element.attributes["filename"]
        try:
            try:
                path = finder.find_file(uri, here)
            except NotFound:
                path = finder.find_file(str(folder / Path(uri).name), here)
        except NotFound:
            hint = "name the folder of the package with -I, or in ROS_PACKAGE_PATH"
            element.problem(f"'{uri}' cannot be found", hint)
            continue
        element.attributes["filename"] = str(path)
        if needs_conversion(path):
            if triangles_of(path) is None:
                element.problem(why_unread(path))
            unread.add(str(path))
    return unread


def _mimic(spec: Any, mimic: Element, joint: Element) -> None:
    """Add the constraint of a ``<mimic>``, which MuJoCo's reader ignores."""
    leader = mimic.attributes.get("joint", "")
    if spec.joint(joint.name) is None or spec.joint(leader) is None:
        mimic.omit(f"one of '{joint.name}' and '{leader}' does not move in MuJoCo")
        return
    offset = float(mimic.attributes.get("offset", 0.0))
    ratio = float(mimic.attributes.get("multiplier", 1.0))
    follow_joint(spec, joint.name, leader, offset, ratio)


def _copy(element: Element) -> ElementTree.Element:
    """A copy for ElementTree, which can write it; prefixes of names may be undeclared."""
    copy = ElementTree.Element(element.tag, element.attributes)
    copy.text = element.text
    copy.extend(map(_copy, element.children))
    return copy
