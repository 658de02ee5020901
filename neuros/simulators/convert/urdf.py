"""URDF to an ``MjSpec``: MuJoCo reads it; meshes are found, unsupported elements listed.

MuJoCo joins links that cannot move against each other, and leaves visuals out; both are switched
off, so that the names of all links are there, unless the ``<mujoco>`` element says otherwise.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco

from neuros.errors import Problem
from neuros.simulators.convert.elements import Element, parse
from neuros.simulators.convert.find import Finder, NotFound
from neuros.simulators.convert.joints import follow_joint
from neuros.simulators.convert.meshes import (
    Triangles,
    box_flat_meshes,
    fill,
    has_flat_meshes,
    needs_conversion,
    triangles_of,
    why_unread,
)
from neuros.simulators.convert.output import Converted
from neuros.simulators.convert.report import Report

_UNSUPPORTED_ELEMENTS = {
    "gazebo": "an extension for Gazebo",
    "transmission": "declare drives in the node file: `joint` and `drive`",
    "ros2_control": "declare drives in the node file: `joint` and `drive`",
    "safety_controller": "MuJoCo has no such limits",
    "calibration": "nothing to calibrate in a simulation",
}
_KEPT_NAMES = {"fusestatic": "false", "discardvisual": "false"}


def read_urdf(file: Path, finder: Finder) -> Converted:
    """Read a URDF file.

    Raises:
        DescriptionError: with every mesh that cannot be found, or what MuJoCo says of the rest.
    """
    report = Report()
    root = parse(file)
    if isinstance(root, Problem):
        report.problems.append(root)
        report.raise_any()
    assert isinstance(root, Element)
    if root.tag != "robot":
        report.problem(root, f"a URDF file begins with <robot>, not with <{root.tag}>")
    tree = ElementTree.ElementTree(_copy(root))
    converted = _resolve_meshes(tree, root, finder, report)
    report.raise_any()
    _keep_names(tree)
    spec, made = _spec(tree, root, converted, report)
    for element in _all(root):
        if element.tag in _UNSUPPORTED_ELEMENTS:
            report.note(element, _UNSUPPORTED_ELEMENTS[element.tag])
        elif element.tag == "mimic" and element.parent is not None:
            _mimic(spec, element, report)
    model = spec.copy().compile()
    return Converted(spec, report.not_taken(), made, model.nbody - 1, model.njnt)


def _resolve_meshes(
    tree: ElementTree.ElementTree[Any], root: Element, finder: Finder, report: Report
) -> dict[str, Path]:
    """Give every mesh an absolute path; those that MuJoCo does not read are returned."""
    converted: dict[str, Path] = {}
    folder = _mesh_folder(root)
    for element, twin in zip(_all(root), tree.getroot().iter(), strict=True):
        if element.tag != "mesh" or "filename" not in element.attributes:
            continue
        uri = element.attributes["filename"]
        try:
            try:
                path = finder.find_file(uri, root.file.parent)
            except NotFound:
                path = finder.find_file(str(folder / Path(uri).name), root.file.parent)
        except NotFound:
            hint = "name the folder of the package with -I, or in ROS_PACKAGE_PATH"
            report.problem(element, f"'{uri}' cannot be found", hint)
            continue
        twin.set("filename", str(path))
        if needs_conversion(path):
            if triangles_of(path) is None:
                report.problem(element, why_unread(path))
            converted[str(path)] = path
    return converted


def _mesh_folder(root: Element) -> Path:
    compiler = root.child("mujoco", "compiler")
    return Path("" if compiler is None else compiler.attributes.get("meshdir", ""))


def _keep_names(tree: ElementTree.ElementTree[Any]) -> None:
    robot = tree.getroot()
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


def _spec(
    tree: ElementTree.ElementTree[Any], root: Element, converted: dict[str, Path], report: Report
) -> tuple[Any, dict[str, Triangles]]:
    made: dict[str, Triangles] = {}
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(tree.getroot(), "unicode"))
        for mesh in spec.meshes:
            triangles = triangles_of(converted[mesh.file]) if mesh.file in converted else None
            if triangles is not None:
                mesh.file = ""
                fill(mesh, triangles)
                made[mesh.name] = triangles
        _compile(spec, made, root, report)
    except (ValueError, mujoco.FatalError) as error:
        text = " ".join(str(error).removeprefix("Error: ").split())
        report.problem(root, f"MuJoCo cannot compile it: {text}")
        report.raise_any()
        raise
    return spec, made


def _compile(spec: Any, made: dict[str, Triangles], root: Element, report: Report) -> None:
    """Compile a copy, with boxes for flat meshes; raises what MuJoCo does."""
    try:
        if not has_flat_meshes(spec.copy().compile()):
            return
    except ValueError:
        pass  # perhaps for a flat mesh; if not, it is raised again below
    links = {element.name: element for element in _all(root) if element.tag == "link"}
    for geom, slab in box_flat_meshes(spec, made):
        report.remark(links.get(geom.parent.name, root), str(slab))
    spec.copy().compile()


def _mimic(spec: Any, mimic: Element, report: Report) -> None:
    """MuJoCo's reader passes over ``<mimic>``: the joint follows another one."""
    joint, leader = mimic.parent, mimic.attributes.get("joint", "")
    assert joint is not None
    if spec.joint(joint.name) is None or spec.joint(leader) is None:
        report.note(mimic, f"one of '{joint.name}' and '{leader}' does not move in MuJoCo")
        return
    offset, ratio = (
        float(mimic.attributes.get(key, default))
        for key, default in (("offset", 0.0), ("multiplier", 1.0))
    )
    follow_joint(spec, joint.name, leader, offset, ratio)


def _copy(element: Element) -> ElementTree.Element:
    """A copy that can be written as XML, in this order; prefixes of names may be undeclared."""
    copy = ElementTree.Element(element.tag, element.attributes)
    copy.text = element.text
    copy.extend(map(_copy, element.children))
    return copy


def _all(element: Element) -> Iterator[Element]:
    yield element
    for child in element.children:
        yield from _all(child)
