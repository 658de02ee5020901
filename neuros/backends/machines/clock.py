"""Clocks of another machine: how far they are off, and times of its nodes on the clock of this one.

Each machine counts its monotonic time from a moment of its own. So what nodes there report, and
the times in their packet logs, are moved by the difference, which is known to half of the time that
a message takes there and back. Quartz clocks drift apart, by some 10 us per second: what was known
of the difference gets old.
"""

from __future__ import annotations

import bisect
import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neuros.control import FROM_NODES, Message, NodeStatus, Probed, Report
from neuros.control.link import decode, encode, kind_of
from neuros.control.machines import Pong
from neuros.errors import ControlError

_ACCEPTED = {kind_of(each): each for each in FROM_NODES}
_WITH_TIMES = tuple(f'{{"kind": "{kind_of(each)}"' for each in (Report, Probed, NodeStatus))
# Columns of times in the files of a packet log, of so many columns each.
_TIMES: Mapping[str, tuple[int, tuple[int, ...]]] = {
    "sent_ns": (1, (0,)),
    "taken_ns": (1, (0,)),
    "executions": (3, (1, 2)),
    "credits": (3, (2,)),
}


_SPAN_S = 30.0


@dataclass
class _Answer:
    """What the fastest answer within a span of time says; times in seconds, by both clocks."""

    from_s: float
    round_trip_s: float
    there_s: float
    monotonic_s: float
    unix_s: float


class ClockOffset:
    """How far the clocks of another machine are ahead of this one's, in seconds.

    The fastest answer says most; of each half minute that one is kept. Now the last two half
    minutes count, for the times in packet logs those around each time.
    """

    def __init__(self) -> None:
        self._answers: list[_Answer] = []

    def take(self, pong: Pong, now_s: float, now_unix_s: float) -> None:
        """An answer that arrives now, by the clocks of this machine."""
        round_trip_s = now_s - pong.sent_s
        ahead_s = pong.monotonic_s - (now_s - round_trip_s / 2)
        # Containers of one machine have one clock.
        ahead_s = ahead_s if abs(ahead_s) > round_trip_s else 0.0
        unix_s = pong.unix_s - (now_unix_s - round_trip_s / 2)
        is_new = not self._answers or now_s >= self._answers[-1].from_s + _SPAN_S
        from_s = now_s if is_new else self._answers[-1].from_s
        answer = _Answer(from_s, round_trip_s, pong.monotonic_s, ahead_s, unix_s)
        if is_new:
            self._answers.append(answer)
        elif round_trip_s < self._answers[-1].round_trip_s:
            self._answers[-1] = answer

    @property
    def is_known(self) -> bool:
        """Whether there was an answer."""
        return bool(self._answers)

    @property
    def round_trip_s(self) -> float:
        """Of the answer that the difference is known from."""
        return self._now.round_trip_s if self._answers else math.inf

    @property
    def monotonic_s(self) -> float:
        """The difference of the monotonic clocks, 0 before the first answer."""
        return self._now.monotonic_s if self._answers else 0.0

    @property
    def unix_s(self) -> float:
        """The difference of the clocks that show the time of day."""
        return self._now.unix_s if self._answers else 0.0

    @property
    def _now(self) -> _Answer:
        return min(self._answers[-2:], key=lambda answer: answer.round_trip_s)

    def text_here(self, text: str) -> str:
        """Lines of nodes there, with their times on the clock of this machine."""
        return "".join(
            self._line_here(line) for line in text.splitlines(keepends=True) if line.strip()
        )

    def _line_here(self, line: str) -> str:
        if not line.startswith(_WITH_TIMES):
            return line
        try:
            return encode(self.message_here(decode(line.encode(), _ACCEPTED, ""))).decode()
        except ControlError:  # the supervisor says what is wrong with it
            return line

    def message_here(self, message: Message) -> Message:
        """A message of a node there, with its times on the clock of this machine."""
        shift_s, shift_ns = self.monotonic_s, round(1e9 * self.monotonic_s)
        if isinstance(message, Report):
            since_s = message.running_since_s
            return replace(
                message,
                running_since_s=None if since_s is None else since_s - shift_s,
                timeline=tuple((sim_s, wall_s - shift_s) for sim_s, wall_s in message.timeline),
            )
        if isinstance(message, NodeStatus):
            counters = message.counters and replace(
                message.counters,
                now_s=message.counters.now_s - shift_s,
                sent_ns={
                    key: (position, tuple(at_ns - shift_ns for at_ns in times))
                    for key, (position, times) in message.counters.sent_ns.items()
                },
                taken_ns={
                    key: (position, at_ns - shift_ns)
                    for key, (position, at_ns) in message.counters.taken_ns.items()
                },
            )
            samples = {port: _sample_here(each, shift_s) for port, each in message.samples.items()}
            return replace(message, counters=counters, samples=samples)
        return message

    def log_here(self, folder: Path) -> None:
        """Move the times in the packet log of a node there. Raises ``OSError``."""
        for file in sorted(folder.glob("*")):
            width, columns = _TIMES.get(file.name.rpartition(".")[2], (1, ()))
            if columns:
                entries = array("q")
                data = file.read_bytes()
                entries.frombytes(data[: len(data) // 8 * 8])
                for column in columns:
                    moved = [at_ns - self._ahead_ns(at_ns) for at_ns in entries[column::width]]
                    entries[column::width] = array("q", moved)
                file.write_bytes(entries.tobytes())

    def _ahead_ns(self, there_ns: int) -> int:
        """The difference of the monotonic clocks at a time there: between two answers, linear."""
        answers, there_s = self._answers, there_ns / 1e9
        place = bisect.bisect(answers, there_s, key=lambda answer: answer.there_s)
        if 0 < place < len(answers):
            before, after = answers[place - 1 : place + 1]
            share = (there_s - before.there_s) / (after.there_s - before.there_s)
            ahead_s = before.monotonic_s + share * (after.monotonic_s - before.monotonic_s)
        else:
            ahead_s = answers[max(0, place - 1)].monotonic_s if answers else 0.0
        return round(1e9 * ahead_s)


def _sample_here(sample: Mapping[str, Any], shift_s: float) -> dict[str, Any]:
    """Sampled fields: each row begins with its time."""
    rows = [[row[0] - shift_s, *row[1:]] for row in sample.get("values", ())]
    return {**sample, "values": rows} if rows else dict(sample)
