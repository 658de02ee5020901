"""Random projects in virtual time against a naive model of the rules: every start, every loss.

The model knows one list of events, sorted anew for each instant, and the naive node of the tests of
the engine. It shares the draws of durations, delays and losses with NeuROS, and nothing else.
"""

from __future__ import annotations

import json
import random
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import neuros
from neuros.hooks import HookKind, HookSpec, InputSpec, OutputSpec
from neuros.project.model import Connection
from neuros.project.timing import Distribution, Draws
from tests.engine.naive_node import NaiveHook, NaiveNode

from .description import Hook, Project, tidied
from .running import LOCAL

DURATIONS: list[Any] = [
    *(0.001, 0.002, 0.005, 0.01, 0.04),
    {"normal": [0.01, 0.004]},
    {"lognormal": [0.005, 0.8]},
    {"uniform": [0.001, 0.02]},
    {"samples": [0.001, 0.003, 0.03]},
]
DELAYS: list[Any] = [None, None, 0.001, 0.001, 0.002, 0.01, 1e-6, *DURATIONS[5:]]
LOSSES = [0.0, 0.0, 0.1, 0.5]
SEED = "7"


@dataclass(frozen=True)
class Timing:
    """What a project declares for virtual time: durations by node and hook; by connection."""

    durations: dict[tuple[str, str], Any]
    delays: dict[str, Any]
    losses: dict[str, float]


@dataclass
class Trace:
    """Starts of hooks by node, as ``(ns, hook, taken)``; packets received by connection."""

    starts: dict[str, list[tuple[int, str, Any]]] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)
    end: str = ""


def for_virtual_time(project: Project) -> Project:
    """The project without what virtual time refuses, without pauses, and ended from outside."""
    nodes = []
    for node in project.nodes:
        inputs = {name: port for name, port in node.inputs.items() if not port.external}
        hooks = tuple(
            replace(
                hook,
                sleep_ms=0.0,
                shutdown_at=0,
                inputs=tuple(each for each in hook.inputs if each.port in inputs),
                outputs=tuple(e for e in hook.outputs if not node.outputs[e.port].external),
            )
            for hook in node.hooks
            if all(each.is_optional or each.port in inputs for each in hook.inputs)
        )
        outputs = {name: port for name, port in node.outputs.items() if not port.external}
        nodes.append(replace(node, hooks=hooks, inputs=inputs, outputs=outputs))
    return tidied(replace(project, nodes=tuple(nodes), end="duration"))


def timing_of(project: Project, number: int) -> Timing:
    """Random durations, delays and losses; a hook that starts unasked takes time."""
    draw = random.Random(number)
    durations = {}
    for node in project.nodes:
        for hook in node.hooks:
            if hook.kind in ("tick", "function"):
                is_loop = hook.kind == "function" and all(e.is_optional for e in hook.inputs)
                is_to_itself = any(
                    c.is_to_itself and c.origin == f"{node.name}.{sent.port}"
                    for sent in hook.outputs
                    for c in project.connections
                )
                if is_loop or is_to_itself or draw.random() < 0.6:
                    durations[node.name, hook.name] = draw.choice(DURATIONS)
    delays, losses = {}, {}
    for c in project.connections:
        if not c.is_to_itself:
            delays[str(c)] = draw.choice(DELAYS)
            losses[str(c)] = 0.0 if c.is_reliable else draw.choice(LOSSES)
    return Timing(durations, delays, losses)


def write(project: Project, timing: Timing, folder: Path) -> Path:
    """Write a project in virtual time that NeuROS can run; returns its file."""
    file = project.write(folder)
    content = json.loads(file.read_text())
    content["time"] = "virtual"
    for node in content["nodes"]:
        described = json.loads(node["environment"]["CONFORMANCE"])
        node["environment"]["CONFORMANCE"] = json.dumps({**described, "is_virtual": True})
        node["environment"]["SEED"] = SEED
        node["durations"] = {
            hook: each for (name, hook), each in timing.durations.items() if name == node["name"]
        }
    for keys, c in zip(content["connections"], project.connections, strict=True):
        delay, loss = timing.delays.get(str(c)), timing.losses.get(str(c), 0.0)
        keys.update({} if delay is None else {"delay": delay}, **({"loss": loss} if loss else {}))
    file.write_text(json.dumps(content))
    return file


def observed(project: Project, timing: Timing) -> Trace:
    """What NeuROS does."""
    trace = Trace()
    with tempfile.TemporaryDirectory(prefix="neuros-virtual-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = write(project, timing, Path(folder))
        loaded = neuros.Project.from_file(file)
        with loaded.session(backend="local", output=Path(folder) / "run") as session:
            session.run(duration_s=project.seconds)
            states = session.state()
            for node in project.nodes:
                log = Path(folder) / "run" / node.name / "observed.jsonl"
                lines = [json.loads(line) for line in log.read_text().splitlines()[1:]]
                trace.starts[node.name] = [(ns, hook, taken) for hook, ns, _, taken, _ in lines]
                counters = states[node.name].counters
                assert counters is not None
                incoming = counters.metrics["incoming"]
                trace.received |= {key: c["received"] for key, c in incoming.items()}
    return trace


def launched(project: Project, timing: Timing, backend: str) -> Trace:
    """What NeuROS does on a back end of ``launch``, until the project has drained."""
    trace = Trace()
    with tempfile.TemporaryDirectory(prefix="neuros-virtual-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = neuros.Project.from_file(write(project, timing, Path(folder)))
        output = Path(folder) / "run"
        run = loaded.run(backend=backend, duration=project.seconds, output=output, digests=True)
        trace.end = run.reason
        for node in project.nodes:
            lines = (output / node.name / "observed.jsonl").read_text().splitlines()[1:]
            seen = [json.loads(line) for line in lines]
            # Finalise hooks see the last time of their node, or of all nodes of their process.
            trace.starts[node.name] = [
                (ns, hook, taken) for hook, ns, _, taken, _ in seen if hook != "end"
            ]
        trace.received |= {key: each["received"] for key, each in run.connections.items()}
    return trace


class Node(NaiveNode):
    """A naive node in virtual time: it is held by its hook, and takes in before a pass."""

    def __init__(self, model: Model, name: str, connections: list[Connection]) -> None:
        self.described = model.project.by_name[name]
        self.model = model
        hooks = [hook for hook in self.described.hooks if hook.kind != "finalise"]
        self.by_name = {hook.name: hook for hook in hooks}
        super().__init__(
            name, connections, [_spec(h) for h in hooks], self._produce, lambda: model.now_ns
        )
        self.registered = set(self.outgoing)
        self.held_until_ns: int | None = None
        self.may_pass = False
        self.is_active = self.is_over = False
        self.sent_by_hook: dict[tuple[str, str], int] = {}
        self.numbers: dict[str, int] = {}
        self.trace: list[tuple[int, str, Any]] = []

    def one_pass(self) -> None:
        if not self.may_pass:
            return
        for hook in sorted(self.hooks, key=lambda each: (each.last_turn, each.place)):
            if self.is_ready(hook):
                if self.events:
                    return
                self.run(hook)
                if self.held_until_ns is not None:
                    return

    def on_packet(self, c: Connection, packet: Any) -> None:
        self.model.received[str(c)] += 1
        super().on_packet(c, packet)

    def loop_back_if_startable(self) -> None:
        """The model passes until nothing can start."""

    def is_ready(self, hook: NaiveHook) -> bool:
        if self.is_over or (hook.spec.kind is not HookKind.INITIALISE and not self.is_active):
            return False
        return super().is_ready(hook)

    def run(self, hook: NaiveHook) -> None:
        before = len(self.log)
        super().run(hook)
        for kind, *rest in self.log[before:]:
            if kind == "acknowledge":
                self.model.acknowledge(rest[0], rest[1])
            elif kind == "run":
                self.trace.append((self.model.now_ns, rest[0], self._as_read(hook, rest[1])))
        sends = [rest for kind, *rest in self.log[before:] if kind == "send"]
        duration_ns = self.model.duration_ns(self.name, hook)
        if duration_ns:
            self.held_until_ns = self.model.now_ns + duration_ns
            self.ending = sends
        else:
            self.send(sends)

    def send(self, sends: list[Any]) -> None:
        for name, packet in sends:
            self.model.send(name, packet)

    def next_tick_ns(self) -> int | None:
        """The next time at which a tick can become due."""
        if self.start_ns is None or self.is_over:
            return None
        periods = [round(h.spec.period_s * 1e9) for h in self.hooks if h.spec.period_s is not None]
        passed = self.model.now_ns - self.start_ns
        return min((self.start_ns + (passed // p + 1) * p for p in periods), default=None)

    def _as_read(self, hook: NaiveHook, arguments: list[Any]) -> list[Any]:
        read = []
        for port, argument in zip(hook.spec.inputs, arguments, strict=True):
            is_byte = self.described.inputs[port.name].kind == "byte"
            packets = argument if port.is_all else [argument]
            seen = [
                None if p is None else [p[0], p[1] % 256 if is_byte else p[1], True]
                for p in packets
            ]
            read.append(None if argument is None else seen)
        return read

    def _produce(self, spec: HookSpec, count: int) -> list[Any]:
        hook, arguments = self.by_name[spec.name], self.log[-1][2]
        is_empty = all(not any(p or [] if isinstance(p, list) else [p]) for p in arguments)
        packets: list[Any] = []
        for sent in hook.outputs:
            so_far = self.sent_by_hook.get((hook.name, sent.port), 0)
            is_wanted = count % sent.every == 0 and not (
                (sent.at_most and so_far >= sent.at_most) or (sent.is_answer and is_empty)
            )
            if sent.is_optional and not is_wanted:
                packets.append(None)
                continue
            self.sent_by_hook[hook.name, sent.port] = so_far + 1
            number = self.numbers[sent.port] = self.numbers.get(sent.port, 0) + 1
            origin = self.model.project.origins.index(f"{self.name}.{sent.port}")
            packets.append((origin, number))
        return packets


class Model:
    """The whole project."""

    def __init__(self, project: Project, timing: Timing) -> None:
        self.project, self.timing = project, timing
        self.now_ns = 0
        self.connections = [
            Connection(
                c.source_node,
                c.source_output,
                c.destination_node,
                c.destination_input,
                c.discard_limit,
                c.queue_size,
                index,
            )
            for index, c in enumerate(project.connections)
        ]
        self.by_name = {str(c): c for c in self.connections}
        self.seed = json.dumps({n.name: {"SEED": SEED} for n in project.nodes}, sort_keys=True)
        self.under_way: list[tuple[int, int, int, str, Any]] = []
        self.sent: dict[tuple[str, str], int] = {}
        self.last_ns: dict[tuple[str, str], int] = {}
        self.received = {str(c): 0 for c in self.connections}
        self.nodes = {node.name: Node(self, node.name, self.connections) for node in project.nodes}

    def run(self) -> Trace:
        for node in self.nodes.values():
            self.settle(node)
        while self.go_on(None):
            """Until nothing initialises any more."""
        start_ns = self.now_ns
        for node in self.nodes.values():
            node.is_active = True
        for node in self.nodes.values():
            self.settle(node)
        while self.go_on(start_ns + round(self.project.seconds * 1e9)):
            """Until the end."""
        for node in self.nodes.values():
            node.is_over = True
        while self.go_on(None):
            """Until all that is under way has arrived."""
        starts = {
            name: [(max(0, ns - start_ns), hook, taken) for ns, hook, taken in node.trace]
            for name, node in self.nodes.items()
        }
        return Trace(starts, self.received)

    def go_on(self, end_ns: int | None) -> bool:
        """Handle the next instant; returns whether there was one before the end."""
        times = [
            max(event[0], self.nodes[self.end_of(event[3], event[4])].held_until_ns or 0)
            for event in self.under_way
        ]
        for node in self.nodes.values():
            if node.held_until_ns is not None:
                times.append(node.held_until_ns)
            elif (tick_ns := node.next_tick_ns()) is not None:
                times.append(tick_ns)
        if not times or (end_ns is not None and min(times) >= end_ns):
            return False
        self.now_ns = min(times)
        for node in self.nodes.values():
            self.settle(node)
        return True

    def settle(self, node: Node) -> None:
        """One instant of one node: arrivals, the end of its hook, its own packets, passes."""
        node.may_pass = False
        if node.held_until_ns is not None and node.held_until_ns > self.now_ns:
            return
        for event in self.arrivals(node):
            self.under_way.remove(event)
            _, _, _, name, content = event
            connection = self.by_name[name]
            if isinstance(content, int):
                node.on_acknowledgement(connection, content)
            else:
                before = len(node.log)
                node.on_packet(connection, content)
                for kind, *rest in node.log[before:]:
                    if kind == "acknowledge":
                        self.acknowledge(rest[0], rest[1])
        if node.held_until_ns is not None:
            node.held_until_ns = None
            node.send(node.ending)
        while node.held_until_ns is None:
            while node.events:
                node.posted_event()
            before = node.turn
            node.may_pass = True
            node.one_pass()
            node.may_pass = False
            if node.turn == before:
                return

    def arrivals(self, node: Node) -> list[Any]:
        found = [
            event
            for event in self.under_way
            if event[0] <= self.now_ns and self.end_of(event[3], event[4]) == node.name
        ]
        return sorted(found, key=lambda event: event[:3])

    def end_of(self, name: str, content: Any) -> str:
        connection = self.by_name[name]
        is_back = isinstance(content, int)
        return connection.source_node if is_back else connection.destination_node

    def send(self, name: str, packet: Any) -> None:
        number = self.count("delay", name)
        loss = self.timing.losses[name]
        if Draws(self.seed, "loss", name).share(number) >= loss:
            self.travel("delay", name, number, packet)

    def acknowledge(self, name: str, position: int) -> None:
        if self.by_name[name].source_node != self.by_name[name].destination_node:
            number = self.count("acknowledgement", name)
            self.travel("acknowledgement", name, number, position)

    def count(self, way: str, name: str) -> int:
        number = self.sent[way, name] = self.sent.get((way, name), 0) + 1
        return number

    def travel(self, way: str, name: str, number: int, content: Any) -> None:
        written = self.timing.delays[name]
        delay = Distribution.of(0.0001 if written is None else written)
        share = Draws(self.seed, way, name).share(number)
        arrival_ns = max(
            self.now_ns + max(1000, delay.at_ns(share)), self.last_ns.get((way, name), 0)
        )
        self.last_ns[way, name] = arrival_ns
        self.under_way.append((arrival_ns, self.by_name[name].index, number, name, content))

    def duration_ns(self, node: str, hook: NaiveHook) -> int:
        written = self.timing.durations.get((node, hook.spec.name))
        if written is None or hook.spec.kind is HookKind.INITIALISE:
            return 0
        draws = Draws(self.seed, "hook", node, hook.spec.name)
        return Distribution.of(written).at_ns(draws.share(hook.executions))


def _spec(hook: Hook) -> HookSpec:
    def function(*_: Any) -> None: ...

    function.__name__ = hook.name
    return HookSpec(
        HookKind(hook.kind),
        function,
        tuple(InputSpec(each.port, each.is_all, each.is_optional) for each in hook.inputs),
        tuple(OutputSpec(each.port, each.is_optional) for each in hook.outputs),
        period_s=hook.seconds if hook.kind == "tick" else None,
    )


def differences(project: Project, number: int, backend: str = LOCAL) -> Iterator[str]:
    """How what NeuROS does in virtual time differs from the model; nothing if it does not.

    A launched run drains, which the model knows nothing of: all of it is compared with a run in
    process, and that up to the end of the duration with the model.
    """
    project = for_virtual_time(project)
    if not project.nodes:
        return
    timing = timing_of(project, number)
    expected = Model(project, timing).run()
    if backend == LOCAL:
        yield from _between(expected, observed(project, timing))
        return
    in_process, found = (launched(project, timing, each) for each in ("in-process", backend))
    yield from (f"in process against {backend}: {each}" for each in _between(in_process, found))
    end_ns = round(project.seconds * 1e9)
    for name, starts in in_process.starts.items():
        in_process.starts[name] = [start for start in starts if start[0] < end_ns]
    in_process.received, in_process.end = expected.received, expected.end
    yield from _between(expected, in_process)


def _between(expected: Trace, found: Trace) -> Iterator[str]:
    if found.end != expected.end:
        yield f"it ended with {found.end!r}, and should with {expected.end!r}"
    for name, starts in expected.starts.items():
        for place, (wanted, seen) in enumerate(zip(starts, found.starts[name], strict=False)):
            if list(wanted) != list(seen):
                yield f"{name}: start {place + 1} is {seen}, and should be {wanted}"
                break
        else:
            if len(starts) != len(found.starts[name]):
                yield f"{name}: {len(found.starts[name])} starts, and should be {len(starts)}"
    for key, count in expected.received.items():
        if found.received[key] != count:
            yield f"{key}: {found.received[key]} received, and should be {count}"
