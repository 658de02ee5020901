"""Finds nodes that fall behind: packets that have waited for long, though nothing else is missing.

A node that works on old packets looks busy and healthy. It falls behind where a long queue feeds a
slow hook, or where a callback of its plugin runs for long, so that nothing is taken in meanwhile.
How long the oldest packet has waited follows from the counters of the reports, which come once per
second: it arrived before the first report that counts it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from neuros.project.model import Connection

BEHIND_S = 5.0
"""A packet that has waited for so long is old."""

_Samples = deque[tuple[float, int]]


class Backlog:
    """How old the oldest packet of each connection is.

    Args:
        connections: those among the nodes whose reports are taken.
    """

    def __init__(self, connections: Sequence[Connection]) -> None:
        self._connections = {str(connection): connection for connection in connections}
        self._received: dict[str, _Samples] = {key: deque() for key in self._connections}
        self._sent: dict[str, _Samples] = {key: deque() for key in self._connections}
        self._counted: dict[str, int] = dict.fromkeys(self._connections, 0)
        self._takers: dict[str, tuple[str, int]] = {}
        self._named: set[str] = set()

    def report(self, report: Mapping[str, Any], now_s: float) -> None:
        """Take a report of a node."""
        metrics = report["metrics"]
        if metrics is None:
            return
        for key, counts in metrics["outgoing"].items():
            if key in self._sent and counts["is_reliable"]:
                self._sent[key].append((now_s, counts["sent"]))
        for key, counts in metrics["incoming"].items():
            if key not in self._received:
                continue
            self._counted[key] = counts["received"]
            self._received[key].append((now_s, counts["received"]))
            _drop(self._received[key], counts["received"] - counts["unread"])
            if counts["taker"] is None:
                self._takers.pop(key, None)
            else:
                self._takers[key] = counts["taker"], counts["unread"]

    def begin_anew(self) -> None:
        """Something has kept the nodes still: what waited meanwhile is not behind."""
        for samples in (*self._received.values(), *self._sent.values()):
            samples.clear()

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """What to tell the user now, as ``(severity, text)``: each connection once."""
        for key, connection in self._connections.items():
            if key in self._named:
                continue
            node = connection.destination_node
            _drop(self._sent[key], self._counted[key])
            if key in self._takers and _age_s(self._received[key], now_s) >= BEHIND_S:
                self._named.add(key)
                hook, unread = self._takers[key]
                yield (
                    "WARN",
                    f"{node} has fallen behind: the oldest of {unread} unread packets on `{key}`"
                    f" has waited for over {BEHIND_S:g} s, and hook '{hook}' is ready for it."
                    " A smaller queue_size, or a discard_limit, keeps packets fresh",
                )
            elif _age_s(self._sent[key], now_s) >= BEHIND_S:
                self._named.add(key)
                yield (
                    "WARN",
                    f"{node} has fallen behind: it has taken nothing in for over {BEHIND_S:g} s,"
                    f" though packets wait on `{key}`. A callback of its plugin (of a subscription,"
                    " timer or service) runs for long, or its process gets no processor time",
                )


def _drop(samples: _Samples, settled: int) -> None:
    """Forget the reports that count no packet beyond the first ``settled``."""
    while samples and samples[0][1] <= settled:
        samples.popleft()


def _age_s(samples: _Samples, now_s: float) -> float:
    return now_s - samples[0][0] if samples else 0.0
