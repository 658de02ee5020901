"""Files that a description names: found by URI, and put in the place of an ``<include>``.

URIs are ``model://``, ``package://``, ``file://``, or a path.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

from neuros.errors import Problem
from neuros.simulators.convert.elements import DEEPEST, Element, Report, parse

PATH_VARIABLES = (
    "SDF_PATH",
    "GZ_SIM_RESOURCE_PATH",
    "IGN_GAZEBO_RESOURCE_PATH",
    "GAZEBO_MODEL_PATH",
    "ROS_PACKAGE_PATH",
)
_REMOTE = ("http://", "https://", "fuel://")
_OVERRIDDEN = ("pose", "static", "placement_frame")  # by the children of an <include>


class NotFound(Exception):
    """A URI that leads nowhere; the text says where was looked, the hint what to do."""

    def __init__(self, text: str, hint: str = "") -> None:
        self.hint = hint
        super().__init__(text)


@dataclass(frozen=True)
class Finder:
    """Looks up URIs.

    ``model://name/...`` and ``package://name/...`` are looked up in ``folders``, then in the
    folders above the file that names them: there a model lies beside its neighbours. A package may
    also lie in ``share`` of a ROS installation.
    """

    folders: Sequence[Path] = ()
    packages: Sequence[Path] = field(default=())

    def find(self, uri: str, here: Path) -> Path:
        """The file or folder behind ``uri``, which a file in the folder ``here`` names.

        Raises :class:`NotFound`.
        """
        if uri.startswith(_REMOTE):
            raise NotFound(
                f"'{uri}' is on the network", "download it, for instance with `gz fuel download`"
            )
        scheme, colon, rest = uri.partition("://")
        if not colon:
            candidates = iter([here / uri, *(folder / uri for folder in self.folders)])
        elif scheme == "file":
            candidates = iter([Path(unquote(rest)), here / unquote(rest)])
        elif scheme in ("model", "package"):
            candidates = self._by_name(unquote(rest), here, scheme)
        else:
            raise NotFound(f"'{uri}': there is no way to look up '{scheme}://'")
        for candidate in candidates:
            if os.path.exists(candidate):  # which fails for no name, however long
                return candidate.resolve()
        hint = f"name its folder with -I, or in {' or '.join(PATH_VARIABLES[:2])}"
        raise NotFound(f"'{uri}' cannot be found", "" if scheme == "file" else hint)

    def find_file(self, uri: str, here: Path) -> Path:
        """The file behind ``uri``; a folder is not found."""
        found = self.find(uri, here)
        if not found.is_file():
            raise NotFound(f"'{uri}' is not a file")
        return found

    def _by_name(self, rest: str, here: Path, scheme: str) -> Iterator[Path]:
        name, _, inside = rest.partition("/")
        for folder in (*self.folders, *([] if scheme == "model" else self.packages)):
            yield folder / name / inside
            if folder.name == name:  # the folder of the model itself was named
                yield folder / inside
        for folder in (here, *here.parents):
            yield folder / name / inside


def finder(folders: Sequence[Path], environ: Mapping[str, str]) -> Finder:
    """The usual one: ``folders`` of the user's own first, then those in the environment."""
    found = [folder.resolve() for folder in folders]
    for variable in PATH_VARIABLES:
        found += [Path(text) for text in environ.get(variable, "").split(os.pathsep) if text]
    prefixes = environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return Finder(tuple(found), tuple(Path(text) / "share" for text in prefixes if text))


class Includer:
    """Replaces the ``<include>`` elements of a document, and of what it includes, by models."""

    def __init__(self, finder: Finder, report: Report) -> None:
        self._finder, self._report = finder, report
        self.roots: list[Element] = []

    def read(self, file: Path, chain: Sequence[Path] = (), depth: int = 0) -> Element | None:
        """The root of an SDF file with everything in it that it includes; problems are reported."""
        root = parse(file, self._report)
        if isinstance(root, Problem):
            self._report.problems.append(root)
            return None
        if root.tag != "sdf":
            root.problem(f"an SDF file begins with <sdf>, not with <{root.tag}>")
            return None
        root.taken = True
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
                child.taken = True
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
                child.note("an addition to the included model for Gazebo")
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
    """The SDF file behind a URI: itself, or the newest that ``model.config`` of a folder names.

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
            newest = max(named, key=lambda element: _version(element.attributes.get("version", "")))
            file = path / newest.text
            if not os.path.isfile(file):
                raise NotFound(f"{newest.place} names '{newest.text}', which does not exist")
            return file
    file = path / "model.sdf"
    if file.is_file():
        return file
    raise NotFound(f"the folder '{path}' has neither a model.config nor a model.sdf")


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) if part.isdecimal() else 0 for part in text[:20].split("."))


def _merged(model: Element, owner: Element) -> list[Element]:
    """The content of a model as if it stood in ``owner`` itself (``merge="true"``).

    A frame stands for the model's own: all that was relative to that is relative to it now.
    """
    proxy = f"_merged__{model.name}__model__"
    frame = model.made("frame", name=proxy)
    frame.parent = owner
    placement = model.child("placement_frame")
    if placement is not None:
        placement.note("not used in a merged include")
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
            element.note("not used in a merged include: the model around it decides")
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
