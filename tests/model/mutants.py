"""Rules broken on purpose: each must be noticed in some project, else the model proves nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import neuros.launcher.quiescence as quiescence
from neuros.engine.connection_ends import InputQueue, SendWindow, Subscription
from neuros.engine.engine import Engine
from neuros.engine.hook import Hook
from neuros.engine.schedule import FIRST_TURN, Lifecycle, Schedule
from neuros.project.model import Connection


@dataclass(frozen=True)
class Mutant:
    """A rule that does not hold while ``apply()`` is entered.

    Attributes:
        project: the one in which it must be noticed.
    """

    rule: str
    project: str
    apply: Callable[[], AbstractContextManager[object]]


_begin_if_registered = Lifecycle._begin_if_registered
_start = Lifecycle.start
_subscription = Subscription.__init__
_put = Subscription.put


def _begin_at_once(lifecycle: Lifecycle) -> None:
    lifecycle._unregistered = 0
    _begin_if_registered(lifecycle)


def _begin_alone(lifecycle: Lifecycle, *, awaits_others: bool) -> None:
    _start(lifecycle, awaits_others=False)


def _spend_without_window(window: SendWindow, now_ns: int) -> None:
    window.sent += 1


def _acknowledges_on_arrival(subscription: Subscription, arrival: int, packet: Any) -> None:
    _put(subscription, arrival, packet)
    if subscription.is_acknowledged:
        subscription.acknowledge(subscription.received)


def _position_of_the_first(subscription: Subscription, queue: InputQueue | None = None) -> int:
    return subscription.queues[0].position


def _holds_one(subscription: Subscription, *arguments: Any, **options: Any) -> None:
    _subscription(subscription, *arguments, **{**options, "is_lossless": False})
    subscription.capacity = 1


def _stay_first(schedule: Schedule, hook: Hook) -> None:
    for other in schedule.order:
        other.turn = schedule.last_turn + 1  # behind each pass
    hook.turn = FIRST_TURN


MUTANTS: Sequence[Mutant] = (
    Mutant(
        "a node begins when all its receivers are there",
        "a question and its answer",
        lambda: patch.object(Lifecycle, "_begin_if_registered", _begin_at_once),
    ),
    Mutant(
        "a node runs when every node is ready",
        "one lossless connection",
        lambda: patch.object(Lifecycle, "start", _begin_alone),
    ),
    Mutant(
        "a hook runs when every receiver of its outputs is ready",
        "one lossless connection",
        lambda: patch.object(SendWindow, "spend", _spend_without_window),
    ),
    Mutant(
        "a packet is acknowledged when a hook starts on it, and not before",
        "a longer queue for a slow taker",
        lambda: patch.object(Subscription, "put", _acknowledges_on_arrival),
    ),
    Mutant(
        "a packet is acknowledged when every taker has started on it",
        "two takers, of which one waits for more",
        lambda: patch.object(Subscription, "position_if_consumed", _position_of_the_first),
    ),
    Mutant(
        "an acknowledgement opens the window again",
        "one lossless connection",
        lambda: patch.object(SendWindow, "credit", lambda *_: None),
    ),
    Mutant(
        "at most N packets in a row are discarded",
        "limit 1 with a slow taker",
        lambda: patch.object(
            Connection, "window", property(lambda c: c.queue_size + 2 * (c.discard_limit or 0))
        ),
    ),
    Mutant(
        "nothing is discarded with limit 0",
        "a longer queue for a slow taker",
        lambda: patch.object(Subscription, "__init__", _holds_one),
    ),
    Mutant(
        "the hook that was least recently executed comes first",
        "two hooks of which one never rests",
        lambda: patch.object(Schedule, "move_to_end", _stay_first),
    ),
    Mutant(
        "hooks that send unasked stop when the end is drained",
        "a tick, ended",
        lambda: patch.object(Lifecycle, "drain", lambda *_: None),
    ),
    Mutant(
        "a loop in lockstep goes round once more at most",
        "lockstep, ended",
        lambda: patch.object(Lifecycle, "finish_round", lambda *_: None),
    ),
    Mutant(
        "it is drained when no packet and no acknowledgement is under way",
        "a chain, ended",
        lambda: patch.object(quiescence, "under_way", lambda *_: []),
    ),
    Mutant(
        "no hook starts after the end",
        "a chain in which a node dies",
        lambda: patch.object(Engine, "stop_hooks", lambda _: None),
    ),
)
