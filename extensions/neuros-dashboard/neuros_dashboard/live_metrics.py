"""A run for the pages of the dashboard: live metrics from counters of its nodes.

The supervisor is asked over the control channel, and only while a page is open.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections import OrderedDict, defaultdict, deque
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, TypeAlias

import neuros.control as control
from neuros.control.link import ControlLink
from neuros.engine.metrics import in_flight_and_lost, time_budget_of
from neuros.errors import ControlError
from neuros.recording.system_load import LAUNCHER, LoadMeter
from neuros_dashboard.pages import Pages, data_url

WINDOW_S = 1.0
"""Rates and shares are averages over about this time."""

_STATES = ("executing", "waiting", "blocked", "idle", "registering", "scheduling", "paused")
_COUNTS = ("sent", "outstanding", "received", "discarded", "unread")
_MOST_SENT = 4096
_MOST_TAKEN = 8
_MOST_SHOWN = 256
_UNDER_WAY_S = 0.02
_LATE_S = 2.0
_PERIOD_S = 0.2
_PER_NODE_S = 0.0125
_PATIENCE_S = 1.0
_GEOMETRY_S = 20.0


Pauses: TypeAlias = Sequence[tuple[int, int]]
"""Start and end of each pause of a node, in nanoseconds."""


class Latency:
    """Latency of one connection: from the sending of a packet to the start of a hook on it.

    Sender and receiver report at different moments; positions of packets match the two ends. Both
    use the monotonic clock of one machine.
    """

    def __init__(self) -> None:
        self._sent_ns: OrderedDict[int, int] = OrderedDict()
        self._taken: deque[tuple[int, int, Pauses]] = deque(maxlen=_MOST_TAKEN)
        self._last_ms: deque[float] = deque(maxlen=5)

    def add_sent(self, last: int, times_ns: Sequence[int]) -> None:
        """Add times of the last packets sent, the last one at position ``last``."""
        for position, time_ns in enumerate(times_ns, last - len(times_ns) + 1):
            self._sent_ns[position] = time_ns
        while len(self._sent_ns) > _MOST_SENT:
            self._sent_ns.popitem(last=False)
        self._match()

    def add_start(self, position: int, time_ns: int, paused_ns: Pauses = ()) -> None:
        """Add the start of a hook on a packet; pauses of its node do not count as latency."""
        if not self._taken or self._taken[-1][0] != position:
            self._taken.append((position, time_ns, paused_ns))
            self._match()

    @property
    def ms(self) -> float | None:
        """The mean of the last few, ``None`` before the first."""
        return fmean(self._last_ms) if self._last_ms else None

    def _match(self) -> None:
        for taken in tuple(self._taken):
            position, time_ns, paused_ns = taken
            sent_ns = self._sent_ns.get(position)
            if sent_ns is not None:
                self._taken.remove(taken)
                still_ns = sum(
                    max(0, min(end_ns, time_ns) - max(start_ns, sent_ns))
                    for start_ns, end_ns in paused_ns
                )
                self._last_ms.append(max(0, time_ns - sent_ns - still_ns) / 1e6)


class Speed:
    """Growth per second of a value over :data:`WINDOW_S`; it begins anew where the value falls."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, value: float) -> None:
        if self._points and value < self._points[-1][1]:
            self._points.clear()
        self._points.append((now_s, value))
        while len(self._points) > 2 and now_s - self._points[1][0] >= WINDOW_S:
            self._points.popleft()

    @property
    def per_s(self) -> float:
        """0 before the second value."""
        (first_s, first), (last_s, last) = self._points[0], self._points[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s else 0.0


class Load:
    """Load of the machine and of each node, ready for JSON; its meter is that of the run."""

    def __init__(self, meter: LoadMeter) -> None:
        self._meter = meter
        self._speeds: defaultdict[str, Speed] = defaultdict(Speed)

    def __call__(self) -> dict[str, Any]:
        """Percent of a core, bytes and threads; the rest of the run's processes is this one."""
        machine, groups, now_s = self._meter.machine(), self._meter.groups(), time.monotonic()
        for name, load in groups.items():
            self._speeds[name].add(now_s, load.cpu_s)
        shown = {
            "dashboard" if name == LAUNCHER else name: {
                "cpu_percent": 100.0 * self._speeds[name].per_s,
                "memory_bytes": load.memory_bytes,
                "threads": load.threads,
            }
            for name, load in groups.items()
        }
        return {
            "cores": list(machine.core_percent),
            "memory_percent": machine.memory_percent,
            "memory_used_bytes": machine.memory_used_bytes,
            "groups": shown,
        }


class Loss:
    """Packets of a best-effort connection that were lost on their way, so far.

    Both ends report at different moments, and packets that arrive while a hook executes are counted
    after it. So the receiver's count is compared with the number sent shortly before it last
    received, and the least difference of a while counts, since late packets are not lost.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[float, int]] = deque(maxlen=_MOST_SHOWN)
        self._missing: deque[tuple[float, float]] = deque()
        self.count = 0

    def add_sent(self, now_s: float, count: int) -> None:
        self._sent.append((now_s, count))

    def add_received(self, now_s: float, received_s: float, count: int) -> None:
        """Add the count of a receiver that last received at ``received_s``."""
        sent = self._sent_by(received_s - _UNDER_WAY_S)
        if sent is None:
            return
        self._missing.append((now_s, sent - count))
        if now_s - self._missing[0][0] >= _LATE_S:
            self.count = max(self.count, int(min(missing for _, missing in self._missing)))
            self._missing.popleft()

    def _sent_by(self, then_s: float) -> float | None:
        """The number of packets sent by then, interpolated, if known."""
        for (a_s, a), (b_s, b) in itertools.pairwise(self._sent):
            if a_s <= then_s <= b_s:
                return a + (b - a) * (then_s - a_s) / max(b_s - a_s, 1e-9)
        is_since = self._sent and self._sent[-1][0] <= then_s
        return self._sent[-1][1] if is_since else None


class LiveMetrics:
    """Live metrics of all nodes and connections.

    Attributes:
        nodes, connections: by name, ready for JSON.
        sim_time: simulated seconds, ``None`` without a node that owns time.
        virtual_s: of a run in virtual time, the latest time of a node.
    """

    def __init__(self) -> None:
        self.nodes: dict[str, dict[str, Any]] = {}
        self.connections: dict[str, dict[str, Any]] = {}
        self.sim_time: float | None = None
        self.virtual_s = 0.0
        self._speeds: dict[tuple[str, str], Speed] = {}
        self._latencies: dict[str, Latency] = {}
        self._losses: dict[str, Loss] = {}
        self._ended_factor: float | None = None

    @property
    def real_time_factor(self) -> float | None:
        """Simulated seconds per second: at present, or of the whole run once it is over."""
        if self._ended_factor is not None:
            return self._ended_factor
        speed = self._speeds.get(("sim", ""))
        return None if speed is None else speed.per_s

    def update(self, status: control.NodeStatus) -> None:
        counters = status.counters
        if counters is None:
            self.nodes[status.node] = {"state": "loading", "cause": ""}
            return
        now_s, metrics = counters.now_s, counters.metrics
        self.virtual_s = max(self.virtual_s, now_s)
        if status.sim_time is not None:
            self.sim_time = status.sim_time
            self._speed("sim", "", now_s, status.sim_time)
        executing = metrics["executing"]
        shares = {}
        for state in _STATES:
            spent = metrics["accounting"][state]
            total_s = sum(spent.values()) if isinstance(spent, Mapping) else float(spent)
            shares[state] = self._speed(f"share {state}", status.node, now_s, total_s)
        self.nodes[status.node] = {
            **metrics["state"],
            "executing": executing["name"] if executing else None,
            "shares": shares,
            "hooks": {
                hook: _hook(
                    each, self._speed(f"hook {hook}", status.node, now_s, each["executions"])
                )
                for hook, each in metrics["hooks"].items()
            },
        }
        for name, outgoing in metrics["outgoing"].items():
            shown = self.connections.setdefault(name, {})
            shown |= {key: outgoing[key] for key in ("sent", "outstanding", "is_blocked")}
            shown["rate_hz"] = self._speed("sent", name, now_s, outgoing["sent"])
            if outgoing["is_reliable"]:
                shown["lost"] = 0
            else:
                self._losses.setdefault(name, Loss()).add_sent(now_s, outgoing["sent"])
        for name, incoming in metrics["incoming"].items():
            shown = self.connections.setdefault(name, {})
            shown |= {key: incoming[key] for key in ("received", "discarded", "unread")}
            rate_hz = self._speed("received", name, now_s, incoming["received"])
            shown.setdefault("rate_hz", rate_hz)
            if "sent" not in shown:  # an external topic, or a sender of another launcher
                shown["rate_hz"] = rate_hz
            if name in self._losses:
                received_s = now_s - (executing["for_s"] if executing else 0.0)
                self._losses[name].add_received(now_s, received_s, incoming["received"])
                shown["lost"] = self._losses[name].count
        for name, (last, times_ns) in counters.sent_ns.items():
            self._latencies.setdefault(name, Latency()).add_sent(last, times_ns)
        for name, (position, time_ns) in counters.taken_ns.items():
            latency = self._latencies.setdefault(name, Latency())
            latency.add_start(position, time_ns, counters.paused_ns)
        for name, latency in self._latencies.items():
            self.connections[name]["latency_ms"] = latency.ms

    def end(
        self,
        reports: Mapping[str, control.Report],
        running_s: float | None,
        real_time_factor: float | None,
        has_drained: bool,
    ) -> None:
        """Set the final counts, and rates and shares of the whole run.

        Args:
            reports: the last report of each node.
            running_s: time in which all nodes ran.
            real_time_factor: of that time.
            has_drained: whether the run waited for packets in flight.
        """
        self.nodes = {name: {"state": "ended", "cause": ""} for name in self.nodes}
        ends: dict[str, dict[str, int]] = {}
        for name, report in reports.items():
            if report.metrics is None:
                continue
            spent = time_budget_of(report.metrics, running_s)
            self.nodes[name] = {
                "state": "ended",
                "cause": "",
                "shares": {} if spent is None else spent.shares,
                "hooks": {
                    hook: _hook(each, None) for hook, each in report.metrics["hooks"].items()
                },
            }
            counted: list[tuple[str, dict[str, Any]]] = [
                *((name, {**counts}) for name, counts in report.metrics["outgoing"].items()),
                *((name, {**counts}) for name, counts in report.metrics["incoming"].items()),
            ]
            for connection, counters in counted:
                shown = self.connections.setdefault(connection, {})
                shown |= {key: counters[key] for key in _COUNTS if key in counters}
                if report.is_final:
                    ends.setdefault(connection, {}).update(counters)
        for connection, shown in self.connections.items():
            count, final = shown.get("sent", shown.get("received")), ends.get(connection, {})
            lost = None
            if {"sent", "received"} <= {*final}:
                _, lost = in_flight_and_lost(
                    final["sent"], final["received"], final["outstanding"], has_drained
                )
            shown |= {
                "is_blocked": False,
                "latency_ms": None,
                "rate_hz": count / running_s if count is not None and running_s else None,
                "lost": lost,
            }
        self._ended_factor = real_time_factor

    def _speed(self, kind: str, name: str, now_s: float, value: float) -> float:
        speed = self._speeds.setdefault((kind, name), Speed())
        speed.add(now_s, value)
        return speed.per_s


def _hook(figures: Mapping[str, Any], rate_hz: float | None) -> dict[str, Any]:
    executions, busy_s = figures["executions"], figures["busy_s"]
    return {
        "executions": executions,
        "rate_hz": rate_hz,
        "mean_ms": busy_s / executions * 1e3 if executions else None,
    }


class ObservedRun:
    """A run for its pages: asks the supervisor while a page is open, and publishes the answers.

    Args:
        link: the link to the supervisor.
        names: the nodes of the run.
        start_s: monotonic time at which the time axis of the pages begins.

    Attributes:
        phase: the latest state of the run, for the pages.
    """

    def __init__(
        self, pages: Pages, link: ControlLink, names: tuple[str, ...], start_s: float
    ) -> None:
        self._pages = pages
        self._link = link
        self._names = set(names)
        self._metrics = LiveMetrics()
        self._geometries: dict[str, asyncio.Future[str]] = {}
        self._answered: set[str] = set()
        self._has_answered = asyncio.Event()
        self._is_over = asyncio.Event()
        self._start_s = start_s
        self.phase: dict[str, Any] = {"phase": "running", "is_paused": False}

    async def run(self) -> None:
        """Serve the pages until the run is over."""
        loop = asyncio.get_running_loop()
        self.send(control.Watch())
        loop.add_reader(self._link.fileno(), self._receive)
        asking = asyncio.create_task(self._ask())
        try:
            await self._is_over.wait()
        finally:
            asking.cancel()
            loop.remove_reader(self._link.fileno())
            self._link.close()

    def send(self, message: control.Message) -> None:
        """Send to the supervisor, unless the run is over."""
        if not self._is_over.is_set():
            self._link.send(message)

    async def geometry(self, node: str) -> str | None:
        """The geometry of a node's simulated world, as JSON; ``None`` without a world."""
        if node not in self._names:
            return None
        loop = asyncio.get_running_loop()
        asked = self._geometries.setdefault(node, loop.create_future())
        try:
            return await asyncio.wait_for(asyncio.shield(asked), _GEOMETRY_S)
        except asyncio.TimeoutError:
            return None

    async def _ask(self) -> None:
        period_s = max(_PERIOD_S, _PER_NODE_S * len(self._names))
        while True:
            await self._pages.are_watched.wait()
            self._answered.clear()
            self._has_answered.clear()
            asked_s = time.monotonic()
            wanted = self._pages.wanted()
            for node in self._geometries:
                wanted.setdefault(node, {}).setdefault(control.WORLD, {})["geometry"] = True
            self.send(control.GetStatus(wanted))
            # A node whose hook holds Python's global lock answers late: do not wait for it.
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._has_answered.wait(), _PATIENCE_S)
            self._show()
            await asyncio.sleep(max(0.0, asked_s + period_s - time.monotonic()))

    def _receive(self) -> None:
        try:
            messages = self._link.receive()
        except ControlError as error:
            self._pages.send("log", [f"[ERROR] [dashboard] {error}"])
            return
        if messages is None:
            self._is_over.set()
        for message in messages or ():
            self._handle(message)

    def _handle(self, message: control.Message) -> None:
        match message:
            case control.NodeStatus(node):
                self._metrics.update(message)
                self._show_samples(node, message.samples)
                self._answered.add(node)
                if self._answered >= self._names:
                    self._has_answered.set()
            case control.PhaseChanged():
                self.phase = {"phase": message.phase, "is_paused": message.is_paused}
                self._pages.send("phase", self.phase)
            case control.Ended(
                exit_code, reason, reports, running_s, real_time_factor, has_drained
            ):
                self._metrics.end(reports, running_s, real_time_factor, has_drained)
                self._show()
                self.phase = {"phase": "ended", "is_paused": False}
                self.phase |= {"exit_code": exit_code, "reason": reason}
                self._pages.send("phase", self.phase)

    def _show(self) -> None:
        metrics = self._metrics
        self._pages.send(
            "figures",
            {
                "t": time.monotonic() - self._start_s,
                "nodes": metrics.nodes,
                "connections": metrics.connections,
                "sim_time": metrics.sim_time,
                "virtual_s": metrics.virtual_s,
                "real_time_factor": metrics.real_time_factor,
            },
        )

    def _show_samples(self, node: str, samples: Mapping[str, dict[str, Any]]) -> None:
        shown = {}
        for port, sample in samples.items():
            geometry = sample.pop("geometry", None)
            if geometry is not None and (asked := self._geometries.pop(node, None)):
                asked.set_result(geometry)
            rows = [sample.get("values", ()), *sample.get("arrays", {}).values()]
            for row in itertools.chain(*rows):
                row[0] -= self._start_s
            if "image" in sample:
                sample["image"] = {
                    "url": data_url(sample["image"]),
                    "of": sample["image"]["of"],
                    "encoding": sample["image"]["encoding"],
                }
            shown[f"{node}.{port}"] = sample
        if shown:
            self._pages.send("samples", shown)
