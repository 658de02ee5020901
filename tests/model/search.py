"""Visits every state that a modelled project can come into, and judges them.

A state is restored by doing its choices again from the beginning, so nothing of an engine has to
be copied. Two states are one if all that can still matter is equal: wall times, and counters that
only people read, cannot.
"""

from __future__ import annotations

import functools
import hashlib
import types
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from typing import Any

import msgspec

from neuros.control import Probed
from neuros.errors import NeurosError
from neuros.hooks import HookSpec
from neuros.project.model import Connection

from .world import Broken, Project, World

_WITHOUT_EFFECT = frozenset(
    {
        *("_clock", "clock", "created_ns", "since_ns", "spent_ns", "busy_ns", "tick_start_ns"),
        *("taken_ns", "sent_ns", "acknowledged_ns", "due_ns", "missed_ticks", "ticks"),
        *("execution_log", "executions", "taken", "longest_discard", "discards_in_a_row"),
        *("executing", "_cause", "rest", "last_turn", "new_turn", "_arrivals"),
        # There is one round of probes at a time.
        "world",
        *("_asked_s", "_pause_s", "_number", "candidates", "connections", "_connections"),
    }
)

Trace = tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Found:
    """What a search has found.

    Attributes:
        states: how many there are, or were visited.
        is_complete: whether that is all of them.
        broken: the rule that does not hold, empty if all do, and ``trace``, how it comes to that.
    """

    states: int
    is_complete: bool
    broken: str = ""
    trace: Trace = ()


def search(project: Project, most_states: int = 1_000_000) -> Found:
    """Visit all states, depth first.

    Args:
        most_states: after so many it ends, and cannot tell whether the goal is always reachable.
    """
    world = World(project)
    start = fingerprint(world)
    traces: dict[bytes, Trace] = {start: ()}
    before: dict[bytes, set[bytes]] = defaultdict(set)
    done: set[bytes] = set()
    waiting: list[tuple[bytes, Trace, tuple[Any, ...]]] = [
        (start, (), choice) for choice in world.choices()
    ]
    here: Trace | None = ()
    while waiting:
        state, trace, choice = waiting.pop()
        if here != trace:
            world = _at(project, trace)
        here = (*trace, choice)
        try:
            world.do(choice)
        except (Broken, NeurosError) as broken:
            return Found(len(traces), False, str(broken), here)
        after = fingerprint(world)
        before[after].add(state)
        if world.is_done:
            done.add(after)
        if after in traces:
            here = None
            continue
        traces[after] = here
        if len(traces) >= most_states:
            return Found(len(traces), False)
        waiting += [(after, here, each) for each in world.choices()]
    stuck = traces.keys() - _all_before(done, before)
    if stuck:
        shortest = min((traces[state] for state in stuck), key=len)
        return Found(len(traces), True, "from here on it never comes to its goal", shortest)
    return Found(len(traces), True)


def told(trace: Trace) -> str:
    """A trace, one line for each choice."""
    return "\n".join(" ".join(map(_name, choice)) for choice in trace)


def fingerprint(world: World) -> bytes:
    """Equal for two worlds in which the same can still happen."""
    for name, node in world.nodes.items():
        if name not in world.fingerprints:  # the others have done nothing since the last time
            world.fingerprints[name] = _digest(node)
    between = [world.channels, world.probing, world.losses, world.ticks, world.has_crashed,
               world.is_ending, world.is_drained]  # fmt: skip
    return _digest(between) + b"".join(world.fingerprints.values())


def _digest(value: Any) -> bytes:
    return hashlib.blake2b(repr(_plain(value, {})).encode(), digest_size=16).digest()


def _at(project: Project, trace: Trace) -> World:
    world = World(project)
    for choice in trace:
        world.do(choice)
    return world


def _all_before(done: set[bytes], before: Mapping[bytes, set[bytes]]) -> set[bytes]:
    """The states from which one of these can be reached."""
    found, waiting = set(done), deque(done)
    while waiting:
        for state in before.get(waiting.popleft(), ()):
            if state not in found:
                found.add(state)
                waiting.append(state)
    return found


def _name(part: Any) -> str:
    return " ".join(map(str, part)) if isinstance(part, tuple) else str(part)


def _plain(value: Any, seen: dict[int, int]) -> Any:
    """A value as nested tuples; objects that were met before by their number."""
    if value is None or isinstance(value, (bool, int, float, str, bytes, Enum)):
        return value
    if isinstance(value, (Connection, HookSpec)):
        return str(value) if isinstance(value, Connection) else value.name
    if isinstance(value, tuple):
        return tuple(_plain(each, seen) for each in value)
    if id(value) in seen:
        return ("again", seen[id(value)])
    seen[id(value)] = len(seen)
    if isinstance(value, (list, deque)):
        return tuple(_plain(each, seen) for each in value)
    if isinstance(value, (set, frozenset)):
        return ("set", *sorted(repr(_plain(each, dict(seen))) for each in value))
    if isinstance(value, dict):
        items = [
            (k, v)
            for k, v in value.items()
            if not (isinstance(v, deque) and not v) and k not in _WITHOUT_EFFECT
        ]
        return ("dict", *((_plain(k, seen), _plain(v, seen)) for k, v in items))
    if isinstance(value, types.MethodType):
        return ("method", value.__func__.__qualname__, _plain(value.__self__, seen))
    if isinstance(value, types.FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        return ("function", value.__qualname__, _plain(cells, seen))
    if isinstance(value, functools.partial):
        return ("partial", _plain(value.func, seen), _plain(value.args, seen))
    if isinstance(value, World):  # what can change in it is a part of every fingerprint
        return "world"
    if isinstance(value, msgspec.Struct):
        names = set(value.__struct_fields__)
        if isinstance(value, Probed):  # there is one round of probes at a time
            names.remove("number")
        return (type(value).__name__, *(_plain(getattr(value, n), seen) for n in sorted(names)))
    if is_dataclass(value) and not isinstance(value, type):
        return (type(value).__name__, *(_plain(getattr(value, f.name), seen) for f in fields(value)
                                        if f.name not in _WITHOUT_EFFECT))  # fmt: skip
    if isinstance(value, type) or not hasattr(value, "__module__"):
        return getattr(value, "__qualname__", type(value).__name__)
    return (type(value).__name__, *((name, _plain(each, seen)) for name, each in _state(value)))


def _state(value: Any) -> list[tuple[str, Any]]:
    """Attributes of an object that can have an effect."""
    names = [*getattr(value, "__dict__", {})]
    for kind in type(value).__mro__:
        names += getattr(kind, "__slots__", ())
    found = []
    for name in names:
        if name not in _WITHOUT_EFFECT and hasattr(value, name):
            each = getattr(value, name)
            found.append((name, each > 0 if name == "turn" else each))
    return found
