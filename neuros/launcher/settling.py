"""Finds out when nothing moves any more in a run that is paused: the end of a step of a session.

Each node process answers when no event waits in it. Two of them are not asked at one instant, so a
packet may be under way between them: one round of answers with equal counters at both ends is not
enough, two equal rounds are (F. Mattern, "Algorithms for distributed termination detection", 1987).
One process alone, which hands packets over in memory, is at rest when it says so.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

from neuros.control import AtRest, NewestPacket, Pause, Settle, Settled
from neuros.control.link import ControlLink
from neuros.launcher.channels import Channels

_FIRST_PAUSE_S = 0.0005
_LONGEST_PAUSE_S = 0.02
_LOST_AFTER_S = 0.1
"""On a connection that may lose packets, one that has not arrived for so long has been lost."""
_NEVER_S = 3600.0


class Settling:
    """Answers ``settle`` of a session: once all nodes have begun, and nothing moves.

    Args:
        names: the nodes, all of which have to answer.
    """

    def __init__(self, names: Iterable[str], channels: Channels) -> None:
        self._names = set(names)
        self._channels = channels
        self._asker: ControlLink | None = None
        self._asked = Settle(0, {})
        self._round = 0
        self._pause_s = 0.0
        self._due_s: float | None = None
        self._answers: dict[tuple[str, ...], AtRest] = {}
        self._packets: dict[str, NewestPacket] = {}
        self._last: tuple[Any, ...] | None = None
        self._differs_since_s = 0.0

    @property
    def wait_s(self) -> float:
        """Seconds until :meth:`look` has something to do."""
        return _NEVER_S if self._due_s is None else max(0.0, self._due_s - time.monotonic())

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
        if self._due_s is not None and time.monotonic() >= self._due_s:
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
        self._due_s = time.monotonic() + self._pause_s

    def _judge(self, asker: ControlLink) -> None:
        answers = self._answers.values()
        now = tuple((a.nodes, a.sent, a.received) for a in sorted(answers, key=_nodes_of))
        is_unchanged, self._last = now == self._last, now
        if not is_unchanged:
            self._differs_since_s = time.monotonic()
        if not all(answer.has_begun for answer in answers) or self._is_under_way():
            self._ask_later()
        elif len(self._answers) == 1 or is_unchanged:
            self._answer(asker)
        else:
            self._begin_round()

    def _is_under_way(self) -> bool:
        """Whether a packet or an acknowledgement is on its way, and not lost."""
        sent = _joined(answer.sent for answer in self._answers.values())
        received = _joined(answer.received for answer in self._answers.values())
        different = [key for key in sent if sent[key] != received[key]]
        if any(sent[key][1] >= 0 for key in different):
            return True
        is_recent = time.monotonic() - self._differs_since_s < _LOST_AFTER_S
        return bool(different) and is_recent

    def _answer(self, asker: ControlLink) -> None:
        self._asker = None
        self._channels.send(Pause())  # takes back what hooks could not use of a step
        times = {n: t for answer in self._answers.values() for n, t in answer.sim_times.items()}
        self._channels.send_to(asker, Settled(self._asked.number, times, dict(self._packets)))


def _nodes_of(answer: AtRest) -> tuple[str, ...]:
    return answer.nodes


def _joined(parts: Iterable[Mapping[str, tuple[int, int]]]) -> dict[str, tuple[int, int]]:
    return {key: counts for part in parts for key, counts in part.items()}
