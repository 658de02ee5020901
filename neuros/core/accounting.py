"""Where a node's wall time goes: executing, waiting, blocked by a receiver, idle, or paused.

Between two events nothing of a node changes, so the time between them has one cause, which is
asked for once, when the next event arrives.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from neuros.core.hook import Hook


class State(str, Enum):
    """What a node does at a moment."""

    REGISTERING = "registering"
    EXECUTING = "executing"
    WAITING = "waiting"
    BLOCKED = "blocked"
    IDLE = "idle"
    SCHEDULING = "scheduling"
    PAUSED = "paused"

    __hash__ = str.__hash__  # time is booked at every event, and Enum's own is ten times slower


class Rest(NamedTuple):
    """Why a node does nothing: a state, and the input or connection behind it."""

    state: State
    cause: str = ""


REGISTERING = Rest(State.REGISTERING)
SCHEDULING = Rest(State.SCHEDULING)
IDLE = Rest(State.IDLE)
PAUSED = Rest(State.PAUSED)


@dataclass
class Accounts:
    """Nanoseconds of wall time by cause; executing time is kept by each hook."""

    totals_ns: Counter[Rest] = field(default_factory=Counter)


def cause_of_rest(hooks: Iterable[Hook]) -> Rest:
    """What holds up the node: a receiver, else a missing input, else only its clock.

    A hook that could run (and will, at the next event) makes it ``SCHEDULING``. Before its time a
    tick hook waits for nothing but its clock.
    """
    waiting: Rest | None = None
    blocked: Rest | None = None
    for hook in hooks:
        if not (hook.is_enabled and hook.is_due):
            continue
        slot = hook.missing_slot()
        if slot is not None:
            if waiting is None:
                waiting = slot.rest
        elif hook.can_send():
            return SCHEDULING
        elif blocked is None:
            blocked = hook.blocking_outlets()[0].rest
    return blocked or waiting or IDLE
