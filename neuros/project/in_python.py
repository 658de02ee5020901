"""Projects that a program describes by objects, in place of JSON files.

The objects hold the values of the keys of JSON. The loader gets them as if it had read them from
files, so every check and every error is the same; a place in a message names the object.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

from neuros.distribution import PACKAGE
from neuros.errors import UsageError
from neuros.hooks import hook_specs_of
from neuros.project.message_types import in_full
from neuros.project.parsed import ENDS, ParsedProject
from neuros.project.paths import Roots
from neuros.project.scanner import Element, Source, escape, parse

Plugin: TypeAlias = (
    "str | os.PathLike[str] | ModuleType | Callable[..., Any] | Sequence[Callable[..., Any]]"
)
"""What a plugin is in Python: a file, an installed module, or functions."""
Ports: TypeAlias = "Mapping[str, str | Mapping[str, Any]]"
"""By name of the port: its message type, or its keys in a node file."""

_Part = TypeVar("_Part")

FILE = "neuros.Project"
"""Stands for the project file in messages."""
_ADVICE = "put @neuros_function(...) or @neuros_tick(...) of neuros.hooks above it"


class PythonNode:
    """A node of a project in Python; it has what a node file has::

        cart = neuros.Node("cart", plugin=step, outputs={"x": "std_msgs/Float64"})

    ``cart["x"]`` is its port ``x``, and ``cart["x"] >> brain["x"]`` a connection.

    Args:
        name: unique in the project.
        plugin: the path of a Python file, from the folder of the project; the name of an installed
            module; a module; or functions with a decorator of :mod:`neuros.hooks`, one or a list.
        inputs, outputs: by name of the port, its message type, or its keys in a node file:
            ``{"imu": {"type": "sensor_msgs/Imu", "mujoco": {...}}}``.
        container: what it runs in.
        keys: the other keys of a node file: ``environment``, ``parameters``, ``affinity``, ....

    Raises:
        UsageError: if a function has no such decorator, or JSON has no such value.
    """

    def __init__(
        self,
        name: str,
        plugin: Plugin | None = None,
        *,
        inputs: Ports | None = None,
        outputs: Ports | None = None,
        container: str = "neuros_python",
        **keys: Any,
    ) -> None:
        self.name = name
        self.hooks = functions_of(plugin)
        # Not NAME.py, which would hide a module of that name from all plugins.
        written = f"{name}_plugin.py" if self.hooks else plugin_key(plugin)
        content = {
            "name": name,
            "container": container,
            **({} if written is None else {"plugin": written}),
            "inputs": self._listed("inputs", inputs or {}),
            "outputs": self._listed("outputs", outputs or {}),
            **keys,
        }
        self._text = _json(repr(self), content)

    def __getitem__(self, port: str) -> PythonPort:
        """An input or output, for a connection."""
        return PythonPort(self, port)

    def __repr__(self) -> str:
        return f"neuros.Node({self.name!r})"

    def element(self, folder: Path) -> Element:
        """What a node file in this folder would hold; a pointer names a port by its name."""
        element = _element(repr(self), folder, self._text)
        for side in ("inputs", "outputs"):
            for port in element.items(side):
                _point(port, f"/{side}/{escape(str(port.value['name'].value))}")
        return element

    def _listed(self, side: str, ports: Ports) -> list[Any]:
        if not isinstance(ports, Mapping):
            raise UsageError(
                f"{self!r}: {side}: give the message type of each port by its name:"
                f' {side}={{"x": "std_msgs/Float64"}}'
            )
        keys = {k: {**v} if isinstance(v, Mapping) else {"type": v} for k, v in ports.items()}
        for name, of in keys.items():
            if "name" in of:
                raise UsageError(f"{self!r}: {side}: leave out the key 'name' of port '{name}'")
            if isinstance(of.get("type"), str):
                of["type"] = in_full(of["type"])
        return [{"name": name, **of} for name, of in keys.items()]


@dataclass(frozen=True)
class PythonPort:
    """A port of a node in Python: an output at the left of ``>>``, an input at the right."""

    node: PythonNode
    name: str

    def __rshift__(self, to: PythonPort) -> PythonConnection:
        """A connection whose sender never waits; it may lose packets."""
        return PythonConnection(self, to)

    def __repr__(self) -> str:
        return f"{self.node.name}[{self.name!r}]"


class PythonConnection:
    """A connection of a project in Python, from an output to an input::

        neuros.Connection(cart["x"], brain["x"], discard_limit=0)

    Without keys it is ``cart["x"] >> brain["x"]``.

    Args:
        source: the output.
        destination: the input.
        keys: the other keys of a connection in a project file: ``discard_limit``, ``queue_size``,
            ``transport``.

    Raises:
        UsageError: if an end is no port, or JSON has no such value.
    """

    def __init__(self, source: PythonPort, destination: PythonPort, **keys: Any) -> None:
        for end in (source, destination):
            if not isinstance(end, PythonPort):
                what = repr(end.name) if isinstance(end, PythonNode) else repr(end)
                raise UsageError(
                    f'{source!r} >> {destination!r}: {what} is no port: name one, as in node["x"]'
                )
        self._name = f"{source!r} >> {destination!r}"
        ends = (source.node.name, source.name, destination.node.name, destination.name)
        self._text = _json(self._name, {**dict(zip(ENDS, ends, strict=True)), **keys})

    def __repr__(self) -> str:
        return self._name

    def element(self, folder: Path) -> Element:
        """What the project file would hold."""
        return _element(self._name, folder, self._text)


@dataclass(frozen=True)
class PythonProject:
    """A project of objects, in the place of a project file.

    Attributes:
        folder: from which paths in the project begin; resolved.
        keys: of the project file, but for nodes and connections.
    """

    folder: Path
    nodes: tuple[PythonNode, ...]
    connections: tuple[PythonConnection, ...]
    keys: Mapping[str, Any]

    @classmethod
    def of(
        cls,
        nodes: Iterable[PythonNode],
        connections: Iterable[PythonConnection],
        folder: str | os.PathLike[str] | None,
        keys: Mapping[str, Any],
    ) -> PythonProject:
        """Check the arguments of ``neuros.Project``.

        Raises:
            UsageError: if one is of another type, or there is no such folder.
        """
        hint = "; neuros.Project.from_file reads files"
        own = _all_of(nodes, PythonNode, "nodes", f"neuros.Node(...){hint}")
        wires = _all_of(connections, PythonConnection, "connections", 'a["x"] >> b["y"]')
        here = Path.cwd() if folder is None else Path(folder).resolve()
        if not here.is_dir():
            raise UsageError(f"folder={os.fspath(here)!r}: there is no such folder")
        return cls(here, own, wires, keys)

    @property
    def files(self) -> list[str]:
        """The names of the node files that it would have."""
        return [f"{node.name}.json" for node in self.nodes]

    def parsed(self, roots: Roots) -> ParsedProject:
        """The elements that the files of the project would have.

        Raises:
            SourceError: for a value that JSON does not have, such as NaN.
        """
        content = {**self.keys, "nodes": self.files, "connections": []}
        root = _element(FILE, self.folder, _json(FILE, content))
        root.value["connections"].value = [each.element(self.folder) for each in self.connections]
        parsed = ParsedProject(root, roots, entries=root.items("nodes"))
        for node in self.nodes:
            element = node.element(self.folder)
            parsed.nodes.append(element)
            if node.hooks:
                parsed.functions.append((element.value["plugin"], node.hooks))
        return parsed


def functions_of(plugin: object) -> tuple[Callable[..., Any], ...]:
    """The functions that a plugin consists of; empty if it is a file or a module.

    Raises:
        UsageError: if one of them has no decorator of :mod:`neuros.hooks`.
    """
    if plugin is None or isinstance(plugin, str | os.PathLike | ModuleType):
        return ()
    listed = plugin if isinstance(plugin, list | tuple) else [plugin]
    if not listed:
        raise UsageError("plugin=[] has no function: give one with a decorator of neuros.hooks")
    for function in listed:
        if not callable(function):
            raise UsageError(f"plugin: {function!r} is neither a function, a path nor a module")
        if not hook_specs_of({"": function}):
            name = getattr(function, "__name__", repr(function))
            raise UsageError(f"plugin: the function '{name}' is no hook: {_ADVICE}")
    return tuple(listed)


def is_installed(file: str) -> bool:
    """Whether a module is one of this Python, or NeuROS's, and not of the user's own folder."""
    folders = (Path(sys.prefix), Path(sys.base_prefix), PACKAGE)
    return any(Path(file).is_relative_to(folder) for folder in folders)


def plugin_key(plugin: Any) -> str | None:
    """The value of the key ``plugin`` for a file or module.

    Raises:
        UsageError: for a module without a file.
    """
    if isinstance(plugin, ModuleType):
        file = getattr(plugin, "__file__", None)
        if file is None:
            raise UsageError(f"plugin: the module '{plugin.__name__}' has no file: give functions")
        return plugin.__name__ if is_installed(file) else file
    return None if plugin is None else os.fspath(plugin)


def _all_of(given: Any, kind: type[_Part], name: str, shown: str) -> tuple[_Part, ...]:
    parts = tuple(given) if isinstance(given, Iterable) else (given,)
    for index, each in enumerate(parts):
        if not isinstance(each, kind):
            raise UsageError(f"{name}[{index}] is {each!r}: give {shown}")
    return parts


def _json(name: str, content: Mapping[str, Any]) -> str:
    texts = []
    for key, value in content.items():
        try:
            texts.append(f"{json.dumps(key)}: {json.dumps(value, default=_plain)}")
        except (TypeError, ValueError, RecursionError) as error:
            raise UsageError(f"{name}: {key}: {error}") from None
    return f"{{{', '.join(texts)}}}"


def _plain(value: Any) -> Any:
    """A path as text, a NumPy array or number as list or number."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{value!r} is no value of JSON")


def _element(name: str, folder: Path, text: str) -> Element:
    element, _ = parse(Source(name, folder, text, folder / name, has_lines=False))
    return element


def _point(element: Element, pointer: str) -> None:
    """Give an element another pointer, and those in it."""
    old = element.pointer
    inner = element.value.values() if isinstance(element.value, dict) else element.value
    for each in inner if isinstance(element.value, dict | list) else ():
        _point(each, pointer + each.pointer.removeprefix(old))
    element.pointer = pointer
