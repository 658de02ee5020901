"""``<include>``: the model of another file in the place of the element."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from neuros.errors import Problem
from neuros.simulators.convert.elements import Element, parse
from neuros.simulators.convert.find import Finder, NotFound
from neuros.simulators.convert.report import Report
from neuros.simulators.convert.values import text_of

_OVERRIDDEN = ("pose", "static", "placement_frame")


class Includer:
    """Replaces the includes of a document, and those of what it includes."""

    def __init__(self, finder: Finder, report: Report) -> None:
        self._finder, self._report = finder, report
        self.roots: list[Element] = []

    def read(self, file: Path, chain: Sequence[Path] = ()) -> Element | None:
        """The root of an SDF file with everything in it that it includes; problems are reported."""
        root = parse(file)
        if isinstance(root, Problem):
            self._report.problems.append(root)
            return None
        if root.tag != "sdf":
            self._report.problem(root, f"an SDF file begins with <sdf>, not with <{root.tag}>")
            return None
        root.taken = True
        self.roots.append(root)
        self._expand(root, (*chain, file))
        return root

    def _expand(self, owner: Element, chain: Sequence[Path]) -> None:
        expanded: list[Element] = []
        for child in owner.children:
            if child.tag == "include":
                child.taken = True
                expanded += self._included(child, owner, chain)
            else:
                if child.tag in ("world", "model"):
                    self._expand(child, chain)
                expanded.append(child)
        owner.children = expanded

    def _included(self, include: Element, owner: Element, chain: Sequence[Path]) -> list[Element]:
        model = self._model(include, chain)
        if model is None:
            return []
        named = text_of(include, "name")
        if named:
            model.attributes["name"] = named
        for tag in _OVERRIDDEN:
            own = include.child(tag)
            if own is None:
                continue
            model.children = [child for child in model.children if child.tag != tag]
            own.parent = model
            model.children.append(own)
        for child in include.children:
            if child.tag == "plugin" or ":" in child.tag:
                self._report.note(child, "an addition to the included model for Gazebo")
        if include.attributes.get("merge", "false") in ("true", "1"):
            return _merged(model, owner, self._report)
        model.parent = owner
        return [model]

    def _model(self, include: Element, chain: Sequence[Path]) -> Element | None:
        uri = include.child("uri")
        if uri is None or not uri.text:
            self._report.problem(include, "<uri> is missing: which model is to be included?")
            return None
        try:
            file = model_file(self._finder.find(uri.text, include.file.parent))
        except NotFound as error:
            self._report.problem(uri, str(error), error.hint)
            return None
        if file in chain:
            circle = " -> ".join(link.name for link in (*chain[chain.index(file) :], file))
            self._report.problem(uri, f"the file includes itself: {circle}")
            return None
        root = self.read(file, chain)
        if root is None:
            return None
        models = root.each("model")
        if not models:
            self._report.problem(uri, f"{file} holds no <model>")
            return None
        version = root.attributes.get("version", "")
        models[0].attributes.setdefault("_version", version)
        return models[0]


def model_file(path: Path) -> Path:
    """The SDF file behind a URI: itself, or what ``model.config`` of a folder names last.

    Raises :class:`NotFound`.
    """
    if not path.is_dir():
        return path
    config = path / "model.config"
    if config.is_file():
        root = parse(config)
        if isinstance(root, Problem):
            raise NotFound(str(root))
        named = [element for element in root.each("sdf") if element.text]
        if named:
            newest = max(named, key=lambda element: _version(element.attributes.get("version", "")))
            file = path / newest.text
            if not file.is_file():
                raise NotFound(f"{newest.place} names '{newest.text}', which does not exist")
            return file
    file = path / "model.sdf"
    if file.is_file():
        return file
    raise NotFound(f"the folder '{path}' has neither a model.config nor a model.sdf")


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) if part.isdigit() else 0 for part in text.split("."))


def _merged(model: Element, owner: Element, report: Report) -> list[Element]:
    """The content of a model as if it stood in ``owner`` itself (``merge="true"``).

    A frame stands for the model's own: all that was relative to that is relative to it now.
    """
    proxy = f"_merged__{model.name}__model__"
    frame = Element("frame", {"name": proxy}, model.file, model.line, model.column, owner)
    placement = model.child("placement_frame")
    if placement is not None:
        report.note(placement, "not used in a merged include")
    poses = model.each("pose")
    for pose in poses:
        pose.parent = frame
    frame.children = poses
    for child in model.children:
        child.parent = owner
        if child.tag in ("link", "model", "frame"):
            _rebase(child, proxy)
        elif child.tag == "joint":
            for part in ("parent", "child"):
                _replace_text(child, part, proxy)
    for tag in ("static", "self_collide"):
        for element in model.each(tag):
            report.note(element, "the model that a merged include becomes part of decides this")
    left_out = {"pose", "placement_frame", "static", "self_collide"}
    return [frame, *(child for child in model.children if child.tag not in left_out)]


def _rebase(element: Element, proxy: str) -> None:
    if element.tag == "frame" and element.attributes.get("attached_to") in (None, "", "__model__"):
        element.attributes["attached_to"] = proxy
    pose = next((child for child in element.children if child.tag == "pose"), None)
    if pose is None:
        pose = Element("pose", {}, element.file, element.line, element.column, element)
        element.children.append(pose)
    if pose.attributes.get("relative_to") in (None, "", "__model__"):
        default = element.attributes.get("attached_to", proxy)
        pose.attributes["relative_to"] = default if element.tag == "frame" else proxy


def _replace_text(owner: Element, tag: str, proxy: str) -> None:
    for child in owner.children:
        if child.tag == tag and child.text == "__model__":
            child.text = proxy
