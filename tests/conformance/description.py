"""What a small project consists of: a plain description, drawn, run, judged, shrunk and kept.

All nodes run one plugin (``plugin.py``), which reads from its environment which hooks it has and
what they do; so a description says everything, and a kept one is a JSON file.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

EXTERNAL_DEPTH = 10
"""What an external topic's input queue holds where its ``qos`` says nothing."""

TYPES = {
    "byte": "std_msgs/msg/UInt8",
    "int": "std_msgs/msg/Int64",
    "text": "std_msgs/msg/String",
    "bytes": "std_msgs/msg/UInt8MultiArray",
    "image": "sensor_msgs/msg/Image",
}
"""Message types by kind; a ``byte`` has no room for who sent it, so its input has one source."""


@dataclass(frozen=True)
class Port:
    """An input or output: its message type, the bytes that its packets carry, its topic."""

    kind: str = "int"
    size: int = 0
    external: str = ""


@dataclass(frozen=True)
class Taken:
    """An input of a hook, and how it is wrapped."""

    port: str
    is_all: bool = False
    is_optional: bool = False


@dataclass(frozen=True)
class Sent:
    """An output of a hook: at which executions it sends.

    Attributes:
        every: at every so many executions.
        at_most: so often at most, 0: for ever.
        is_answer: only where at least one input brought a packet.
    """

    port: str
    is_optional: bool = False
    every: int = 1
    at_most: int = 0
    is_answer: bool = False


@dataclass(frozen=True)
class Hook:
    """A hook: ``kind`` is initialise, tick, function or finalise; ``shutdown_at``: the execution at
    which it ends the project, 0: never."""

    name: str
    kind: str = "function"
    inputs: tuple[Taken, ...] = ()
    outputs: tuple[Sent, ...] = ()
    seconds: float = 0.0
    sleep_ms: float = 0.0
    shutdown_at: int = 0

    @property
    def is_unasked(self) -> bool:
        """Whether it sends without having received."""
        if self.kind == "tick":
            return True
        return bool(self.outputs) and all(each.is_optional for each in self.inputs)


@dataclass(frozen=True)
class Node:
    name: str
    hooks: tuple[Hook, ...] = ()
    inputs: Mapping[str, Port] = field(default_factory=dict)
    outputs: Mapping[str, Port] = field(default_factory=dict)

    def takers(self, port: str) -> list[Hook]:
        """The hooks that take an input."""
        return [hook for hook in self.hooks if any(each.port == port for each in hook.inputs)]


@dataclass(frozen=True)
class Connection:
    """A connection, or an external topic that one node sends to and another listens to."""

    source_node: str
    source_output: str
    destination_node: str
    destination_input: str
    discard_limit: int | None = None
    queue_size: int = 1
    is_external: bool = False

    @property
    def is_reliable(self) -> bool:
        return self.discard_limit is not None

    @property
    def window(self) -> int:
        """Outstanding packets at which the sender blocks."""
        return self.queue_size + (self.discard_limit or 0)

    @property
    def origin(self) -> str:
        """Who sends on it: ``node.output``."""
        return f"{self.source_node}.{self.source_output}"

    @property
    def is_to_itself(self) -> bool:
        return self.source_node == self.destination_node

    def __str__(self) -> str:
        return f"{self.origin} -> {self.destination_node}.{self.destination_input}"


@dataclass(frozen=True)
class Project:
    """A project, and what ends it after ``seconds``: ``duration`` (drained) or ``interrupt``."""

    nodes: tuple[Node, ...]
    connections: tuple[Connection, ...] = ()
    end: str = "duration"
    seconds: float = 0.6

    @cached_property
    def by_name(self) -> dict[str, Node]:
        return {node.name: node for node in self.nodes}

    @cached_property
    def origins(self) -> list[str]:
        """All outputs, in the order by which packets name them."""
        return [f"{node.name}.{port}" for node in self.nodes for port in node.outputs]

    @cached_property
    def all_connections(self) -> tuple[Connection, ...]:
        """The connections, and behind them each pair of ends of an external topic."""
        return (*self.connections, *self._external())

    @cached_property
    def _sources(self) -> dict[tuple[str, str], list[Connection]]:
        found: dict[tuple[str, str], list[Connection]] = {}
        for c in self.all_connections:
            found.setdefault((c.destination_node, c.destination_input), []).append(c)
        return found

    def sources(self, node: str, port: str) -> list[Connection]:
        """What feeds an input, in the order of the project file."""
        return self._sources.get((node, port), [])

    def _external(self) -> Iterator[Connection]:
        for source in self.nodes:
            for output, sent in source.outputs.items():
                for node in self.nodes:
                    for name, port in node.inputs.items():
                        if sent.external and sent.external == port.external:
                            ends = (source.name, output, node.name, name)
                            yield Connection(*ends, None, EXTERNAL_DEPTH, is_external=True)

    @property
    def circulates(self) -> bool:
        """Whether packets can go round for ever through hooks that only answer."""
        edges: dict[tuple[str, str], set[tuple[str, str]]] = {}
        answering = {
            (node.name, hook.name): hook
            for node in self.nodes
            for hook in node.hooks
            if hook.kind == "function" and not hook.is_unasked
        }
        for (node, name), hook in answering.items():
            fed = {
                (c.destination_node, c.destination_input)
                for sent in hook.outputs
                if not sent.at_most
                for c in self.all_connections
                if c.origin == f"{node}.{sent.port}"
            }
            edges[node, name] = {
                other
                for other, taker in answering.items()
                if any((other[0], each.port) in fed for each in taker.inputs)
            }
        left = dict(edges)
        while ends := [key for key, to in left.items() if not to & left.keys()]:
            for key in ends:
                del left[key]
        return bool(left)

    # ------------------------------------------------------------------ files

    def to_json(self) -> dict[str, Any]:
        """As it is kept."""
        content: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Project:
        """The opposite of :meth:`to_json`."""
        nodes = tuple(
            Node(
                node["name"],
                tuple(
                    Hook(
                        **{
                            **hook,
                            "inputs": tuple(Taken(**each) for each in hook["inputs"]),
                            "outputs": tuple(Sent(**each) for each in hook["outputs"]),
                        }
                    )
                    for hook in node["hooks"]
                ),
                {name: Port(**port) for name, port in node["inputs"].items()},
                {name: Port(**port) for name, port in node["outputs"].items()},
            )
            for node in content["nodes"]
        )
        connections = tuple(Connection(**each) for each in content["connections"])
        return cls(nodes, connections, content["end"], content["seconds"])

    def write(self, folder: Path) -> Path:
        """Write a project that NeuROS can run into an existing folder; returns its file."""
        shutil.copy(Path(__file__).with_name("plugin.py"), folder / "plugin.py")
        nodes = [
            {
                "name": node.name,
                "container": "neuros_python",
                "plugin": "plugin.py",
                "inputs": [_port(*each) for each in node.inputs.items()],
                "outputs": [_port(*each) for each in node.outputs.items()],
                "environment": {"CONFORMANCE": json.dumps(self._of_plugin(node))},
            }
            for node in self.nodes
        ]
        connections = [
            {
                "source_node": c.source_node,
                "source_output": c.source_output,
                "destination_node": c.destination_node,
                "destination_input": c.destination_input,
                "queue_size": c.queue_size,
                **({} if c.discard_limit is None else {"discard_limit": c.discard_limit}),
            }
            for c in self.connections
        ]
        file = folder / "project.json"
        file.write_text(json.dumps({"nodes": nodes, "connections": connections}, indent=1))
        return file

    def _of_plugin(self, node: Node) -> dict[str, Any]:
        only = {
            port: self.origins.index(sources[0].origin)
            for port in node.inputs
            if len(sources := self.sources(node.name, port)) == 1
        }
        return {
            "hooks": [asdict(hook) for hook in node.hooks],
            "inputs": {name: port.kind for name, port in node.inputs.items()},
            "outputs": {
                name: {**asdict(port), "origin": self.origins.index(f"{node.name}.{name}")}
                for name, port in node.outputs.items()
            },
            "only_source": only,
        }


def _port(name: str, port: Port) -> dict[str, Any]:
    topic = {"external_topic": port.external} if port.external else {}
    return {"name": name, "type": TYPES[port.kind], **topic}


def tidied(project: Project) -> Project:
    """The project without what has no end any more: for parts that were taken out of it.

    Required inputs that nothing feeds take their hook with them, unused ports go.
    """
    while True:
        nodes = tuple(_tidied_node(project, node) for node in project.nodes)
        nodes = tuple(node for node in nodes if node.hooks)
        names = {node.name: node for node in nodes}
        connections = tuple(
            c
            for c in project.connections
            if c.source_node in names
            and c.destination_node in names
            and c.source_output in names[c.source_node].outputs
            and c.destination_input in names[c.destination_node].inputs
        )
        smaller = replace(project, nodes=nodes, connections=connections)
        if smaller == project:
            return project
        project = smaller


def _tidied_node(project: Project, node: Node) -> Node:
    hooks = []
    for hook in node.hooks:
        if any(not each.is_optional and not project.sources(node.name, each.port)
               for each in hook.inputs):  # fmt: skip
            continue
        inputs = tuple(each for each in hook.inputs if each.port in node.inputs)
        outputs = tuple(each for each in hook.outputs if each.port in node.outputs)
        hooks.append(replace(hook, inputs=inputs, outputs=outputs))
    fed = {
        *(port for each in hooks for port in (taken.port for taken in each.inputs)),
        *(c.destination_input for c in project.connections if c.destination_node == node.name),
    }
    feeding = {
        *(port for each in hooks for port in (sent.port for sent in each.outputs)),
        *(c.source_output for c in project.connections if c.source_node == node.name),
    }
    topics = {"", *(port.external for n in project.nodes for port in n.outputs.values())}
    heard = {name: port for name, port in node.inputs.items() if port.external in topics}
    return Node(node.name, tuple(hooks), _only(heard, fed), _only(node.outputs, feeding))


def _only(ports: Mapping[str, Port], names: Sequence[str] | set[str]) -> dict[str, Port]:
    return {name: port for name, port in ports.items() if name in names}
