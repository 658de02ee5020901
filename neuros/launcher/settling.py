"""Finds out when nothing moves any more in a run that is paused: the end of a step of a session.

Each node process answers when no event waits in it, and none starts anything unasked. They answer
at different instants, but with counters by connection one round is enough: if something still
moved, then some process was the first to receive a packet after its answer. That was sent before
the answer of its sender, so the counters of this connection would differ (F. Mattern, "Algorithms
for distributed termination detection", 1987, channel counting).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import TypeAlias

from neuros.control import AtRest, NewestPacket, Pause, Settle, Settled
from neuros.control.link import ControlLink
from neuros.launcher.channels import Channels

_FIRST_PAUSE_S = 0.0005
_LONGEST_PAUSE_S = 0.02
_LOST_AFTER_S = 0.1
"""On a connection that may lose packets, one that has not arrived for so long has been lost."""
_NEVER_S = 3600.0

Counts: TypeAlias = Mapping[str, tuple[int, int]]
"""By connection, packets that have passed, and those acknowledged; -1: none ever are."""


class Settling:
    """Answers ``settle`` of a session: once all nodes have begun, and nothing moves.

    Args:
        names: the nodes, all of which have to answer.
        clock: monotonic, seconds.
    """

    def __init__(
        self,
        names: Iterable[str],
        channels: Channels,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._names = set(names)
        self._channels = channels
        self._clock = clock
        self._asker: ControlLink | None = None
        self._asked = Settle(0, {})
        self._round = 0
        self._pause_s = 0.0
        self._due_s: float | None = None
        self._answers: dict[tuple[str, ...], AtRest] = {}
        self._packets: dict[str, NewestPacket] = {}
        self._last: tuple[Counts, Counts] | None = None
        self._last_s = 0.0

    @property
    def wait_s(self) -> float:
        """Seconds until :meth:`look` has something to do."""
        return _NEVER_S if self._due_s is None else max(0.0, self._due_s - self._clock())

    def ask(self, asker: ControlLink, message: Settle) -> None:
        """Find out from now on, and answer this one; what was asked before is answered no more."""
        self._asker, self._asked = asker, message
        self._packets.clear()
        self._pause_s, self._last = 0.0, None
        self._begin_round()

    def take(self, answer: AtRest) -> None:
        """Take an answer of a process, perhaps to the last round."""
        if answer.number != self._round or self._asker is None:
            return
        self._answers[answer.nodes] = answer
        self._packets.update(answer.packets)
        if {name for names in self._answers for name in names} == self._names:
            self._judge(self._asker)

    def look(self) -> None:
        """Ask again where it is time."""
        if self._due_s is not None and self._clock() >= self._due_s:
            self._begin_round()

    def _begin_round(self) -> None:
        self._due_s = None
        if not self._channels.greeted >= self._names:
            self._ask_later()
            return
        self._round += 1
        self._answers.clear()
        known = {name: packet.number for name, packet in self._packets.items()}
        self._channels.send(Settle(self._round, {**self._asked.known, **known}))

    def _ask_later(self) -> None:
        self._pause_s = min(max(2 * self._pause_s, _FIRST_PAUSE_S), _LONGEST_PAUSE_S)
        self._due_s = self._clock() + self._pause_s

    def _judge(self, asker: ControlLink) -> None:
        answers = self._answers.values()
        if not all(answer.has_begun for answer in answers) or self._is_under_way():
            self._ask_later()
        else:
            self._answer(asker)

    def _is_under_way(self) -> bool:
        """Whether a packet or an acknowledgement is on its way, and not lost."""
        sent = _joined(answer.sent for answer in self._answers.values())
        received = _joined(answer.received for answer in self._answers.values())
        different = [key for key in sent if sent[key] != received[key]]
        if any(sent[key][1] >= 0 for key in different):
            return True
        if (sent, received) != self._last:
            self._last, self._last_s = (sent, received), self._clock()
        return bool(different) and self._clock() - self._last_s < _LOST_AFTER_S

    def _answer(self, asker: ControlLink) -> None:
        self._asker = None
        self._channels.send(Pause())  # takes back what hooks could not use of a step
        times = {n: t for answer in self._answers.values() for n, t in answer.sim_times.items()}
        self._channels.send_to(asker, Settled(self._asked.number, times, dict(self._packets)))


def _joined(parts: Iterable[Counts]) -> Counts:
    return {key: counts for part in parts for key, counts in part.items()}
