"""A project as data: what the files say, resolved and checked, and nothing that runs.

Everything here is frozen. :mod:`neuros.project.load` reads it from files,
:mod:`neuros.project.split` cuts it into one :class:`NodeFile` per node.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from neuros.project.names import INTERNAL, Names
from neuros.project.qos import Qos

Value: TypeAlias = "bool | int | float | str | tuple[bool | int | float | str, ...]"
"""What a ROS parameter holds here."""

NETWORK_MODULE = "neuros.snn.nir.plugin"
"""The plugin of nodes with ``"network"``; the file is in the variable :data:`NETWORK`."""
NETWORK = "NETWORK"

_NOTHING: Mapping[str, Any] = MappingProxyType({})
_NO_NAMES = Names()
_KEYS_OF_TRANSPORT = ("compression", "quality")
FINALISE_S = 5.0
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
_UNITS = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30}


@dataclass(frozen=True)
class Resources:
    """Limits of a node; ``None`` is no limit of its own.

    Attributes:
        mem_bytes: memory; what needs more is killed.
        cpus: cores' worth of computing time, 1.5 is one and a half.
        pids: processes and threads at any one time.
    """

    mem_bytes: int | None = None
    cpus: float | None = None
    pids: int | None = None


@dataclass(frozen=True)
class Access:
    """What a container is let in to that it would not see by itself.

    Attributes:
        devices: paths in ``/dev``.
        gpus: ``("all",)``, or the ids of GPUs.
        display: whether it may open windows.
    """

    devices: tuple[str, ...] = ()
    gpus: tuple[str, ...] = ()
    display: bool = False


@dataclass(frozen=True)
class Port:
    """An input or output of a node.

    Attributes:
        name: unique among the inputs, or among the outputs, of its node.
        type: message type in ROS notation, ``"std_msgs/msg/String"``.
        external_topic: the plain ROS topic that it is bound to, as written, or ``None``;
            :meth:`Names.resolve` tells its full name.
        qos: what is offered or asked for there, or ``None`` where the file does not say.
        mujoco: the sensor or actuator behind it as the node file declares it, empty if none.
        gazebo_type: kept from published project files; it has no effect.
    """

    name: str
    type: str
    external_topic: str | None = None
    mujoco: Mapping[str, Any] = field(default_factory=lambda: _NOTHING, hash=False)
    gazebo_type: str | None = None
    qos: Qos | None = None


@dataclass(frozen=True)
class Node:
    """One plugin in one container.

    Attributes:
        plugin: absolute path of the Python file with the hooks; ``Path()`` where it is in a module
            that this Python does not have.
        script: absolute path of a shell script that runs before the node, or ``None``.
        environment: environment variables, with ``#path`` and ``@path`` already resolved.
        file: the file that describes the node, for messages; ``pointer`` is its place in there.
        environment_paths: names of the environment variables that are such paths, sorted.
        affinity: numbers of the cores that it is to run on, from 0; empty if it does not matter.
        resources: what it may use at most.
        access: what its container is let in to.
        parameters: values of ROS parameters, by full name.
        module: the name of the plugin where it is one of an installed package, else empty.
        finalise_s: how long it may finalise without progress before it is killed, in seconds.
    """

    name: str
    container: str
    plugin: Path
    script: Path | None = None
    inputs: tuple[Port, ...] = ()
    outputs: tuple[Port, ...] = ()
    environment: Mapping[str, str] = field(default_factory=lambda: _NOTHING, hash=False)
    file: Path = Path()
    pointer: str = ""
    environment_paths: tuple[str, ...] = ()
    affinity: tuple[int, ...] = ()
    resources: Resources = field(default_factory=Resources)
    access: Access = field(default_factory=Access)
    parameters: Mapping[str, Value] = field(default_factory=lambda: _NOTHING, hash=False)
    module: str = ""
    finalise_s: float = FINALISE_S

    def input(self, name: str) -> Port:
        """The input of that name; raises ``KeyError``."""
        return _named(self.inputs, name)

    def output(self, name: str) -> Port:
        """The output of that name; raises ``KeyError``."""
        return _named(self.outputs, name)

    @property
    def plugin_name(self) -> str:
        """What to call the plugin, or the network in its place."""
        if self.module == NETWORK_MODULE:
            return Path(self.environment.get(NETWORK, "")).name
        return self.module or self.plugin.name

    @property
    def owns_time(self) -> bool:
        """Whether the node has a simulator, or publishes a clock."""
        return any(port.mujoco for port in (*self.inputs, *self.outputs)) or any(
            port.type == CLOCK_TYPE for port in self.outputs
        )

    @property
    def clock(self) -> Port | None:
        """The input that brings simulated time: that of type Clock; of several, ``clock``."""
        clocks = [port for port in self.inputs if port.type == CLOCK_TYPE]
        if len(clocks) > 1:
            clocks = [port for port in clocks if port.name == "clock"]
        return clocks[0] if clocks else None

    @property
    def no_clock(self) -> tuple[str, str]:
        """What is wrong where a hook needs a clock and the node has none, and what to do."""
        clocks = [port.name for port in self.inputs if port.type == CLOCK_TYPE]
        has = "several inputs" if clocks else "no input"
        text = f"ticks by simulated time, but node '{self.name}' has {has} of type {CLOCK_TYPE}"
        if clocks:
            return text, "name the one to go by 'clock'"
        return text, "give it one, and connect the project's clock to it"


@dataclass(frozen=True)
class Connection:
    """``source_node.source_output -> destination_node.destination_input``.

    Attributes:
        discard_limit: packets that may be lost in a row; ``None`` is BEST_EFFORT.
        queue_size: unread packets that the receiver holds, K.
        index: its place in the project file, from 0; the order of the packets of an ``All`` input.
        namespace: that of the project, empty or as in ``/left``.
        compression: ``zstd`` for packets that leave the machine, ``jpeg``; ``None``: there is none.
        quality: of JPEG, 1 to 100.
    """

    source_node: str
    source_output: str
    destination_node: str
    destination_input: str
    discard_limit: int | None = None
    queue_size: int = 1
    index: int = 0
    namespace: str = ""
    compression: str | None = None
    quality: int = 95

    @property
    def is_reliable(self) -> bool:
        """Whether it has a discard limit, and so acknowledgements."""
        return self.discard_limit is not None

    @property
    def is_zstd(self) -> bool:
        """Whether packets that leave the machine are compressed with Zstandard."""
        return self.compression == "zstd"

    @property
    def is_jpeg(self) -> bool:
        """Whether its packets are images that are encoded as JPEG."""
        return self.compression == "jpeg"

    @property
    def window(self) -> int:
        """Outstanding packets at which the sender blocks, K + N (for BEST_EFFORT: K)."""
        return self.queue_size + (self.discard_limit or 0)

    @property
    def topic(self) -> str:
        """The topic that ``/data``, ``/ack`` and ``/reg`` are appended to."""
        return (
            f"{self.namespace}{INTERNAL}{self.source_node}/{self.source_output}"
            f"/{self.destination_node}/{self.destination_input}"
        )

    @classmethod
    def of(cls, keys: Mapping[str, Any], **more: Any) -> Connection:
        """The connection that valid keys describe; JSON may write a whole number as ``2.0``."""
        flat = {**keys, **keys.get("transport", {})}
        flat.pop("transport", None)
        whole: dict[str, Any] = {k: int(v) if isinstance(v, float) else v for k, v in flat.items()}
        return cls(**whole, **more)

    @property
    def keys(self) -> dict[str, Any]:
        """As a project file has it."""
        values = {f.name: (getattr(self, f.name), f.default) for f in fields(self)}
        del values["index"], values["namespace"]
        keys = {key: value for key, (value, default) in values.items() if value != default}
        transport = {key: keys.pop(key) for key in _KEYS_OF_TRANSPORT if key in keys}
        return {**keys, "transport": transport} if transport else keys

    def __hash__(self) -> int:
        # Looked up for every packet; the place in the project tells most connections apart.
        return hash(self.index)

    def __str__(self) -> str:
        return (
            f"{self.source_node}.{self.source_output}"
            f" -> {self.destination_node}.{self.destination_input}"
        )


@dataclass(frozen=True)
class Folders:
    """The folders that a node may read (project, workspace) and write (run), as it sees them."""

    project: Path
    workspace: Path
    run: Path


@dataclass(frozen=True)
class NodeFile:
    """The content of ``node.json``: a node and its own connections, nothing else.

    Attributes:
        index: the node's place in the project file, from 0.
        messages: where Python finds the message packages of workspaces, a folder for each: it is
            called ``python``, and lies in that of the built package.
        names: the project's.
        list_bytes: so much each list of its packet log has at most; 0: it keeps none.
    """

    node: Node
    connections: tuple[Connection, ...]
    folders: Folders
    index: int = 0
    messages: tuple[Path, ...] = ()
    names: Names = _NO_NAMES
    list_bytes: int = 64_000_000


@dataclass(frozen=True)
class Budgets:
    """What must hold of every run; a run that breaks one ends with exit code 5.

    Attributes:
        lost_packets: by connection (``a.out -> b.in``), how many may be lost or discarded in all.
        real_time_factor: at least this much.
        tick_error_ms: how far an interval of a timed hook may be off its period.
    """

    lost_packets: Mapping[str, int] = field(default_factory=lambda: _NOTHING, hash=False)
    real_time_factor: float | None = None
    tick_error_ms: float | None = None


@dataclass(frozen=True)
class Project:
    """A whole project, valid in itself.

    Attributes:
        dashboard: the layout of the dashboard as the file has it, ``None`` if it has none.
    """

    name: str
    nodes: tuple[Node, ...]
    connections: tuple[Connection, ...]
    file: Path
    description: str = ""
    budgets: Budgets = Budgets()
    names: Names = _NO_NAMES
    dashboard: Mapping[str, Any] | None = field(default=None, hash=False)

    @property
    def folder(self) -> Path:
        """The folder of the project file."""
        return self.file.parent

    def node(self, name: str) -> Node:
        """The node of that name; raises ``KeyError``."""
        for node in self.nodes:
            if node.name == name:
                return node
        raise KeyError(name)


def memory_text(mem_bytes: int) -> str:
    """An amount of memory as project files write it: ``2g``, ``512m``."""
    for unit, factor in sorted(_UNITS.items(), key=lambda pair: -pair[1]):
        if mem_bytes % factor == 0:
            return f"{mem_bytes // factor}{unit}"
    return f"{-(-mem_bytes // _UNITS['k'])}k"


def bytes_of(text: str) -> int:
    """An amount as project files write it, ``2g`` or ``512m``, in bytes. Raises ``ValueError``."""
    if not re.fullmatch(r"[1-9][0-9]{0,8}[kmg]", text):
        raise ValueError(text)
    return int(text[:-1]) * _UNITS[text[-1]]


def resources_of(keys: Mapping[str, Any]) -> Resources:
    """The limits that valid keys of a node set."""
    given = keys.get("resources", {})
    memory, cpus, pids = (given.get(key) for key in ("memory", "cpus", "pids"))
    return Resources(
        mem_bytes=None if memory is None else bytes_of(memory),
        cpus=None if cpus is None else float(cpus),
        pids=None if pids is None else int(pids),
    )


def access_of(keys: Mapping[str, Any]) -> Access:
    """What valid keys of a node open to it."""
    gpus = keys.get("gpus", ())
    return Access(
        devices=tuple(keys.get("devices", ())),
        gpus=(gpus,) if isinstance(gpus, str) else tuple(map(str, gpus)),
        display=bool(keys.get("display", False)),
    )


def keys_of(resources: Resources, access: Access) -> dict[str, Any]:
    """The keys of a node that say this; the inverse of the two above."""
    memory = None if resources.mem_bytes is None else memory_text(resources.mem_bytes)
    limits = {"memory": memory, "cpus": resources.cpus, "pids": resources.pids}
    keys = {
        "resources": {key: limit for key, limit in limits.items() if limit is not None},
        "devices": list(access.devices),
        "gpus": "all" if access.gpus == ("all",) else list(access.gpus),
        "display": access.display,
    }
    return {key: value for key, value in keys.items() if value}


def parameters_of(written: Mapping[str, Any]) -> dict[str, Value]:
    """Values by full name (``gain.p``), from valid ones that may lie in each other.

    Numbers of one list are of one kind: with a float among them, all are.
    """
    found: dict[str, Value] = {}
    for name, value in written.items():
        if isinstance(value, Mapping):
            inner = parameters_of(value)
            found |= {f"{name}.{part}": each for part, each in inner.items()}
        elif isinstance(value, list | tuple):
            has_floats = any(isinstance(item, float) for item in value)
            found[name] = tuple(map(float, value)) if has_floats else tuple(value)
        else:
            found[name] = value
    return found


def parameters_to_json(parameters: Mapping[str, Value]) -> dict[str, Any]:
    """As a project file has them."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in parameters.items()
    }


def _named(ports: tuple[Port, ...], name: str) -> Port:
    for port in ports:
        if port.name == name:
            return port
    raise KeyError(name)
