"""The parameters of a node that drives a simulator by the standard, and their check."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from neuros.errors import NodeError, Problem
from neuros.ports import PluginCheck
from neuros.project.model import CLOCK_TYPE, Node, Port
from neuros.project.scanner import problem_in
from neuros.project.suggest import did_you_mean

STATE_PARTS: Mapping[str, tuple[str, ...]] = {
    "simulation_interfaces/msg/EntityState": ("pose", "twist", "acceleration"),
    "geometry_msgs/msg/PoseStamped": ("pose",),
    "geometry_msgs/msg/TwistStamped": ("twist",),
}
"""Types of a port with the state of an entity; their fields, which an ``EntityState`` has, too."""

_BY_PORT = ("entities", "topics", "every")
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Settings:
    """What a node declares about its simulator.

    Attributes:
        step_s: simulated seconds of one step of the simulator.
        simulator: the name before its services: ``/gz_server`` for ``/gz_server/step_simulation``.
        domain: the ROS domain of the simulator.
        steps: steps of the simulator in one start of the hook.
        timeout_s: seconds of the wall clock that an answer or a message may take.
        reset: whether the simulator is reset when the run begins.
        optional: inputs without which the simulator is stepped, too.
        entities: the entity behind a port.
        topics: the simulator's topic behind a port.
        every: in how many starts of the hook a topic brings one message, by output; otherwise 1.
    """

    step_s: float
    simulator: str = ""
    domain: int = 0
    steps: int = 1
    timeout_s: float = 10.0
    reset: bool = True
    optional: tuple[str, ...] = ()
    entities: Mapping[str, str] = field(default_factory=lambda: _NOTHING)
    topics: Mapping[str, str] = field(default_factory=lambda: _NOTHING)
    every: Mapping[str, int] = field(default_factory=lambda: _NOTHING)

    @classmethod
    def of(cls, node: Node) -> Settings:
        """The settings in the parameters of a node.

        Raises:
            NodeError: with all mistakes.
        """
        values, problems = _read(node)
        if problems:
            raise NodeError("\n".join(f"{name}: {text}" for name, text in problems))
        return cls(**values)

    def service(self, name: str) -> str:
        """The full name of a service: ``/gz_server/step_simulation``."""
        return f"/{self.simulator.strip('/')}/{name}".replace("//", "/")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_count(value: Any, least: int = 1) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _is_time(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf


_KINDS: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "step_s": (_is_time, "simulated seconds of one step of the simulator, above 0"),
    "simulator": (lambda v: isinstance(v, str), "the name before the services, as '/gz_server'"),
    "domain": (lambda v: _is_count(v, 0) and v <= 232, "a ROS domain, 0 to 232"),
    "steps": (_is_count, "the steps of the simulator in one start of the hook, from 1"),
    "timeout_s": (_is_time, "seconds of the wall clock, above 0"),
    "reset": (lambda v: isinstance(v, bool), "true or false"),
    "optional": (lambda v: isinstance(v, tuple) and all(map(_is_text, v)), "a list of inputs"),
    "entities": (_is_text, "the name of an entity"),
    "topics": (_is_text, "the name of a topic"),
    "every": (_is_count, "how often the hook starts until the topic brings a message, from 1"),
}


def _read(node: Node) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Values by the fields of :class:`Settings`, and problems with the parameter of each."""
    parameters = node.parameters
    values: dict[str, Any] = {}
    problems: list[tuple[str, str]] = []
    for name, value in parameters.items():
        key, _, port = name.partition(".")
        if key == "use_sim_time":
            continue
        if key not in _KINDS or bool(port) is not (key in _BY_PORT):
            hint = did_you_mean(key, [each for each in _KINDS if each != key])
            problems.append((name, f"there is no such parameter{hint and f' ({hint})'}"))
            continue
        is_right, meaning = _KINDS[key]
        if not is_right(value):
            problems.append((name, f"found {value!r}, expected {meaning}"))
        if port:
            values.setdefault(key, {})[port] = value
        elif is_right(value):
            values[key] = value
    if "step_s" not in parameters:
        problems.append(("step_s", f"is missing: {_KINDS['step_s'][1]}"))
    return values, [*problems, *_problems_of_ports(node, values)]


def _problems_of_ports(node: Node, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    inputs = [port.name for port in node.inputs]
    outputs = [port.name for port in node.outputs]
    entities, topics = values.get("entities", {}), values.get("topics", {})
    for side, ports in (("input", node.inputs), ("output", node.outputs)):
        for port in ports:
            yield from _problems_of_port(port, side, entities, topics)
    known = {
        "optional": ("input", inputs),
        "every": ("output with a topic", [name for name in outputs if name in topics]),
        **dict.fromkeys(("entities", "topics"), ("port", [*inputs, *outputs])),
    }
    for key, (what, names) in known.items():
        for name in values.get(key, ()):
            if name not in names:
                hint = did_you_mean(name, names)
                text = f"the node has no {what} '{name}'{hint and f' ({hint})'}"
                yield key if key == "optional" else f"{key}.{name}", text
    for name in sorted({*inputs} & {*outputs}):
        yield "", f"'{name}' is an input and an output: give each a name of its own"


def _problems_of_port(
    port: Port, side: str, entities: Mapping[str, str], topics: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    if port.external_topic is not None:
        text = f"{side} '{port.name}' has an external topic, which does not wait for the simulator"
        yield "", f'{text}: name the topic in "parameters": {{"topics": {{"{port.name}": ...}}}}'
    if port.type == CLOCK_TYPE and side == "output":
        if port.name in entities or port.name in topics:
            yield "", f"output '{port.name}' is the clock, which needs no entity and no topic"
    elif (port.name in entities) is (port.name in topics):
        found = "both an entity and a topic" if port.name in entities else "no entity and no topic"
        text = f'{side} \'{port.name}\' has {found}: name one in "entities" or "topics"'
        yield "", text
    elif port.name in entities and port.type not in STATE_PARTS:
        types = ", ".join(STATE_PARTS)
        yield f"entities.{port.name}", f"an entity needs a port of {types}, not of {port.type}"


class _Check(PluginCheck):
    """Checks the parameters and ports of a node before a run."""

    def problems(self, node: Node) -> Iterable[Problem]:
        for name, text in _read(node)[1]:
            pointer = f"/parameters/{name.replace('.', '/')}" if name else ""
            yield problem_in(node.file, f"{node.pointer}{pointer}", text)

    def doubts(self, node: Node) -> Iterable[Problem]:
        return ()


CHECK = _Check()
