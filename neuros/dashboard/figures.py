"""From what nodes show of themselves to what the page shows: rates, shares, latencies."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

WINDOW_S = 1.0
"""Rates and shares are those of about the last second."""

_STATES = ("executing", "waiting", "blocked", "idle", "registering", "scheduling", "paused")
_MOST_SENT = 4096
_MOST_TAKEN = 8


class Latency:
    """How long packets of one connection were on their way: from being sent to a hook's start.

    Sender and receiver show themselves at different moments; what belongs together is told by the
    packets' positions. Both count on the monotonic clock of one machine.
    """

    def __init__(self) -> None:
        self._sent_ns: OrderedDict[int, int] = OrderedDict()
        self._taken: deque[tuple[int, int]] = deque(maxlen=_MOST_TAKEN)
        self._last_ms: deque[float] = deque(maxlen=5)

    def sent(self, last: int, times_ns: Sequence[int]) -> None:
        """The last packets sent have been up to position ``last``."""
        for position, time_ns in enumerate(times_ns, last - len(times_ns) + 1):
            self._sent_ns[position] = time_ns
        while len(self._sent_ns) > _MOST_SENT:
            self._sent_ns.popitem(last=False)
        self._match()

    def taken(self, position: int, time_ns: int) -> None:
        """A hook has started on a packet."""
        if not self._taken or self._taken[-1][0] != position:
            self._taken.append((position, time_ns))
            self._match()

    @property
    def ms(self) -> float | None:
        """The mean over the last few, ``None`` before the first."""
        return fmean(self._last_ms) if self._last_ms else None

    def _match(self) -> None:
        for position, time_ns in tuple(self._taken):
            sent_ns = self._sent_ns.get(position)
            if sent_ns is not None:
                self._taken.remove((position, time_ns))
                self._last_ms.append(max(0, time_ns - sent_ns) / 1e6)


class Speed:
    """How fast a growing figure grows, over :data:`WINDOW_S`."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque()

    def note(self, now_s: float, value: float) -> None:
        """It has that value now."""
        self._points.append((now_s, value))
        while len(self._points) > 2 and now_s - self._points[1][0] >= WINDOW_S:
            self._points.popleft()

    @property
    def per_s(self) -> float:
        """0 before there are two values."""
        (first_s, first), (last_s, last) = self._points[0], self._points[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s else 0.0


class Figures:
    """Keeps what is needed of the past, and gives what is to be shown.

    Attributes:
        nodes, connections: by name, ready for JSON.
        sim_time: simulated seconds, ``None`` where no node owns time.
    """

    def __init__(self) -> None:
        self.nodes: dict[str, dict[str, Any]] = {}
        self.connections: dict[str, dict[str, Any]] = {}
        self.sim_time: float | None = None
        self._speeds: dict[tuple[str, str], Speed] = {}
        self._latencies: dict[str, Latency] = {}

    @property
    def real_time_factor(self) -> float | None:
        """Simulated seconds per second now."""
        speed = self._speeds.get(("sim", ""))
        return None if speed is None else speed.per_s

    def take(self, glimpse: Mapping[str, Any]) -> None:
        """A node has shown itself."""
        books = glimpse["books"]
        if books is None:
            self.nodes[glimpse["node"]] = {"state": "loading", "cause": ""}
            return
        now_s = books["now_s"]
        if glimpse["sim_time"] is not None:
            self.sim_time = glimpse["sim_time"]
            self._speed("sim", "", now_s, glimpse["sim_time"])
        self._take_node(glimpse["node"], books, now_s)
        for name, counters in books["outgoing"].items():
            shown = self.connections.setdefault(name, {})
            shown |= {key: counters[key] for key in ("sent", "outstanding", "is_blocked")}
            shown["rate_hz"] = self._speed("sent", name, now_s, counters["sent"])
        for name, counters in books["incoming"].items():
            shown = self.connections.setdefault(name, {})
            shown |= {key: counters[key] for key in ("received", "discarded", "unread")}
            rate_hz = self._speed("received", name, now_s, counters["received"])
            shown.setdefault("rate_hz", rate_hz)
            if "sent" not in shown:  # an external topic, or a sender of another launcher
                shown["rate_hz"] = rate_hz
        self._take_times(books)

    def _take_node(self, name: str, books: Mapping[str, Any], now_s: float) -> None:
        spent = books["accounting"]
        shares = {}
        for state in _STATES:
            value = spent[state]
            seconds = sum(value.values()) if isinstance(value, Mapping) else value
            shares[state] = self._speed(f"share {state}", name, now_s, seconds)
        executing = books["executing"]
        self.nodes[name] = {
            **books["state"],
            "executing": executing["name"] if executing else None,
            "executing_s": executing["for_s"] if executing else 0.0,
            "shares": shares,
            "hooks": {
                hook: {
                    "executions": count,
                    "rate_hz": self._speed(f"hook {hook}", name, now_s, count),
                    "mean_ms": busy_s / count * 1e3 if count else None,
                }
                for hook, (count, busy_s) in books["hooks"].items()
            },
        }

    def _take_times(self, books: Mapping[str, Any]) -> None:
        for name, (last, times_ns) in books["sent_ns"].items():
            self._latency(name).sent(last, times_ns)
        for name, (position, time_ns) in books["taken_ns"].items():
            self._latency(name).taken(position, time_ns)
        for name, latency in self._latencies.items():
            self.connections[name]["latency_ms"] = latency.ms

    def _latency(self, name: str) -> Latency:
        return self._latencies.setdefault(name, Latency())

    def _speed(self, kind: str, name: str, now_s: float, value: float) -> float:
        speed = self._speeds.setdefault((kind, name), Speed())
        speed.note(now_s, value)
        return speed.per_s
