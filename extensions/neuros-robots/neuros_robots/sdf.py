"""SDF (SDFormat 1.4 to 1.11) to an ``MjSpec``."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco

from neuros.errors import Problem
from neuros_robots import bodies, links
from neuros_robots.elements import DEEPEST, Element, Finder, NotFound, Report, parse
from neuros_robots.frames import Branch, Joint, Link, Scope, grow, place_all, read_scope
from neuros_robots.mjcf import Building, Converted, Meshes, compile_boxed, message_of

_OVERRIDDEN = ("pose", "static", "placement_frame")  # by the children of an <include>
_MOST_LINKS = 1000
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
    spec.compiler.degree = False
    spec.modelname = (scope.element.name or next(iter(scope.models), "")) or "sdf"
    building = Building(spec, Meshes(spec, finder))
    branches, loops = _grow(scope)
    if scope.element.tag == "world":
        _read_world(building, scope)
    for branch in branches:
        bodies.add_body(building, branch)
    links.share_masks(building)
    for branch in branches:
        if branch.joint is not None:
            links.add_joint_sensors(building, branch.link, branch.joint, is_turned=branch.is_turned)
    for joint in loops:
        bodies.close_loop(building, joint)
    bodies.add_mimics(building, scope)
    bodies.add_actuators(building, scope)
    links.add_frames(building, scope)
    links.add_lights(building, scope)
    _exclude_contacts(building, scope)
    report.raise_any()
    model = _compiled(building, root)
    report.omit_unread(includer.roots)
    made = building.meshes.made
    return Converted(spec, report.differences(), made, model.nbody - 1, model.njnt)


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
        model = self._model(include, chain, depth)
        if model is None:
            return []
        if named := include.text_of("name"):
            model.attributes["name"] = named
        for tag in _OVERRIDDEN:
            own = include.child(tag)
            if own is not None:
                own.parent = model
                model.children = [*(c for c in model.children if c.tag != tag), own]
        for child in include.children:
            if child.tag == "plugin" or ":" in child.tag:
                child.omit("an addition to the included model for Gazebo")
        if include.has("merge"):
            return _merged(model, owner)
        model.parent = owner
        return [model]

    def _model(self, include: Element, chain: Sequence[Path], depth: int) -> Element | None:
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
        models = root.each("model")
        if not models:
            uri.problem(f"{file} holds no <model>")
            return None
        models[0].attributes.setdefault("_version", root.attributes.get("version", ""))
        return models[0]


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
        ends = [_end(inner, element, side) for side in ("parent", "child")]
        joint = Joint(element, inner, *ends)
        if not bodies.is_known(joint) or element.name not in inner.frames:
            continue
        if all(end is None or end.is_static for end in ends):
            element.omit("left out: neither of its ends can move")
        elif ends[0] is ends[1]:
            element.problem("joins a link to itself, or to a link that does not exist")
        else:
            movable.append(joint)
    return grow(every_link, movable)


def _end(scope: Scope, joint: Element, side: str) -> Link | None:
    name = joint.text_of(side)
    if not name:
        joint.problem(f"<{side}> is missing: which link is the {side}?")
        return None
    return scope.body(name, joint.child(side) or joint)


def _exclude_contacts(building: Building, scope: Scope) -> None:
    """Exclude contacts between links of one model, unless the model wants them."""
    groups: dict[int, list[str]] = {}
    for inner in scope.and_models():
        outer = inner.outermost
        if outer.self_collides or outer.is_static:
            continue
        names = groups.setdefault(id(outer), [])
        names += [
            building.body(link).name
            for link in inner.links.values()
            if any(id(child) in building.geoms for child in link.element.children)
        ]
        if len(names) > _MOST_LINKS:
            outer.element.problem(
                f"more than {_MOST_LINKS} links of one model collide with other things",
                "set <self_collide>: then no list of pairs is needed",
            )
            return
    for names in groups.values():
        for index, first in enumerate(names):
            for second in names[index + 1 :]:
                building.spec.add_exclude(bodyname1=first, bodyname2=second)


def _compiled(building: Building, root: Element) -> Any:
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model, boxed = compile_boxed(building.spec, building.meshes.made, caught)
    except (ValueError, mujoco.FatalError) as error:
        building.meshes.report_unusable()
        root.report.raise_any()
        root.problem(f"MuJoCo cannot compile the converted model: {message_of(error)}")
        root.report.raise_any()
        raise
    why = {geom.name: str(slab) for geom, slab in boxed}
    for name, mesh in building.colliding_meshes.items():
        mesh.remark(why.get(name, "MuJoCo collides the convex hull of a mesh"))
    for warning in caught:
        root.remark(f"MuJoCo: {' '.join(str(warning.message).split())}")
    return model


def _read_world(building: Building, scope: Scope) -> None:
    """Options of the whole model, from a ``<world>``, with SDF's defaults."""
    world, option = scope.element, building.spec.option
    option.gravity = world.vector("gravity", _GRAVITY)
    option.magnetic = world.vector("magnetic_field", _MAGNETIC_FIELD_T)
    engines = world.each("physics")
    for unused in engines[1:]:
        unused.omit("only the first <physics> is used")
    engine = engines[0] if engines else world.made("physics")
    option.timestep = engine.number("max_step_size", 0.001, positive=True)
