"""What one execution of a hook costs that does nothing: scheduling, bookkeeping, loop-back.

Once on the engine alone (no ROS, no event loop), and once in a real run on either back end.
"""

from __future__ import annotations

import functools
import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.launching import PLUGINS, launch, project_of_plugins
from benchmarks.measure import Case, Figure, Group, Subject
from neuros.engine.engine import Engine
from neuros.engine.event_log import LoggedEngine
from neuros.engine.hook import Hook
from neuros.hooks import hook_specs_of, neuros_function
from neuros.project.model import Connection, Node, Port

RELAY = "engine alone, packet and acknowledgement"
LOGGED = f"{RELAY}, with the event log of recorded runs"


def subject(is_quick: bool) -> Subject:
    """Hook executions per run: enough that one takes most of a second."""
    count = 20_000 if is_quick else 100_000
    candidates = {
        "engine alone, loop-back": functools.partial(loop_back_us, count),
        RELAY: functools.partial(relay_us, count),
        LOGGED: functools.partial(relay_us, count, LoggedEngine),
        "in process": functools.partial(real_run_us, "in-process", count),
        "process": functools.partial(real_run_us, "process", count),
    }
    cases = tuple(
        Case(
            f"execution of a hook, {name}",
            "us",
            Figure(name),
            *((Figure(RELAY), "without event log") if name == LOGGED else ()),
            # The free-running hook as users have it; the engine alone is the profile of it.
            bound="hook" if name == "process" else None,
        )
        for name in candidates
    )
    return Subject("cost per hook execution", (Group(candidates, cases),))


class Surroundings:
    """Effects that have none: hooks are called, everything else goes nowhere."""

    def __init__(self) -> None:
        self.events: deque[Callable[[], None]] = deque()
        self.post = self.post_loop_back = self.events.append

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        return hook.spec.function(self, *arguments)

    def sender(self, port: Port, connections: Sequence[Connection]) -> Callable[[Any], None]:
        return _nowhere

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return _nowhere

    def has_taken_in(self) -> bool:
        return True

    def give_way(self) -> None: ...
    def note_ready(self) -> None: ...

    def copy_to_itself(self, connection: Any, packet: Any) -> Any:
        return packet


def _nowhere(_: object) -> None:
    """Where all goes that the engine sends."""


def loop_back_us(count: int) -> float:
    """Microseconds per execution of a hook without inputs and outputs."""

    def idle(node: Any) -> None: ...

    surroundings = Surroundings()
    _engine([], neuros_function()(idle), surroundings).start()
    start_ns = time.perf_counter_ns()
    for _ in range(count):
        surroundings.events.popleft()()
    return (time.perf_counter_ns() - start_ns) / count / 1e3


def relay_us(count: int, kind: type[Engine] = Engine) -> float:
    """The same for a hook that sends on what arrives, losslessly: two events per execution."""

    def relay(node: Any, packet: Any) -> Any:
        return packet

    arriving = Connection("before", "out", "node", "in_", 0)
    leaving = Connection("node", "out", "after", "in_", 0)
    engine = _engine(
        [arriving, leaving], neuros_function("in_", "out")(relay), Surroundings(), kind
    )
    engine.on_registered(leaving)
    engine.start()
    start_ns = time.perf_counter_ns()
    for position in range(1, count + 1):
        engine.on_packet(arriving, "packet")
        engine.on_acknowledgement(leaving, position)
    return (time.perf_counter_ns() - start_ns) / count / 1e3


def real_run_us(backend: str, count: int) -> float:
    """Microseconds per execution in a run as users start it."""
    node = {
        "name": "idler",
        "container": "neuros_python",
        "plugin": "idler.py",
        "environment": {"EXECUTIONS": str(count)},
    }
    with project_of_plugins({"nodes": [node], "connections": []}) as folder:
        launch(folder, folder / "run", backend)
        return float(json.loads((folder / "run" / "idler" / "result.json").read_text()))


def _engine(
    connections: Sequence[Connection],
    hook: Callable[..., Any],
    surroundings: Surroundings,
    kind: type[Engine] = Engine,
) -> Engine:
    port = "std_msgs/msg/String"
    node = Node(
        "node",
        "neuros_python",
        PLUGINS / "echo.py",
        inputs=tuple(Port("in_", port) for c in connections if c.destination_node == "node"),
        outputs=tuple(Port("out", port) for c in connections if c.source_node == "node"),
    )
    specs = hook_specs_of({hook.__name__: hook})
    return kind(node, connections, specs, surroundings, time.monotonic_ns, None)
