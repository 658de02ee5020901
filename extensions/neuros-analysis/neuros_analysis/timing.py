"""Durations of hooks and delays of connections, as measured in a run, and the file of both.

The duration of a hook is the time from its start to its end. The delay of a connection is the time
from the end of the hook that sent a packet to the start of a hook that waited for it, so it
includes serialisation, transport and waking up. Nodes do not list when packets arrive: only packets
that found their receiver free show the delay (see :func:`measure`).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from neuros.api.packets import (
    FOLDER,
    Numbers,
    may_have_lost,
    node_folder,
    read_packets,
)
from neuros.api.run_record import PastRun, open_run, open_whole
from neuros.distribution import __version__
from neuros.engine.schedule import MOST_EXECUTIONS
from neuros.errors import UsageError
from neuros.project.model import Connection
from neuros.project.timing import LEAST_DELAY_NS, MOST_NS, VIRTUAL, Distribution
from neuros.recording.run_file import RUN_FILE
from neuros.registry import ran_in_one_process
from neuros_analysis.options import FITS
from neuros_analysis.review import Trace, answers_ns, open_for_review, read_trace

MOST_SAMPLES = 1000
"""Of one hook or connection in a file; of more values, quantiles at equal steps."""
ENOUGH = 30
"""Where fewer packets show the delay, so many acknowledgements do."""

_NEVER = 2**63 - 1
_MOST_WINDOWS, _OF_A_WINDOW = 16, 20


@dataclass(frozen=True)
class Measured:
    """The values of one hook or connection.

    Attributes:
        values_s: seconds, all above 0, (n,).
        of: what was measured: ``executions``, ``packets`` or ``acknowledgements``.
    """

    values_s: Numbers
    of: str

    def fit(self, kind: str) -> Distribution:
        """The distribution of one of :data:`FITS`.

        ``samples``: the values themselves, or as many quantiles as a file holds; ``lognormal`` and
        ``normal``: the maximum-likelihood fit; ``constant``: the mean.
        """
        values_s = self.values_s
        if kind == "constant":
            found: Any = [values_s.mean()]
        elif kind == "normal":
            found = [values_s.mean(), values_s.std()]
        elif kind == "lognormal":
            found = [np.exp(np.log(values_s).mean()), np.log(values_s).std()]
        elif len(values_s) > MOST_SAMPLES:
            found = np.quantile(values_s, _shares(MOST_SAMPLES), method="inverted_cdf")
        else:
            found = values_s
        return Distribution(kind, tuple(round(float(value), 9) for value in found))


@dataclass(frozen=True)
class Timing:
    """What was measured in a run.

    Attributes:
        hooks: durations by ``node.hook``.
        connections: delays by ``a.out -> b.in``.
        latencies_s: by connection, from the sending of a packet to the start of a hook on it, with
            the time in which the receiver was busy, (starts,).
        missing: by hook, node or connection, why there is no measurement.
        is_virtual: whether the run was in virtual time.
        provenance: where the run comes from, ready for JSON.
    """

    hooks: Mapping[str, Measured]
    connections: Mapping[str, Measured]
    latencies_s: Mapping[str, Numbers]
    missing: Mapping[str, str]
    is_virtual: bool
    provenance: Mapping[str, Any]

    @property
    def all(self) -> dict[str, Measured]:
        """Hooks and connections together."""
        return {**self.hooks, **self.connections}

    def file(self, kind: str = FITS[0]) -> str:
        """The content of a file for ``neuros launch --timing``: JSON, a line per distribution.

        Raises:
            UsageError: if the run was in virtual time.
        """
        if self.is_virtual:
            raise UsageError(
                "the run was in virtual time, so its times were declared and not measured: name a"
                " run in real time"
            )
        counts = {
            name: {"count": len(each.values_s), "of": each.of} for name, each in self.all.items()
        }
        provenance = {
            "as": kind,
            "written": datetime.now(timezone.utc).isoformat("T", "seconds"),
            "neuros": __version__,
            **self.provenance,
            "counts": counts,
            "missing": dict(self.missing),
        }
        parts = [f'"provenance": {json.dumps(provenance, indent=2)}']
        for key, group in (("hooks", self.hooks), ("connections", self.connections)):
            lines = (
                f"{json.dumps(n)}: {json.dumps(each.fit(kind).keys)}" for n, each in group.items()
            )
            parts.append(f'"{key}": {{\n' + ",\n".join(lines) + "\n}")
        return "{\n" + ",\n".join(parts) + "\n}\n"


def measure(folder: Path) -> Timing:
    """Measure a run, or all parts of a run in one folder.

    A packet found its receiver free if no hook ran there between the sending of the packet and the
    start on it, if the hook starts on packets only, and if no later packet, acknowledgement or
    pause can have held up the start. If fewer than :data:`ENOUGH` packets did so, and as many
    acknowledgements found the sender free, these show the delay; without any packet, fewer will do.

    Raises:
        UsageError: if the folder is of no run, or the run has no times of hooks.
        EnvironmentFault: if a file is damaged.
    """
    parts = _parts(folder)
    lists = _Lists(folder, parts)
    if not any(len(trace.starts_ns) for trace in lists.traces.values()):
        if any((part.record.get("options") or {}).get("packet_log") == "0" for part in parts):
            why = "it was made with --packet-log 0: run the project again without this option"
        else:
            why = "no hook has run, or the folder packets of each node is missing"
        raise UsageError(f"{folder} has no times of hooks: {why}")
    hooks = {
        f"{node}.{hook}": Measured(np.clip(durations_ns, 1, MOST_NS) * 1e-9, "executions")
        for node, trace in lists.traces.items()
        for hook, durations_ns in _durations_ns(trace).items()
    }
    missing = {
        node: "the node has listed no executions"
        for node, trace in lists.traces.items()
        if not len(trace.starts_ns)
    }
    connections, latencies_s = {}, {}
    for name, end in lists.ends.items():
        flights_ns = lists.flights_ns[name]
        elsewhere = {end.source_node, end.destination_node} - {*lists.traces}
        if elsewhere:
            missing[name] = (
                f"{' and '.join(elsewhere)} ran in another part: name a folder that holds the run"
                " folders of all parts"
            )
            continue
        if flights_ns is None:
            missing[name] = lists.why_unknown(end)
            continue
        latencies_s[name] = np.diff(flights_ns).ravel() * 1e-9
        if end.source_node == end.destination_node:
            continue  # its packets are not sent, so they have no delay
        delays_ns, of = np.diff(flights_ns[lists.found_free(end)]).ravel(), "packets"
        if len(delays_ns) < ENOUGH:
            answers_ns = lists.answers_ns(end)
            if len(answers_ns) >= (ENOUGH if len(delays_ns) else 1):
                delays_ns, of = answers_ns, "acknowledgements"
        if len(delays_ns):
            connections[name] = Measured(np.clip(delays_ns, LEAST_DELAY_NS, MOST_NS) * 1e-9, of)
        else:
            free = f"no packet found '{end.destination_node}' free"
            missing[name] = (
                f"{free}, or its hooks do not wait for packets"
                if len(flights_ns)
                else "no hook has started on a packet"
            )
    missing |= {str(file): "the rest is left out: the file is damaged" for file in lists.damaged}
    provenance = {"runs": [_provenance(part) for part in parts], "clocks": lists.clocks.described}
    is_virtual = any(map(_is_virtual, parts))
    return Timing(hooks, connections, latencies_s, missing, is_virtual, provenance)


def _parts(folder: Path) -> list[PastRun]:
    """The run in a folder, or its parts, which several launchers have made."""
    files = sorted(folder.glob(f"*/{RUN_FILE}"))
    if (folder / RUN_FILE).exists() or not files:
        return [open_for_review(folder)]
    parts = [open_run(file.parent) for file in files]
    nodes = Counter(name for part in parts for name in part.nodes)
    twice = [name for name, count in nodes.items() if count > 1]
    if twice:
        found = ", ".join(part.folder.name for part in parts if twice[0] in part.nodes)
        raise UsageError(
            f"{folder} holds several runs, and not the parts of one: node '{twice[0]}' ran in"
            f" {found}: name one of them"
        )
    return parts


def _is_virtual(part: PastRun) -> bool:
    """Whether a run was in virtual time, where nodes of one process do not share their time."""
    return (part.record.get("expanded_project") or {}).get("time") == VIRTUAL


def _durations_ns(trace: Trace) -> dict[str, Numbers]:
    """By hook, without initialise hooks, and without packets from the thread of a simulator."""
    found: dict[str, Numbers] = {}
    for place, (name, kind) in enumerate(trace.hooks):
        chosen = trace.which == place
        if kind != "initialise" and name.isidentifier() and chosen.any():
            before = found.get(name, np.empty(0, np.int64))
            found[name] = np.concatenate([before, (trace.ends_ns - trace.starts_ns)[chosen]])
    return found


def _provenance(part: PastRun) -> dict[str, Any]:
    record = part.record
    machine, git = record.get("machine") or {}, record.get("git") or {}
    load = (record.get("system_load") or {}).get("machine") or {}
    started = record.get("started")
    when = (
        datetime.fromtimestamp(started, timezone.utc).isoformat("T", "seconds") if started else None
    )
    return {
        "run_id": record.get("run_id"),
        "project": record.get("project"),
        "file": record.get("file"),
        "started": when,
        "host": machine.get("name"),
        "processor": machine.get("processor"),
        "cores": machine.get("cores"),
        "system": machine.get("system"),
        "neuros": (record.get("versions") or {}).get("neuros"),
        "commit": git.get("commit"),
        "is_changed": git.get("is_dirty"),
        "back_end": record.get("backend"),
        "machines": {
            name: machine.get("nodes") for name, machine in (record.get("machines") or {}).items()
        },
        "load": load or None,
    }


def distance(one: Numbers, other: Numbers) -> float:
    """The Kolmogorov-Smirnov distance: the largest gap of the cumulative shares of two samples."""
    one, other = np.sort(one), np.sort(other)
    values = np.concatenate([one, other])
    shares = (np.searchsorted(each, values, "right") / len(each) for each in (one, other))
    return float(np.abs(np.subtract(*shares)).max())


def by_chance(count: int, other: int) -> float:
    """The distance that two samples of one distribution exceed once in 20 times.

    Smirnov 1948, doi:10.1214/aoms/1177730256: the limit for large samples.
    """
    return min(1.0, 1.358 * float(np.sqrt((count + other) / (count * other))))


def _shares(count: int) -> Numbers:
    """The middle of each of ``count`` equal steps from 0 to 1."""
    found: Numbers = (np.arange(count) + 0.5) / count
    return found


def drawn_s(distribution: Distribution) -> Numbers:
    """Quantiles at equal steps of what is drawn from a distribution, (samples,)."""
    return np.array([distribution.at_ns(share) for share in _shares(MOST_SAMPLES)]) * 1e-9


# ---------------------------------------------------------------------- lists


class _Lists:
    """The lists of all nodes of a run, on one clock.

    Attributes:
        ends: the connections by name.
        traces: the executions of each node.
        flights_ns: by connection, sending of a packet and start of a hook on it, for each start,
            (starts, 2); ``None`` if unknown.
        clocks: of the machines.
        damaged: files that are read only up to an entry that no node writes.
    """

    def __init__(self, folder: Path, parts: Sequence[PastRun]) -> None:
        whole = parts[0] if len(parts) == 1 else open_whole(folder)
        self.ends = whole.ends
        self.traces = {name: read_trace(node_folder(folder, name) / FOLDER) for name in whole.nodes}
        self._packets = {name: read_packets(folder, end) for name, end in whole.ends.items()}
        self._may_lose = {name: may_have_lost(each) for name, each in whole.connections.items()}
        self._process_of = {
            name: str(part.folder)
            if ran_in_one_process(part.record) and not _is_virtual(part)
            else name
            for part in parts
            for name in part.nodes
        }
        self.flights_ns = {name: self._flights_ns(name) for name in self.ends}
        self.damaged = [file for each in self.traces.values() for file in each.damaged]
        self.damaged += [file for each in self._packets.values() for file in each.damaged]
        self.clocks = _Clocks(parts, self)
        self._shift()
        self._processes: dict[str, tuple[Numbers, Numbers]] = {}
        self._free: dict[str, tuple[Numbers, Numbers]] = {}

    def why_unknown(self, end: Connection) -> str:
        """Why the flights of a connection are unknown."""
        if not self.clocks.is_common(end.source_node, end.destination_node):
            return (
                "its nodes ran on machines whose clocks are not known to each other: give a"
                " connection between the two machines a discard limit"
            )
        return "packets were lost, and those that arrived cannot be told apart"

    def answers(self, end: Connection) -> Numbers:
        """Start on a packet and arrival of its acknowledgement, by their own clocks, (n, 2)."""
        return answers_ns(self.traces.get(end.source_node), self._packets[str(end)], end.index)

    def answers_ns(self, end: Connection) -> Numbers:
        """Nanoseconds of the acknowledgements that found the sender free, (n,)."""
        answers = self.answers(end)
        if not len(answers) or not self.clocks.is_common(end.source_node, end.destination_node):
            return np.empty(0, np.int64)
        is_free = self._busy_until(end.source_node, answers[:, 1]) <= answers[:, 0]
        found: Numbers = np.diff(answers[is_free]).ravel()
        return found

    def found_free(self, end: Connection) -> Numbers:
        """Whether each packet of the flights found its receiver free, (starts,)."""
        node, flights_ns = end.destination_node, self.flights_ns[str(end)]
        assert flights_ns is not None
        sent_ns, taken_ns = flights_ns.T
        credits_ns = np.sort(self.traces[node].credits[:, 2])
        pauses_ns = self._packets[str(end)].pauses_ns
        is_held_up = np.searchsorted(credits_ns, taken_ns, "right") > np.searchsorted(
            credits_ns, sent_ns
        )
        is_held_up |= np.searchsorted(pauses_ns[:, 0], taken_ns) > np.searchsorted(
            pauses_ns[:, 1], sent_ns, "right"
        )
        starts_ns, last_sent_ns = self._starts_on_packets(node)
        if not len(starts_ns):
            return np.zeros(len(flights_ns), bool)
        at = np.minimum(np.searchsorted(starts_ns, taken_ns), len(starts_ns) - 1)
        is_awaited = (starts_ns[at] == taken_ns) & (last_sent_ns[at] == sent_ns)
        found: Numbers = is_awaited & ~is_held_up & (self._busy_until(node, taken_ns) <= sent_ns)
        return found

    def _flights_ns(self, name: str) -> Numbers | None:
        return self._packets[name].flights_ns(may_lose=self._may_lose[name])

    def _shift(self) -> None:
        """Move all times to the clock of the first machine."""
        for node, move in self.clocks.moves.items():
            trace = self.traces[node]
            credits = trace.credits.copy()
            credits[:, 2] = move(credits[:, 2])
            self.traces[node] = replace(
                trace, starts_ns=move(trace.starts_ns), ends_ns=move(trace.ends_ns), credits=credits
            )
        for name, end in self.ends.items():
            packets = self._packets[name]
            sender, receiver = (
                self.clocks.moves.get(node, _stay)
                for node in (end.source_node, end.destination_node)
            )
            self._packets[name] = replace(
                packets,
                sent_ns=sender(packets.sent_ns),
                taken_ns=receiver(packets.taken_ns),
                pauses_ns=receiver(packets.pauses_ns),
            )
            is_common = self.clocks.is_common(end.source_node, end.destination_node)
            self.flights_ns[name] = self._flights_ns(name) if is_common else None

    def _busy_until(self, node: str, at_ns: Numbers) -> Numbers:
        """The latest end of the hooks that had started in the thread of a node before each time.

        Without end (``_NEVER``) once one of the nodes that share the thread lists no more hooks.
        """
        process = self._process_of[node]
        if process not in self._processes:
            traces = [t for n, t in self.traces.items() if self._process_of[n] == process]
            full = (t.ends_ns for t in traces if len(t.ends_ns) >= MOST_EXECUTIONS)
            until_ns = min((ends_ns[-1] for ends_ns in full), default=_NEVER)
            starts_ns = np.concatenate([[0], *(trace.starts_ns for trace in traces), [until_ns]])
            ends_ns = np.concatenate([[0], *(trace.ends_ns for trace in traces), [_NEVER]])
            order = np.argsort(starts_ns, kind="stable")
            self._processes[process] = starts_ns[order], np.maximum.accumulate(ends_ns[order])
        starts_ns, ends_ns = self._processes[process]
        found: Numbers = ends_ns[np.maximum(np.searchsorted(starts_ns, at_ns), 1) - 1]
        return found

    def _starts_on_packets(self, node: str) -> tuple[Numbers, Numbers]:
        """The starts of a node's hooks that packets caused, and when the last of these was sent.

        Without the hooks that also start without a packet, and without the starts on a packet of
        which the sending is unknown.
        """
        if node in self._free:
            return self._free[node]
        trace = self.traces[node]
        incoming = [name for name, end in self.ends.items() if end.destination_node == node]
        flights = [f for name in incoming if (f := self.flights_ns[name]) is not None]
        packets = [self._packets[name] for name in incoming]
        taken_ns = np.concatenate([np.empty(0, np.int64), *(each.taken_ns for each in packets)])
        has_packet = np.isin(trace.starts_ns, taken_ns)
        # Lists that have lost their beginning, or the last second of a killed node, say nothing.
        begins = [each.taken_ns[0] for each in packets if each.taken_before and len(each.taken_ns)]
        is_listed = trace.starts_ns >= max(begins, default=0)
        is_listed &= trace.starts_ns <= max(taken_ns, default=0)
        unasked = np.unique(trace.which[is_listed & ~has_packet])
        ticks = [place for place, (_, kind) in enumerate(trace.hooks) if kind != "function"]
        is_usable = has_packet & ~np.isin(trace.which, [*unasked, *ticks])
        known = np.concatenate([np.empty((0, 2), np.int64), *flights])
        unknown_ns = [
            each.taken_ns[~np.isin(each.taken_ns, flights_ns[:, 1])]
            if (flights_ns := self.flights_ns[name]) is not None
            else each.taken_ns
            for name, each in zip(incoming, packets, strict=True)
        ]
        is_usable &= ~np.isin(trace.starts_ns, np.concatenate([np.empty(0, np.int64), *unknown_ns]))
        known = known[np.isin(known[:, 1], trace.starts_ns[is_usable])]
        known = known[np.lexsort((known[:, 0], known[:, 1]))]
        is_last = np.append(np.diff(known[:, 1]) > 0, True)[: len(known)]
        self._free[node] = known[is_last, 1], known[is_last, 0]
        return self._free[node]


_Move = Callable[[Numbers], Numbers]


class _Clocks:
    """The clocks of the machines of a run, and how they differ.

    A launcher with a deployment has moved the times of its machines to its own clock. Packets and
    their acknowledgements show the rest, and all of it for the parts of a run, as in NTP (RFC
    5905): within a window of time, the fastest packets of both ways take equally long. A straight
    line through the windows follows the drift.

    Attributes:
        moves: by node, what moves its times to the clock of its group of machines.
        described: by machine, ready for JSON: how far its clock was ahead, and the error.
    """

    def __init__(self, parts: Sequence[PastRun], lists: _Lists) -> None:
        self._machine_of: dict[str, str] = {}
        known = {""}
        for part in parts:
            own = part.folder.name if len(parts) > 1 else ""
            self._machine_of |= dict.fromkeys(part.nodes, own)
            for name, machine in (part.record.get("machines") or {}).items():
                self._machine_of |= dict.fromkeys(machine.get("nodes") or (), name)
                if machine.get("clock_ahead_s") is not None:
                    known.add(name)
        self.described: dict[str, dict[str, float]] = {}
        self._group_of: dict[str, str] = {}
        moves: dict[str, _Move] = {}
        left = [*dict.fromkeys(self._machine_of.values())]
        while left:
            root = left.pop(0)
            self._group_of[root], moves[root] = root, _stay
            reached = [root]
            for near in reached:
                for far in tuple(left):
                    offset = self._offset(near, far, lists)
                    if offset is None and not {near, far} <= known:
                        continue
                    left.remove(far)
                    reached.append(far)
                    self._group_of[far], moves[far] = root, moves[near]
                    if offset is not None:
                        moves[far] = _in_turn(offset.move, moves[near])
                        self.described[far] = {"ahead_s": offset.ahead_s, "error_s": offset.error_s}
        self.moves = {
            node: moves[name] for node, name in self._machine_of.items() if moves[name] is not _stay
        }

    def is_common(self, one: str, other: str) -> bool:
        """Whether the times of two nodes can be compared."""
        one, other = self._machine_of.get(one, ""), self._machine_of.get(other, "")
        return self._group_of.get(one) == self._group_of.get(other)

    def _offset(self, near: str, far: str, lists: _Lists) -> _Offset | None:
        """How far the clock of one machine is ahead of another one's; ``None`` if unknown."""
        over, under = [np.empty((0, 2), np.int64)], [np.empty((0, 2), np.int64)]
        for name, end in lists.ends.items():
            flights_ns, answers = lists.flights_ns[name], lists.answers(end)
            machines = (
                self._machine_of.get(end.source_node),
                self._machine_of.get(end.destination_node),
            )
            if flights_ns is None:
                continue
            if machines == (near, far):
                over.append(flights_ns)
                under.append(answers[:, ::-1])
            elif machines == (far, near):
                under.append(flights_ns[:, ::-1])
                over.append(answers)
        return _offset_between(np.concatenate(over), np.concatenate(under))


def _stay(times_ns: Numbers) -> Numbers:
    return times_ns


def _in_turn(first: _Move, second: _Move) -> _Move:
    return lambda times_ns: second(first(times_ns))


@dataclass(frozen=True)
class _Offset:
    """How far a clock is ahead: a constant, and a line over the other clock's time."""

    base_ns: int
    since_ns: int
    line: Numbers
    error_s: float

    @property
    def ahead_s(self) -> float:
        """At the first packet."""
        return float(self.base_ns + np.polyval(self.line, 0.0)) * 1e-9

    def move(self, times_ns: Numbers) -> Numbers:
        """Times of the clock that is ahead as times of the other one."""
        times_ns = times_ns - self.base_ns
        moved: Numbers = times_ns - np.polyval(self.line, times_ns - self.since_ns).astype(np.int64)
        return moved


def _offset_between(over: Numbers, under: Numbers) -> _Offset | None:
    """How far a clock is ahead, from times on both clocks; ``None`` if a way has no packets.

    Args:
        over: near and far time of what went there, (n, 2): the difference is too large.
        under: the same of what came back: the difference is too small.
    """
    if not len(over) or not len(under):
        return None
    base_ns = int(over[0, 1] - over[0, 0])
    since_ns = int(min(over[:, 0].min(), under[:, 0].min()))
    until_ns = int(max(over[:, 0].max(), under[:, 0].max()))
    count = int(np.clip(min(len(over), len(under)) // _OF_A_WINDOW, 1, _MOST_WINDOWS))
    edges = np.linspace(since_ns, until_ns, count + 1)[1:-1]
    rows = []
    for window in range(count):
        there, back = (part[np.searchsorted(edges, part[:, 0]) == window] for part in (over, under))
        if len(there) and len(back):
            high = int(np.diff(there).min()) - base_ns
            low = int(np.diff(back).max()) - base_ns
            middle = float(np.concatenate([there, back])[:, 0].mean()) - since_ns
            rows.append((middle, (high + low) / 2, abs(high - low) / 2))
    if not rows:
        return None
    times, aheads, errors = np.array(rows).T
    line = np.polyfit(times, aheads, 1) if len(rows) > 2 else np.array([0.0, aheads.mean()])
    return _Offset(base_ns, since_ns, line, float(np.median(errors)) * 1e-9)
