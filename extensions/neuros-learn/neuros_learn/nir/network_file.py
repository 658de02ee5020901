"""Reads the graph of a network in NIR from an HDF5 file, and orders its nodes.

Files come from strangers: kinds, links and sizes are checked before an array is read. All problems
are reported together. Source of the format: ``nir.serialization``, nir 1.0.8.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuros.distribution import install_command
from neuros.errors import NodeError
from neuros.project.suggest import listed

MOST_BYTES = 1 << 30
"""Size of all parameters of a file."""
MOST_VALUES = 1 << 24
"""Number of values that one node receives, sends or holds."""
_MOST_NODES, _MOST_EDGES, _DEEPEST, _LONGEST_NAME = 1000, 10_000, 20, 1000

_LARGEST = float(np.finfo(np.float32).max)

_NEURON = ("r", "v_leak")
_POOL = ("kernel_size", "stride", "padding")
_CONVOLUTION = ("weight", "bias", "stride", "padding", "dilation", "groups")
PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "Input": ("shape",),
    "Output": (),
    "Affine": ("weight", "bias"),
    "Linear": ("weight",),
    "Scale": ("scale",),
    "Threshold": ("threshold",),
    "Delay": ("delay",),
    "Flatten": ("start_dim", "end_dim"),
    "Conv1d": _CONVOLUTION,
    "Conv2d": _CONVOLUTION,
    "SumPool2d": _POOL,
    "AvgPool2d": _POOL,
    "I": ("r",),
    "IF": ("r", "v_threshold"),
    "LI": ("tau", *_NEURON),
    "LIF": ("tau", *_NEURON, "v_threshold"),
    "CubaLI": ("tau_mem", "tau_syn", *_NEURON),
    "CubaLIF": ("tau_mem", "tau_syn", *_NEURON, "v_threshold"),
}
"""The required parameters of the supported kinds, beside NIRGraph."""
NEURONS = ("I", "IF", "LI", "LIF", "CubaLI", "CubaLIF")
"""Kinds with a state: their last outputs are known before a step."""
_OPTIONAL = {"v_reset": 0.0, "w_in": 1.0}
_DIMENSIONS = {"Conv1d": 3, "Conv2d": 4}


class NetworkError(NodeError):
    """All problems of a network, or of the parameters of its node."""

    def __init__(self, problems: list[str]) -> None:
        self.problems = problems
        super().__init__("; ".join(problems))


@dataclass(frozen=True)
class Part:
    """A node of NIR: its kind, its parameters, and the nodes whose outputs are summed as input."""

    kind: str
    values: Mapping[str, Any]
    sources: tuple[str, ...]
    is_recurrent: bool = False


@dataclass(frozen=True)
class Graph:
    """A network without nested graphs: nodes by path (``rnn/lif``), in the order of evaluation.

    A source that comes later in this order is a neuron, whose output of the last step is used.
    """

    parts: Mapping[str, Part]

    def names(self, kind: str) -> tuple[str, ...]:
        """The nodes of a kind; ``Input`` and ``Output`` are those of the network itself."""
        return tuple(sorted(path for path, part in self.parts.items() if part.kind == kind))


def read_graph(path: Path) -> Graph:
    """The network in a file.

    Raises:
        NetworkError: the file holds no network in NIR, or an unsupported one.
    """
    try:
        import h5py
    except ImportError:
        needs = f"which is not installed: {install_command('nir')}"
        text = f"networks in NIR are read with h5py, {needs}"
        raise NetworkError([text]) from None
    reader = _Reader(h5py)
    try:
        with h5py.File(path, "r") as file:
            reader.read(file)
    except NetworkError:
        raise
    except Exception as error:  # h5py raises anything on a damaged file
        lines = str(error).splitlines() or [type(error).__name__]
        raise NetworkError([f"{path.name} is no network in NIR: {lines[0]}"]) from None
    if reader.problems:
        raise NetworkError(reader.problems)
    return Graph(_in_order(reader))


class _Reader:
    """Reads nodes and edges, and collects problems.

    Attributes:
        kinds: by path; ``NIRGraph`` for the nested ones.
        feeders: by path, the sources of its input; a nested graph's are those of its Input.
    """

    def __init__(self, h5py: Any) -> None:
        self._h5py = h5py
        self._bytes_left = MOST_BYTES
        self.problems: list[str] = []
        self.kinds: dict[str, str] = {}
        self.values: dict[str, dict[str, Any]] = {}
        self.feeders: dict[str, list[str]] = {}

    def read(self, file: Any) -> None:
        node = self._child(file, "node", self._h5py.Group)
        kind = self._text(node, "type")
        if kind != "NIRGraph":
            raise NetworkError([f"the file holds one {kind or 'thing'} instead of a NIRGraph"])
        self._graph(node, "")
        for kind in ("Input", "Output"):
            if not any(k == kind and "/" not in path for path, k in self.kinds.items()):
                self.problems.append(f"the network has no {kind}")

    def _graph(self, group: Any, prefix: str) -> None:
        if prefix.count("/") > _DEEPEST:
            raise NetworkError([f"graphs lie more than {_DEEPEST} deep in each other"])
        nodes = self._child(group, "nodes", self._h5py.Group)
        for name in nodes:
            if len(self.kinds) >= _MOST_NODES:
                raise NetworkError([f"the network has more than {_MOST_NODES} nodes"])
            path = prefix + name[:_LONGEST_NAME]
            node = self._child(nodes, name, self._h5py.Group)
            kind = self.kinds[path] = self._text(node, "type")
            self.feeders[path] = []
            if kind == "NIRGraph":
                self._graph(node, f"{path}/")
            elif kind in PARAMETERS:
                self._parameters(node, path, kind)
            else:
                text = f"node '{path}': NIR's {kind} is not supported"
                self.problems.append(text if kind else f"node '{path}' has no type")
        for source, target in self._edges(group):
            missing = [name for name in (source, target) if prefix + name not in self.kinds]
            if missing:
                text = f"there is no node '{prefix}{missing[0]}', which an edge names"
                self.problems.append(text)
                continue
            start = self._end(prefix + source, "Output")
            end = self._end(prefix + target, "Input")
            if start and end and start not in self.feeders[end]:
                self.feeders[end].append(start)

    def _end(self, path: str, kind: str) -> str:
        """The end of an edge at a node; at a nested graph, its Input or Output."""
        if self.kinds[path] != "NIRGraph":
            return path
        level = path.count("/") + 1
        inner = [p for p in self.kinds if p.startswith(f"{path}/") and p.count("/") == level]
        ends = [p for p in inner if self.kinds[p] == kind]
        if len(ends) == 1:
            return ends[0]
        self.problems.append(f"nested graph '{path}' must have one {kind}, and has {len(ends)}")
        return ""

    def _edges(self, group: Any) -> Iterator[tuple[str, str]]:
        edges = self._child(group, "edges", self._h5py.Dataset)
        if edges.size == 0:
            return
        if edges.ndim != 2 or edges.shape[1] != 2 or len(edges) > _MOST_EDGES:
            raise NetworkError([f"edges must be at most {_MOST_EDGES} pairs of names"])
        for index in range(len(edges)):  # one by one: names of a malicious file may share bytes
            pair = edges[index]
            if max(map(len, pair)) > _LONGEST_NAME:
                raise NetworkError([f"an edge has a name of more than {_LONGEST_NAME} bytes"])
            yield pair[0].decode("utf-8"), pair[1].decode("utf-8")

    def _parameters(self, node: Any, path: str, kind: str) -> None:
        names = PARAMETERS[kind]
        missing = [name for name in names if name not in node]
        if missing:
            text = f"node '{path}' ({kind}) has no {listed(missing)}"
            self.problems.append(text)
            return
        values = self.values[path] = {name: self._value(node, name, path) for name in names}
        if kind in NEURONS:
            for name, default in _OPTIONAL.items():
                has = name in node
                values[name] = self._value(node, name, path) if has else np.float32(default)
        dimensions = getattr(values.get("weight"), "ndim", 2)
        if dimensions != _DIMENSIONS.get(kind, max(dimensions, 2)):
            text = f"node '{path}' ({kind}) has weights of {dimensions} dimensions"
            self.problems.append(text)
        if kind == "Input" and math.prod(map(int, np.atleast_1d(values["shape"]))) > MOST_VALUES:
            self.problems.append(f"node '{path}' takes more than {MOST_VALUES} values")

    def _value(self, node: Any, name: str, path: str) -> Any:
        """A number or an array of numbers; ``padding`` may be a text."""
        dataset = self._child(node, name, self._h5py.Dataset)
        self._bytes_left -= dataset.nbytes
        if self._bytes_left < 0:
            raise NetworkError([f"the parameters are larger than {MOST_BYTES >> 20} MiB"])
        if self._h5py.check_string_dtype(dataset.dtype) and name == "padding":
            return self._text(node, name)
        value = np.asarray(dataset[()])
        if value.dtype.kind not in "iufb" or not (abs(value) < _LARGEST).all():
            self.problems.append(f"node '{path}': '{name}' holds a value that is no number")
        elif name.startswith("tau") and not (value > 0).all():
            self.problems.append(f"node '{path}': '{name}' must be above 0")
        elif name == "shape" and (value.dtype.kind not in "iu" or (value < 1).any()):
            self.problems.append(f"node '{path}': '{name}' is no shape")
        return value

    def _text(self, group: Any, name: str) -> str:
        if name not in group:
            return ""
        dataset = self._child(group, name, self._h5py.Dataset)
        if not self._h5py.check_string_dtype(dataset.dtype) or dataset.shape != ():
            return ""
        return str(dataset[()].decode("utf-8"))[:_LONGEST_NAME]

    def _child(self, group: Any, name: str, kind: type) -> Any:
        """A group or dataset in the file itself, not behind a link."""
        link = group.get(name, getlink=True)
        found = group[name] if isinstance(link, self._h5py.HardLink) else None
        outside = getattr(found, "external", None) or getattr(found, "is_virtual", False)
        if not isinstance(found, kind) or outside:
            what = f"{group.name.rstrip('/')}/{name}"
            raise NetworkError([f"{what} is not what NIR defines there"])
        return found


# ---------------------------------------------------------------------- order


def _in_order(reader: _Reader) -> dict[str, Part]:
    """The nodes in the order of evaluation, nested graphs resolved.

    A loop is cut behind a neuron, as late in the loop as possible: inputs pass all nodes in one
    step, and only values that go back take another step.
    """
    sources = _sources(reader)
    reach, depth = _reach(sources), _depth(sources)
    order: dict[str, Part] = {}
    left = sorted(sources)
    while left:
        ready = [path for path in left if all(each in order for each in sources[path])]
        if not ready:
            ready = [
                path
                for path in left
                if all(
                    each in order or (reader.kinds[each] in NEURONS and each in reach[path])
                    for each in sources[path]
                )
            ]
            ready = sorted(ready, key=lambda path: (-depth.get(path, 0), path))[:1]
        if not ready:
            raise NetworkError([f"a loop has no neuron that could delay it: {listed(left)}"])
        for path in ready:
            left.remove(path)
            kind = reader.kinds[path]
            values = reader.values[path]
            order[path] = Part(kind, values, tuple(sources[path]), path in reach[path])
    return order


def _sources(reader: _Reader) -> dict[str, list[str]]:
    """The sources of each node; Inputs and Outputs of nested graphs are skipped."""
    inner = {p for p, kind in reader.kinds.items() if kind in ("Input", "Output") and "/" in p}
    resolved: dict[str, list[str]] = {}

    def origins(path: str, through: tuple[str, ...]) -> list[str]:
        if path not in inner:
            return [path]
        if path in through:
            raise NetworkError([f"a loop has no neuron that could delay it: {listed(through)}"])
        if path not in resolved:
            found = [each for p in reader.feeders[path] for each in origins(p, (*through, path))]
            if len(found) > _MOST_EDGES:
                raise NetworkError([f"the network has more than {_MOST_EDGES} edges"])
            resolved[path] = found
        return resolved[path]

    sources: dict[str, list[str]] = {}
    for path, kind in reader.kinds.items():
        if kind != "NIRGraph" and path not in inner:
            sources[path] = [each for p in reader.feeders[path] for each in origins(p, ())]
            if not sources[path] and kind != "Input":
                raise NetworkError([f"nothing leads to node '{path}' ({kind})"])
    return sources


def _reach(sources: Mapping[str, list[str]]) -> dict[str, set[str]]:
    """All nodes that each node's output reaches."""
    targets: dict[str, set[str]] = {path: set() for path in sources}
    for path, feeders in sources.items():
        for each in feeders:
            targets[each].add(path)

    def from_(path: str) -> set[str]:
        found, fresh = set[str](), {path}
        while fresh:
            fresh = set().union(*(targets[each] for each in fresh)) - found
            found |= fresh
        return found

    return {path: from_(path) for path in sources}


def _depth(sources: Mapping[str, list[str]]) -> dict[str, int]:
    """The number of edges from the nearest Input to each node."""
    depth = {path: 0 for path, feeders in sources.items() if not feeders}
    fresh = set(depth)
    for level in range(1, len(sources) + 1):
        fresh = {p for p, feeders in sources.items() if p not in depth and fresh & {*feeders}}
        depth |= dict.fromkeys(fresh, level)
    return depth
