"""How old packets are, and how long hooks wait, where more arrives than a node can take."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping


class Waits:
    """Takes packets that hold the time of their sending, for ``seconds`` from the first on.

    Args:
        takes_s: how long a packet takes, by the name of its input.
    """

    def __init__(self, takes_s: Mapping[str, float], seconds: float) -> None:
        self._takes_s = takes_s
        self._seconds = seconds
        self._starts_ns: dict[str, list[int]] = {name: [] for name in takes_s}
        self._oldest_ns = dict.fromkeys(takes_s, 0)
        self._begin_ns = 0

    def take(self, name: str, sent_ns: int) -> bool:
        """Work on a packet; returns whether that was the last one."""
        start_ns = time.monotonic_ns()
        self._begin_ns = self._begin_ns or start_ns
        self._starts_ns[name].append(start_ns)
        self._oldest_ns[name] = max(self._oldest_ns[name], start_ns - sent_ns)
        time.sleep(self._takes_s[name])
        return time.monotonic_ns() - self._begin_ns >= self._seconds * 1e9

    def result(self) -> dict[str, float]:
        """By input, the greatest age of a packet and the longest time between two starts, in ms.

        The time since the last start counts, too: an input that is not served at all waits.
        """
        figures = {}
        for name, starts_ns in self._starts_ns.items():
            moments_ns = [self._begin_ns, *starts_ns, time.monotonic_ns()]
            pauses_ns = [after - before for before, after in itertools.pairwise(moments_ns)]
            oldest_ns = self._oldest_ns[name] if starts_ns else max(pauses_ns)
            figures |= {f"{name} age": oldest_ns / 1e6, f"{name} wait": max(pauses_ns) / 1e6}
        return figures
