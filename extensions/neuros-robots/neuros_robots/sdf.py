"""SDF (SDFormat 1.4 to 1.11) to an ``MjSpec``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import mujoco

from neuros.errors import Problem
from neuros.project.scanner import display_name
from neuros_robots import bodies, links
from neuros_robots.elements import DEEPEST, Element, Finder, NotFound, Report, parse
from neuros_robots.frames import Branch, Joint, Link, Scope, grow, place_all, read_scope
from neuros_robots.mjcf import Building, Converted, Meshes, finished

_INCLUDED = ("model", "light", "actor")
_OVERRIDDEN = ("pose", "static", "placement_frame")  # by the children of an <include>
_GRAVITY = (0.0, 0.0, -9.8)
_MAGNETIC_FIELD_T = (5.5645e-6, 22.8758e-6, -42.3884e-6)


def convert_sdf(file: Path, finder: Finder) -> Converted:
    """Convert the world of an SDF file, or else its model; ``finder`` finds the files it names.

    Raises:
        DescriptionError: with every problem of the file and of the files that it includes.
    """
    report = Report()
    includer = Includer(finder, report)
    root = includer.read(file.resolve())
    if root is None:
        report.raise_any()
    assert root is not None
    scope = _read(root)
    spec = mujoco.MjSpec()
    spec.modelname = (scope.element.name or next(iter(scope.models), "")) or "sdf"
    building = Building(spec, Meshes(spec, finder))
    branches, loops = _grow(scope)
    if scope.element.tag == "world":
        # Options of the whole model, from a ``<world>``, with SDF's defaults.
        world, option = scope.element, building.spec.option
        option.gravity = world.vector("gravity", _GRAVITY)
        option.magnetic = world.vector("magnetic_field", _MAGNETIC_FIELD_T)
        engines = world.each("physics")
        for unused in engines[1:]:
            unused.omit("only the first <physics> is used")
        engine = engines[0] if engines else world.made("physics")
        option.timestep = engine.number("max_step_size", 0.001, positive=True)
    bodies.add_tree(building, scope, branches)
    for joint in loops:
        bodies.close_loop(building, joint)
    bodies.add_actuators(building, scope)
    links.add_frames(building, scope)
    links.add_lights(building, scope)
    return finished(building, includer.roots)


class Includer:
    """Replaces ``<include>`` elements of a document by the included models, recursively."""

    def __init__(self, finder: Finder, report: Report) -> None:
        self._finder, self._report = finder, report
        self.roots: list[Element] = []

    def read(self, file: Path, chain: Sequence[Path] = (), depth: int = 0) -> Element | None:
        """The root of an SDF file with all its included models; problems are reported."""
        root = parse(file, self._report)
        if isinstance(root, Problem):
            self._report.problems.append(root)
            return None
        if root.tag != "sdf":
            root.problem(f"an SDF file begins with <sdf>, not with <{root.tag}>")
            return None
        root.is_read = True
        self.roots.append(root)
        self._expand(root, (*chain, file), depth)
        return root

    def _expand(self, owner: Element, chain: Sequence[Path], depth: int) -> None:
        if depth > DEEPEST:
            owner.problem(f"more than {DEEPEST} models are nested in each other")
            return
        expanded: list[Element] = []
        for child in owner.children:
            if child.tag == "include":
                child.is_read = True
                expanded += self._included(child, owner, chain, depth)
            else:
                if child.tag in ("world", "model"):
                    self._expand(child, chain, depth + 1)
                expanded.append(child)
        owner.children = expanded

    def _included(
        self, include: Element, owner: Element, chain: Sequence[Path], depth: int
    ) -> list[Element]:
        model = self._content(include, chain, depth)
        if model is None:
            return []
        if named := include.text_of("name"):
            model.attributes["name"] = named
        for tag in _OVERRIDDEN:
            own = include.child(tag)
            if own is not None and (model.tag == "model" or tag == "pose"):
                own.parent = model
                model.children = [*(c for c in model.children if c.tag != tag), own]
        for child in include.children:
            if child.tag == "plugin" or ":" in child.tag:
                child.omit("an addition to the included model for Gazebo")
        if include.has("merge") and model.tag == "model":
            return _merged(model, owner)
        model.parent = owner
        return [model]

    def _content(self, include: Element, chain: Sequence[Path], depth: int) -> Element | None:
        """The model, light or actor that a file holds."""
        uri = include.child("uri")
        if uri is None or not uri.text:
            include.problem("<uri> is missing: which model is to be included?")
            return None
        try:
            file = model_file(self._finder.find(uri.text, include.file.parent))
        except NotFound as error:
            uri.problem(str(error), error.hint)
            return None
        if file in chain:
            circle = " -> ".join(link.name for link in (*chain[chain.index(file) :], file))
            uri.problem(f"the file includes itself: {circle}")
            return None
        root = self.read(file, chain, depth)
        if root is None:
            return None
        found = next((e for tag in _INCLUDED for e in root.children if e.tag == tag), None)
        if found is None:
            uri.problem(f"{display_name(file)} holds no <{'>, <'.join(_INCLUDED)}>")
            return None
        found.is_read = found.tag != "actor"  # which is listed
        found.attributes.setdefault("_version", root.attributes.get("version", ""))
        return found


def model_file(path: Path) -> Path:
    """The SDF file of a URI: the path, or the newest file that the folder's ``model.config`` names.

    Raises :class:`NotFound`.
    """
    if not os.path.isdir(path):
        return path
    config = path / "model.config"
    if config.is_file():
        root = parse(config, Report())
        if isinstance(root, Problem):
            raise NotFound(str(root))
        named = [element for element in root.each("sdf") if element.text]
        if named:
            # Each part of a version as a number, 0 where it is none.
            newest = max(
                named,
                key=lambda element: [
                    int(part) if part.isdecimal() else 0
                    for part in element.attributes.get("version", "")[:20].split(".")
                ],
            )
            file = path / newest.text
            if not os.path.isfile(file):
                raise NotFound(f"{newest.place} names '{newest.text}', which does not exist")
            return file
    file = path / "model.sdf"
    if file.is_file():
        return file
    raise NotFound(f"the folder '{path}' has neither a model.config nor a model.sdf")


def _merged(model: Element, owner: Element) -> list[Element]:
    """The content of a model as part of ``owner`` (``merge="true"``).

    A frame replaces the model's own frame: poses relative to the model become relative to it.
    """
    proxy = f"_merged__{model.name}__model__"
    frame = model.made("frame", name=proxy)
    frame.parent = owner
    placement = model.child("placement_frame")
    if placement is not None:
        placement.omit("not used in a merged include")
    frame.children = model.each("pose")
    for pose in frame.children:
        pose.parent = frame
    for child in model.children:
        child.parent = owner
        if child.tag in ("link", "model", "frame"):
            _rebase(child, proxy)
        elif child.tag == "joint":
            for end in child.children:
                if end.tag in ("parent", "child") and end.text == "__model__":
                    end.text = proxy
    for tag in ("static", "self_collide"):
        for element in model.each(tag):
            element.omit("not used in a merged include: the model around it decides")
    left_out = {"pose", "placement_frame", "static", "self_collide"}
    return [frame, *(child for child in model.children if child.tag not in left_out)]


def _rebase(element: Element, proxy: str) -> None:
    if element.tag == "frame" and element.attributes.get("attached_to") in (None, "", "__model__"):
        element.attributes["attached_to"] = proxy
    pose = next((child for child in element.children if child.tag == "pose"), None)
    if pose is None:
        pose = element.made("pose")
        pose.parent = element
        element.children.append(pose)
    if pose.attributes.get("relative_to") in (None, "", "__model__"):
        default = element.attributes.get("attached_to", proxy)
        pose.attributes["relative_to"] = default if element.tag == "frame" else proxy


def _read(root: Element) -> Scope:
    """The world of a file; a model without a world gets an empty one."""
    worlds = root.each("world")
    for other in worlds[1:]:
        other.omit("only the first world of a file is converted")
    element = worlds[0] if worlds else root
    if worlds and not worlds[0].name:
        worlds[0].problem("the <world> has no name")
    if not worlds and not root.each("model"):
        root.problem("there is neither a <world> nor a <model> in it")
    scope = read_scope(element)
    place_all(scope)
    return scope


def _grow(scope: Scope) -> tuple[list[Branch], list[Joint]]:
    every_link = [link for inner in scope.and_models() for link in inner.links.values()]
    movable = []
    for inner, element in scope.each("joint"):
        ends = parent, child = tuple(_end(inner, element, side) for side in ("parent", "child"))
        if not bodies.is_known(element, bodies.SDF_TYPES) or element.name not in inner.frames:
            continue
        if all(end is None or end.is_static for end in ends):
            element.omit("left out: neither of its ends can move")
        elif parent is child:
            element.problem("joins a link to itself, or to a link that does not exist")
        else:
            anchor = inner.pose @ inner.place(element.name, element)
            movable.append(Joint(element, inner, parent, child, anchor))
    return grow(every_link, movable)


def _end(scope: Scope, joint: Element, side: str) -> Link | None:
    name = joint.text_of(side)
    if not name:
        joint.problem(f"<{side}> is missing: which link is the {side}?")
        return None
    return scope.body(name, joint.child(side) or joint)
