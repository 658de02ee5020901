"""Clocks of another machine: how far they are off, and times of its nodes on the clock of this one.

Each machine counts its monotonic time from a moment of its own. So what nodes there report, and
the times in their packet logs, are moved by the difference, which is known to half of the time that
a message takes there and back.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neuros.control import FROM_NODES, Message, NodeStatus, Probed, Report
from neuros.control.link import decode, encode, kind_of
from neuros.control.machines import Pong
from neuros.errors import ControlError

_MOST_DRIFT = 1e-4
"""Seconds per second by which clocks drift apart: crystals are within 1e-4 of what they show."""

_ACCEPTED = {kind_of(each): each for each in FROM_NODES}
_WITH_TIMES = tuple(f'{{"kind": "{kind_of(each)}"' for each in (Report, Probed, NodeStatus))
# Columns of times in the files of a packet log, of so many columns each.
_TIMES: Mapping[str, tuple[int, tuple[int, ...]]] = {
    "sent_ns": (1, (0,)),
    "taken_ns": (1, (0,)),
    "executions": (3, (1, 2)),
    "credits": (3, (2,)),
}


@dataclass
class ClockOffset:
    """How far the clocks of another machine are ahead of this one's, in seconds.

    Clocks of two machines drift apart. So an answer counts for less the older it is, as in NTP
    (RFC 5905, dispersion): its error is at most half of its round trip, and what the clocks may
    have drifted since. The one of the smallest error counts.

    Attributes:
        round_trip_s: of the answer that it is known from.
        monotonic_s, unix_s: the difference of the monotonic clocks, and of those that show the time
            of day, at that answer.
    """

    round_trip_s: float = float("inf")
    monotonic_s: float = 0.0
    unix_s: float = 0.0
    _known_at_s: float = 0.0
    _course: list[tuple[float, float, float]] = field(default_factory=list)

    def take(self, pong: Pong, now_s: float, now_unix_s: float) -> None:
        """An answer that arrives now, by the clocks of this machine."""
        round_trip_s = now_s - pong.sent_s
        drift_s = _MOST_DRIFT * (now_s - self._known_at_s)
        if round_trip_s / 2 < self.round_trip_s / 2 + drift_s:
            self.round_trip_s, self._known_at_s = round_trip_s, now_s
            ahead_s = pong.monotonic_s - (now_s - round_trip_s / 2)
            # Containers of one machine have one clock.
            self.monotonic_s = ahead_s if abs(ahead_s) > round_trip_s else 0.0
            self.unix_s = pong.unix_s - (now_unix_s - round_trip_s / 2)
            self._note(pong.monotonic_s, round_trip_s / 2)

    def _note(self, at_s: float, error_s: float) -> None:
        """Keep what is known of this moment, on the clock there, for packet logs."""
        while self._course:
            earlier_s, _, earlier_error_s = self._course[-1]
            if earlier_error_s <= error_s + _MOST_DRIFT * (at_s - earlier_s):
                break
            self._course.pop()  # now it is better known, for that moment too
        self._course.append((at_s, self.monotonic_s, error_s))

    @property
    def is_known(self) -> bool:
        """Whether there was an answer."""
        return self.round_trip_s < float("inf")

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
        course = [(round(1e9 * at_s), round(1e9 * ahead_s)) for at_s, ahead_s, _ in self._course]
        for file in sorted(folder.glob("*")):
            width, columns = _TIMES.get(file.name.rpartition(".")[2], (1, ()))
            if columns:
                entries = array("q")
                data = file.read_bytes()
                entries.frombytes(data[: len(data) // 8 * 8])
                for column in columns:
                    _shift(entries, column, width, course)
                file.write_bytes(entries.tobytes())


def _sample_here(sample: Mapping[str, Any], shift_s: float) -> dict[str, Any]:
    """Sampled fields: each row begins with its time."""
    rows = [[row[0] - shift_s, *row[1:]] for row in sample.get("values", ())]
    return {**sample, "values": rows} if rows else dict(sample)


def _shift(entries: array[int], column: int, width: int, course: Sequence[tuple[int, int]]) -> None:
    times = [at_ns for at_ns, _ in course]
    moved = [at_ns - _ahead_ns(at_ns, times, course) for at_ns in entries[column::width]]
    entries[column::width] = array("q", moved)


def _ahead_ns(at_ns: int, times: Sequence[int], course: Sequence[tuple[int, int]]) -> int:
    """How far the clock there was ahead, on a straight line between two answers."""
    after = bisect_right(times, at_ns)
    if not course:
        return 0
    if after in (0, len(course)):
        return course[max(0, after - 1)][1]
    (from_ns, ahead_ns), (to_ns, then_ns) = course[after - 1], course[after]
    return ahead_ns + (then_ns - ahead_ns) * (at_ns - from_ns) // (to_ns - from_ns)
