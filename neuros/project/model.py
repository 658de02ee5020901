"""A project as frozen data, resolved and checked.

:mod:`neuros.project.load` builds it from files, :mod:`neuros.project.split` cuts it into one
:class:`NodeFile` per node.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from neuros.project.message_types import ArrayType, array_type, ros_type
from neuros.project.names import INTERNAL, Names
from neuros.project.qos import Qos
from neuros.project.suggest import did_you_mean
from neuros.project.timing import REAL, VIRTUAL, Distribution

Value: TypeAlias = "bool | int | float | str | tuple[bool | int | float | str, ...]"
"""The value of a ROS parameter."""

PLUGIN_KEYS: Mapping[str, str] = MappingProxyType(
    {"network": "neuros.snn.nir.plugin", "policy": "neuros.policies.plugin"}
)
"""Keys of a node in the place of ``"plugin"``, and their plugins, which extensions bring.

The file that such a key names is in the variable of its name in capitals, ``NETWORK``.
"""

_NOTHING: Mapping[str, Any] = MappingProxyType({})
_NO_NAMES = Names()
_KEYS_OF_TRANSPORT = ("compression", "quality")
_WHOLE_NUMBERS = ("discard_limit", "queue_size", "quality")
DEFAULT_DELAY = Distribution("constant", (0.0001,))
"""Of packets and acknowledgements in virtual time."""
FINALISE_S = 5.0
MODEL_FIELDS = "NEUROS_MODEL_FIELDS"
"""A variable of nodes with a simulator: fields of its model, by name, as a JSON object."""
SEEDS = "NEUROS_ENTROPY"
"""A variable of nodes with copies: the seed of each copy, as a JSON list."""
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
_UNITS = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30}


@dataclass(frozen=True)
class Resources:
    """Limits of a node; ``None`` is no limit of its own.

    Attributes:
        mem_bytes: memory; the kernel kills a node that needs more.
        cpus: computing time, in cores: 1.5 is one and a half.
        pids: processes and threads at a time.
    """

    mem_bytes: int | None = None
    cpus: float | None = None
    pids: int | None = None


@dataclass(frozen=True)
class Access:
    """Devices of the machine that a container may use.

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
        type: message type in ROS notation, ``"std_msgs/msg/String"``, or ``"float64[18]"``; of a
            node with copies with their axis, ``"float64[64,18]"``, which its file leaves out.
        external_topic: the plain ROS topic that it is bound to, as written, or ``None``;
            :meth:`Names.resolve` tells its full name.
        qos: of the external topic, or ``None`` if the file has none.
        mujoco: the sensor or actuator of the port, as the node file declares it; empty if none.
        gazebo_type: of published project files; it has no effect.
    """

    name: str
    type: str
    external_topic: str | None = None
    mujoco: Mapping[str, Any] = field(default_factory=lambda: _NOTHING, hash=False)
    gazebo_type: str | None = None
    qos: Qos | None = None

    @property
    def array(self) -> ArrayType | None:
        """The type of its packets if they are NumPy arrays, ``None`` if they are messages."""
        return array_type(self.type)

    @property
    def ros_type(self) -> str:
        """The type of its packets on the ROS graph and in bags."""
        return ros_type(self.type)


@dataclass(frozen=True)
class Node:
    """One plugin in one container.

    Attributes:
        plugin: absolute path of the Python file with the hooks; ``Path()`` for a module that is
            not installed on this machine. Of ``hooks``: the file of the first one, if it has any.
        script: absolute path of a shell script that runs before the node, or ``None``.
        environment: environment variables, with ``#path`` and ``@path`` already resolved.
        file: the file that describes the node, for messages.
        pointer: the JSON pointer of the node in ``file``.
        environment_paths: sorted names of the variables that hold such paths.
        affinity: numbers of the cores that the node runs on, from 0; empty: any core.
        resources: its limits.
        access: devices that its container may use.
        parameters: values of ROS parameters, by full name.
        module: the plugin as a module of an installed package, else empty.
        finalise_s: seconds of finalisation without progress after which the node is killed.
        hooks: functions of this program that are the plugin; empty if it is a file. JSON has none.
        copies: how many worlds each hook serves at once, ``None``: one, without an axis of copies.
        durations: by hook, how long it takes in virtual time.
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
    hooks: tuple[Callable[..., Any], ...] = ()
    copies: int | None = None
    durations: Mapping[str, Distribution] = field(default_factory=lambda: _NOTHING, hash=False)

    def input(self, name: str) -> Port:
        """The input of that name; raises ``KeyError``."""
        return _named(self.inputs, name)

    def output(self, name: str) -> Port:
        """The output of that name; raises ``KeyError``."""
        return _named(self.outputs, name)

    @property
    def plugin_key(self) -> str:
        """The key that names the plugin: ``plugin``, or one of :data:`PLUGIN_KEYS`."""
        return next((key for key, own in PLUGIN_KEYS.items() if own == self.module), "plugin")

    @property
    def plugin_name(self) -> str:
        """The name of the plugin, or of the file in its place, for messages."""
        if self.hooks:
            return ", ".join(getattr(hook, "__name__", repr(hook)) for hook in self.hooks)
        if self.plugin_key in PLUGIN_KEYS:
            return Path(self.environment.get(self.plugin_key.upper(), "")).name
        return self.module or self.plugin.name

    @property
    def owns_time(self) -> bool:
        """Whether the node has a simulator, or publishes a clock."""
        return any(port.mujoco for port in (*self.inputs, *self.outputs)) or any(
            port.type == CLOCK_TYPE for port in self.outputs
        )

    @property
    def clock(self) -> Port | None:
        """The input of type Clock, which brings simulated time; of several, the input ``clock``."""
        clocks = [port for port in self.inputs if port.type == CLOCK_TYPE]
        if len(clocks) > 1:
            clocks = [port for port in clocks if port.name == "clock"]
        return clocks[0] if clocks else None

    def no_duration(self, hook: str, kinds: Mapping[str, str] | None) -> tuple[str, str]:
        """Why a hook has no duration, and a hint; empty if it may have one.

        ``kinds``: by name of each hook, its decorator; ``None``: not known.
        """
        kind = (kinds or {}).get(hook, "")
        if kinds is not None and hook not in kinds:
            hint = did_you_mean(hook, kinds) or f"it has {', '.join(kinds) or 'none'}"
            return f"node '{self.name}' has no hook '{hook}'", hint
        if kind and kind not in ("neuros_tick", "neuros_function"):
            text = f"hook '{hook}' is a {kind}: only tick and function hooks take time"
            return text, "leave it out"
        return "", ""

    def is_timeless(self, hook: str) -> bool:
        """Whether no execution of a hook takes virtual time, whatever it does."""
        duration = self.durations.get(hook)
        return not self.owns_time if duration is None else not any(duration.values)

    def timeless(self, hook: str) -> tuple[str, str]:
        """The error of a hook that starts unasked and takes no virtual time, and a hint."""
        text = f"hook '{hook}' of node '{self.name}' starts unasked, and takes no virtual time"
        cure = f'"durations": {{"{hook}": 0.01}}'
        return text, f"give the node {cure}, in seconds, or the hook an input that it requires"

    def misfit(self, is_batch: bool, has_ports: bool) -> tuple[str, str]:
        """Why a hook does not fit the number of copies, and a hint; empty if it does."""
        if is_batch and self.copies is None:
            text = f"takes batches, but node '{self.name}' has no \"copies\""
            return text, 'give it "copies": 1, or more'
        if has_ports and not is_batch and self.copies is not None:
            text = f"node '{self.name}' has {self.copies} copies, but the hook takes no batches"
            return text, "write batch=True in its decorator: its arrays have a leading axis"
        return "", ""

    def undeclared(self, side: str, name: str) -> tuple[str, str]:
        """The error of a hook with a port (``side``: input, output) that is not here; a hint."""
        ports = self.inputs if side == "input" else self.outputs
        has = ", ".join(sorted(port.name for port in ports)) or "none"
        return f"node '{self.name}' declares no {side} '{name}'", f"it has {has}"

    def unfed(self, name: str) -> tuple[str, str]:
        """The error of a hook that requires an input to which nothing is connected; a hint."""
        text = f"needs input '{name}', but nothing is connected to {self.name}.{name}"
        return text, "connect it, or declare it Optional"

    @property
    def no_clock(self) -> tuple[str, str]:
        """The error of a hook that needs a clock in a node without one, and a hint."""
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
        compression: ``zstd`` (of packets that leave the machine), ``jpeg`` or ``None``.
        quality: of JPEG, 1 to 100.
        delay: how long a packet, or an acknowledgement, is under way in virtual time.
        loss: the probability that a packet is lost on its way in virtual time.
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
    delay: Distribution = DEFAULT_DELAY
    loss: float = 0.0

    @property
    def is_reliable(self) -> bool:
        """Whether the connection has a discard limit, and so acknowledgements."""
        return self.discard_limit is not None

    @property
    def is_zstd(self) -> bool:
        """Whether packets that leave the machine are compressed with Zstandard."""
        return self.compression == "zstd"

    @property
    def is_jpeg(self) -> bool:
        """Whether packets are images, encoded as JPEG."""
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
        """The connection of valid keys; JSON may write a whole number as ``2.0``."""
        flat = {**keys, **keys.get("transport", {})}
        flat.pop("transport", None)
        flat |= {key: int(flat[key]) for key in _WHOLE_NUMBERS if key in flat}
        if "delay" in flat:
            flat["delay"] = Distribution.of(flat["delay"])
        return cls(**flat, **more)

    @property
    def keys(self) -> dict[str, Any]:
        values = {f.name: (getattr(self, f.name), f.default) for f in fields(self)}
        del values["index"], values["namespace"]
        keys = {key: value for key, (value, default) in values.items() if value != default}
        if "delay" in keys:
            keys["delay"] = self.delay.keys
        transport = {key: keys.pop(key) for key in _KEYS_OF_TRANSPORT if key in keys}
        return {**keys, "transport": transport} if transport else keys

    def __hash__(self) -> int:
        # Every packet looks its connection up; the index differs between most connections.
        return hash(self.index)

    def __str__(self) -> str:
        return (
            f"{self.source_node}.{self.source_output}"
            f" -> {self.destination_node}.{self.destination_input}"
        )


@dataclass(frozen=True)
class Folders:
    """Paths in a node of the folders that it may read (project, workspace) and write (run)."""

    project: Path
    workspace: Path
    run: Path


@dataclass(frozen=True)
class NodeFile:
    """The content of ``node.json``: a node and its own connections.

    Attributes:
        index: the node's place in the project file, from 0.
        messages: for ``sys.path``, the folder ``python`` of each built message package.
        names: the project's.
        list_bytes: limit of each list of the packet log; 0: the node keeps no log.
        restored: by name of a value that its plugin keeps, the file that it came from.
        time: the clock of the run, ``real`` or ``virtual``.
        seed: from which durations, delays and losses are drawn in virtual time.
    """

    node: Node
    connections: tuple[Connection, ...]
    folders: Folders
    index: int = 0
    messages: tuple[Path, ...] = ()
    names: Names = _NO_NAMES
    list_bytes: int = 64_000_000
    restored: Mapping[str, str] = field(default_factory=lambda: _NOTHING, hash=False)
    time: str = REAL
    seed: str = ""

    @property
    def logger_name(self) -> str:
        """The name of its logger in ROS, which rcl makes from namespace and name."""
        return f"{self.names.namespace}/{self.node.name}"[1:].replace("/", ".")


@dataclass(frozen=True)
class Budgets:
    """Limits of every run; a run that breaks one ends with exit code 5.

    Attributes:
        lost_packets: most packets lost or discarded, by connection (``a.out -> b.in``).
        real_time_factor: the least.
        tick_error_ms: the largest difference between an interval of a timed hook and its period.
    """

    lost_packets: Mapping[str, int] = field(default_factory=lambda: _NOTHING, hash=False)
    real_time_factor: float | None = None
    tick_error_ms: float | None = None


@dataclass(frozen=True)
class Project:
    """A valid project.

    Attributes:
        dashboard: the layout of the dashboard in the file, ``None`` if it has none.
        is_portable: whether its runs fix what libraries choose by the processor.
        time: the clock of a run, ``real`` or ``virtual``.
    """

    name: str
    nodes: tuple[Node, ...]
    connections: tuple[Connection, ...]
    file: Path
    description: str = ""
    budgets: Budgets = Budgets()
    names: Names = _NO_NAMES
    dashboard: Mapping[str, Any] | None = field(default=None, hash=False)
    is_portable: bool = False
    time: str = REAL

    @property
    def is_virtual(self) -> bool:
        """Whether declared times alone move the clock of a run on."""
        return self.time == VIRTUAL

    @property
    def folder(self) -> Path:
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
    given = keys.get("resources", {})
    memory, cpus, pids = (given.get(key) for key in ("memory", "cpus", "pids"))
    return Resources(
        mem_bytes=None if memory is None else bytes_of(memory),
        cpus=None if cpus is None else float(cpus),
        pids=None if pids is None else int(pids),
    )


def access_of(keys: Mapping[str, Any]) -> Access:
    gpus = keys.get("gpus", ())
    return Access(
        devices=tuple(keys.get("devices", ())),
        gpus=(gpus,) if isinstance(gpus, str) else tuple(map(str, gpus)),
        display=bool(keys.get("display", False)),
    )


def keys_of(resources: Resources, access: Access) -> dict[str, Any]:
    """The keys of a node: the inverse of :func:`resources_of` and :func:`access_of`."""
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
    """Values by full name (``gain.p``), from valid values, which may be nested.

    A list with a float becomes a list of floats.
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


def durations_of(written: Mapping[str, Any]) -> dict[str, Distribution]:
    return {hook: Distribution.of(value) for hook, value in written.items()}


def parameters_to_json(parameters: Mapping[str, Value]) -> dict[str, Any]:
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in parameters.items()
    }


def _named(ports: tuple[Port, ...], name: str) -> Port:
    for port in ports:
        if port.name == name:
            return port
    raise KeyError(name)
