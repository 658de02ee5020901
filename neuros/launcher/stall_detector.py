"""Detects from the reports of nodes that a run stalls, or that a node falls behind.

Reports come once per second, so what is said here is up to a second late.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from typing import Any

from neuros.control import Report
from neuros.launcher.nodes import NodeView
from neuros.ports import RunningNode
from neuros.project.model import Connection
from neuros.stacks import IMPORT, LONG_S, ProcessThreads, Stack

_CLOSE_S = 3.0


class ThreadReader:
    """Reads processes side by side, each in a thread, since that may take seconds.

    Args:
        process_of: the process with a node; ``None`` if it has ended.
    """

    def __init__(self, process_of: Callable[[str], RunningNode | None]) -> None:
        self._process_of = process_of
        self._readings: dict[str, Future[ProcessThreads]] = {}  # by first node
        self._begun: list[threading.Thread] = []

    def begin(self, name: str) -> None:
        """Read the process whose first node this is, unless that has begun."""
        if name not in self._readings:
            reading = self._readings[name] = Future[ProcessThreads]()
            thread = threading.Thread(
                target=_read,
                args=(self._process_of(name), reading),
                name="neuros-stacks",
                daemon=True,
            )
            thread.start()
            self._begun = [*filter(threading.Thread.is_alive, self._begun), thread]

    def forget(self, name: str) -> None:
        """Drop what was read of a process, since it goes on."""
        self._readings.pop(name, None)

    def read(self, name: str) -> ProcessThreads | None:
        """What has been read since; ``None`` if that is not there."""
        reading = self._readings.get(name)
        return reading.result() if reading and reading.done() else None

    def wait(self, limit_s: float) -> None:
        """Until all that has begun is there, or the time is over."""
        wait(self._readings.values(), limit_s)

    def close(self) -> None:
        """Wait, for 3 s at most, until no program reads a process any more."""
        end_s = time.monotonic() + _CLOSE_S
        for thread in self._begun:
            thread.join(max(0.0, end_s - time.monotonic()))


def _read(process: RunningNode | None, reading: Future[ProcessThreads]) -> None:
    try:
        reading.set_result(ProcessThreads() if process is None else process.threads())
    except Exception as error:  # of a back end of somebody else
        reading.set_result(ProcessThreads(problem=repr(error)))


STALL_S = 5.0
"""After this long, the user is told why nothing moves."""

SILENT_S = 2.0
"""A node that has not reported for this long reports no more, or not in time."""

_FIRST_REMARK_S = 5.0
_NEXT_REMARK_S = 10.0
_READ_WITHIN_S = 3.0
BEHIND_S = 5.0
"""A packet that has waited for so long is old."""

_NOT_IN_TIME = ProcessThreads(problem="it could not be read in time")

_Samples = deque[tuple[float, int]]


class StallDetector:
    """Finds standstills, long hooks and silent nodes.

    Args:
        nodes: by name.
        now_s: the time now; all times are seconds on one monotonic clock.
        reader: reads where the threads of processes stand.
    """

    def __init__(self, nodes: Mapping[str, NodeView], now_s: float, reader: ThreadReader) -> None:
        self._nodes = nodes
        self._reader = reader
        self._moved_s = now_s
        self._has_explained = False
        self._named_hooks: set[tuple[str, str, int]] = set()
        self._named_as_mute: set[str] = set()
        self._named_as_held: set[str] = set()
        self._next_remark_s = now_s + _FIRST_REMARK_S
        self._starving: dict[str, tuple[str, float]] = {}  # by node, what it lacks, since when
        self._named_as_starving: set[tuple[str, str]] = set()

    def report(self, report: Report, now_s: float) -> None:
        name = report.node
        node = self._nodes[name]
        before = _movement(node.report)
        node.report, node.heard_s = report, now_s
        self._reader.forget(node.together[0])
        self._named_as_mute.discard(name)
        if name in self._named_as_held:
            self._named_as_held.remove(name)
            if hook := node.executing:
                self._named_hooks.add((name, hook["name"], hook["executions"]))
        if before != _movement(report):
            self._moved_s = now_s
            self._has_explained = False
        lacks = _lacks(report)
        if not lacks:
            self._starving.pop(name, None)
        elif self._starving.get(name, ("",))[0] != lacks:
            self._starving[name] = lacks, now_s

    @property
    def is_complete(self) -> bool:
        return all(node.is_there and node.has_begun for node in self._nodes.values())

    @property
    def is_driven(self) -> bool:
        """Whether some node starts hooks with no packet for them."""
        return any(report.is_driving for _, report in self._reports())

    def begin_anew(self, now_s: float) -> None:
        """Something has kept the nodes still that is no standstill of their own."""
        self._moved_s = now_s
        self._has_explained = False
        self._starving.clear()

    def shift(self, still_s: float) -> None:
        """The launcher stood still for so long: that was no standstill of the nodes."""
        self._moved_s += still_s
        self._next_remark_s += still_s

    def is_held_up(self, name: str, now_s: float) -> bool:
        """Whether a node cannot take in packets, which is said otherwise: a hook executes in its
        process, or it does not report."""
        node = self._nodes[name]
        is_busy = any(self._nodes[each].executing for each in node.together)
        return is_busy or node.silent_s(now_s) >= SILENT_S

    def rested_s(self, now_s: float) -> float:
        """For how long no hook has run and no packet has arrived; 0 while one executes."""
        if any(node.executing for node in self._nodes.values()):
            return 0.0
        return now_s - self._moved_s

    def has_just_stalled(self, now_s: float) -> bool:
        """True once per standstill, when it has lasted :data:`STALL_S`.

        Before all connections are registered nothing can move: that is said as a remark.
        """
        if self._has_explained or now_s - self._moved_s < STALL_S:
            return False
        if not self.is_complete or self._waiting():
            return False
        self._has_explained = True
        return True

    def reasons(self, now_s: float) -> Iterator[tuple[str, str]]:
        """Why nothing moves, by node; of a process that executes a hook, that is the reason."""
        for name, report in self._reports():
            if report.reasons and not self.is_held_up(name, now_s):
                yield "WARN", f"{name} {'; '.join(report.reasons)}"

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """Remarks for the user now, as ``(severity, text)``."""
        if now_s >= self._next_remark_s:
            self._next_remark_s = now_s + _NEXT_REMARK_S
            nodes = sorted(self._nodes.values(), key=lambda node: node.name)
            if silent := [node.name for node in nodes if not node.is_there]:
                yield "INFO", f"still starting: {', '.join(silent)}"
            early = [node for node in nodes if node.report and not node.has_begun]
            if loading := [node.name for node in early if not node.is_loaded]:
                yield "INFO", f"still importing their plugins: {', '.join(loading)}"
            if waiting := self._waiting():
                yield "INFO", f"connections still waiting for their other end: {'; '.join(waiting)}"
            elif not self.is_complete:
                return
            elif initialising := [node.name for node in nodes if not node.is_ready]:
                yield "INFO", f"still initialising: {', '.join(initialising)}"
            elif self.rested_s(now_s) < STALL_S:  # else nodes are asked
                for name, (lacks, since_s) in self._starving.items():
                    if now_s - since_s >= STALL_S and (name, lacks) not in self._named_as_starving:
                        self._named_as_starving.add((name, lacks))
                        yield "INFO", f"{name} still waits for {lacks}, where nothing has ever come"

    def remarks_on_hooks(self) -> Iterator[tuple[str, str]]:
        """Hooks that run for long, each once, with their stacks."""
        for name, report in self._reports():
            hook = self._nodes[name].executing
            if hook and hook["for_s"] >= LONG_S:
                key = (name, hook["name"], hook["executions"])
                if key not in self._named_hooks:
                    self._named_hooks.add(key)
                    text = f"{name} has been executing '{hook['name']}' for {LONG_S:g} s"
                    yield "WARN", with_stack(text, report.stack)

    def remarks_on_silence(self, now_s: float) -> Iterator[tuple[str, str]]:
        """Processes that do not report, each once, and where they stand; not if they were killed.

        One that still imports only informs, and its stack is for the log.

        A process is read beside; the remark comes when that is there.
        """
        for name, node in self._nodes.items():
            silent_s = node.silent_s(now_s)
            if silent_s < LONG_S or name in self._named_as_mute or node.is_killed:
                continue
            names = node.together
            self._reader.begin(names[0])
            read = self._reader.read(names[0])
            if read is None and silent_s < LONG_S + _READ_WITHIN_S:
                continue
            self._named_as_mute.update(names)
            read = read or _NOT_IN_TIME
            if remark := self._remark_on_import(names, read):
                yield "INFO", remark
            elif remark := self._remark_on(names, read):
                yield "WARN", remark

    def _remark_on_import(self, names: Sequence[str], read: ProcessThreads) -> str:
        """A sentence about a process whose main thread, as it imports, lets no other thread run."""
        holder = read.lock_holder
        nodes = [self._nodes[name] for name in names]
        loading = [node.name for node in nodes if not (node.is_loaded or node.has_begun)]
        stacks = filter(None, map(self._read_stack, names))
        if not (holder and holder.is_main and loading) or read.stopped:
            return ""
        if any(stack.hook != IMPORT for stack in stacks):
            return ""
        what = "has been importing its plugin"
        if len(loading) > 1:
            what = "have been importing their plugins"
        return (
            f"{', '.join(loading)} {what} for {LONG_S:g} s, and cannot report: a library that is"
            f" loaded lets no other thread run (where it stands is in launcher.log)\n{holder}"
        )

    def _remark_on(self, names: Sequence[str], read: ProcessThreads) -> str:
        """Why a process with these nodes does not report; empty if its hook was named before."""
        holder = read.lock_holder
        if holder and holder.is_main and not read.stopped:
            for stack in filter(None, map(self._read_stack, names)):
                if self._is_named(stack.node):
                    return ""
                self._named_as_held.add(stack.node)
                does = f"executing '{stack.hook}'"
                said = f"{stack.node} has been {does} for {LONG_S:g} s, and cannot report"
                return with_stack(f"{said}: a library holds Python's global lock", stack)
        have = "has" if len(names) == 1 else "have"
        last_seen = "".join(map(self.last_seen, names))
        silence = f"{', '.join(names)} {have} not reported for {LONG_S:g} s{last_seen}: "
        if read.stopped:
            return f"{silence}{read.stopped}"
        if holder:
            return f"{silence}{holder}"
        if read.threads:
            return f"{silence}the process gets no processor time"
        why_not = f" (where it stands is not known: {read.problem})" if read.problem else ""
        return f"{silence}the process is stopped, or a library holds Python's global lock{why_not}"

    def where(self, names: Sequence[str], now_s: float) -> tuple[dict[str, str], ProcessThreads]:
        """Where nodes of one process stand in their plugins, by name; and what was read of it."""
        read = self._reader.read(names[0]) or _NOT_IN_TIME
        reports = {name: self._nodes[name].report for name in names}
        told = {name: report.stack for name, report in reports.items() if report}
        stacks = {name: self._read_stack(name) or told.get(name) for name in names}
        holder, is_silent = read.lock_holder, self._nodes[names[0]].silent_s(now_s) >= SILENT_S
        if not is_silent:  # what it tells has the source lines
            stacks |= {name: stack for name, stack in told.items() if stack}
        found = {name: stack.text for name, stack in stacks.items() if stack}
        if is_silent and holder and not holder.is_main:
            found = {name: f"{text}\n{holder}" for name, text in found.items()}
        return found, read

    def _read_stack(self, name: str) -> Stack | None:
        """The stack of a node in its plugin that has been read since it reported last.

        Of several nodes with one plugin in one process, it is of the one that was executing.
        """
        node = self._nodes[name]
        read = self._reader.read(node.together[0])
        if read is None or not node.plugin:
            return None
        alike = [n for n in map(self._nodes.__getitem__, node.together) if n.plugin == node.plugin]
        last = next((each for each in alike if each.executing), alike[0])
        return read.hook_stack(name, node.plugin) if node is last else None

    def executing(self, name: str) -> str:
        """The hook that a node executes, as far as is known; empty if there is none."""
        hook = self._nodes[name].executing
        if hook is not None:
            return hook["name"]
        stack = self._read_stack(name)
        return stack.hook if stack and stack.hook != IMPORT else ""

    def last_seen(self, name: str) -> str:
        """The hook of a node at its last report: ``", last seen executing 'step'"``."""
        hook = self.executing(name)
        return f", last seen executing '{hook}'" if hook else ""

    def _reports(self) -> list[tuple[str, Report]]:
        return [(name, node.report) for name, node in sorted(self._nodes.items()) if node.report]

    def _is_named(self, name: str) -> bool:
        """Whether the hook that a node was executing when it reported last has been named."""
        hook = self._nodes[name].executing
        return hook is not None and (name, hook["name"], hook["executions"]) in self._named_hooks

    def _waiting(self) -> list[str]:
        """Connections whose other end has not been found yet; what carries packets has been."""
        reports = [report for _, report in self._reports()]
        waiting = {key for report in reports for key in report.waiting_for}
        for metrics in (report.metrics for report in reports if report.metrics):
            waiting -= {key for key, counts in metrics["incoming"].items() if counts["received"]}
            waiting -= {key for key, sent in metrics["outgoing"].items() if sent["acknowledged"]}
        return sorted(waiting)


def _movement(report: Report | None) -> Any:
    """What changes when a hook has run or a packet has arrived."""
    metrics = report and report.metrics
    return metrics and (
        [hook["executions"] for hook in metrics["hooks"].values()],
        [counts["received"] for counts in metrics["incoming"].values()],
    )


def _lacks(report: Report) -> str:
    """The input that a node waits for and its sources, if no packet has ever come; else empty."""
    metrics = report.metrics
    if metrics is None or metrics["state"]["state"] != "waiting":
        return ""
    port = metrics["state"]["cause"]
    end = f" -> {report.node}.{port}"
    received = {key: c["received"] for key, c in metrics["incoming"].items() if key.endswith(end)}
    if not received or any(received.values()):
        return ""
    ways = [key.removesuffix(end) for key in received]
    sources = [f"topic {way}" if way[0] == "/" else way.partition(".")[0] for way in ways]
    return f"`{port}` from {' or '.join(dict.fromkeys(sources))}"


def with_stack(text: str, stack: Stack | None) -> str:
    """A sentence, and where the plugin stands, below it."""
    return f"{text}:\n{stack.text}" if stack else text


class Backlog:
    """Finds nodes that fall behind: packets wait for long, though nothing else is missing.

    A node that works on old packets looks busy and healthy. It falls behind where a long queue
    feeds a slow hook, or where a callback of its plugin runs for long, so that nothing is taken in
    meanwhile. How long the oldest packet has waited follows from the counters of the reports: it
    arrived before the first report that counts it.

    Args:
        connections: those among the nodes whose reports are taken.
        is_held_up: whether a node cannot take in packets at that time, which is said otherwise.
    """

    def __init__(
        self,
        connections: Sequence[Connection],
        is_held_up: Callable[[str, float], bool] = lambda _, __: False,
    ) -> None:
        self._is_held_up = is_held_up
        self._connections = {str(connection): connection for connection in connections}
        self._received: dict[str, _Samples] = {key: deque() for key in self._connections}
        self._sent: dict[str, _Samples] = {key: deque() for key in self._connections}
        self._counted: dict[str, int] = dict.fromkeys(self._connections, 0)
        self._takers: dict[str, tuple[str, int]] = {}
        self._named: set[str] = set()

    def report(self, report: Report, now_s: float) -> None:
        metrics = report.metrics
        if metrics is None:
            return
        for key, outgoing in metrics["outgoing"].items():
            if key in self._sent and outgoing["is_reliable"]:
                self._sent[key].append((now_s, outgoing["sent"]))
        for key, incoming in metrics["incoming"].items():
            if key not in self._received:
                continue
            self._counted[key] = incoming["received"]
            self._received[key].append((now_s, incoming["received"]))
            _drop(self._received[key], incoming["received"] - incoming["unread"])
            if incoming["taker"] is None:
                self._takers.pop(key, None)
            else:
                self._takers[key] = incoming["taker"], incoming["unread"]

    def begin_anew(self) -> None:
        """Something has kept the nodes still: what waited meanwhile is not behind."""
        for samples in (*self._received.values(), *self._sent.values()):
            samples.clear()

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """Remarks for the user now, as ``(severity, text)``: each connection once."""
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
            elif _age_s(self._sent[key], now_s) >= BEHIND_S and not self._is_held_up(node, now_s):
                self._named.add(key)
                yield (
                    "WARN",
                    f"{node} has fallen behind: it has taken in no packet for over {BEHIND_S:g} s,"
                    f" though packets wait on `{key}`. A callback of its plugin (of a"
                    " subscription, timer or service) takes long, or its process gets no"
                    " processor time",
                )


def _drop(samples: _Samples, settled: int) -> None:
    """Forget the reports that count no packet beyond the first ``settled``."""
    while samples and samples[0][1] <= settled:
        samples.popleft()


def _age_s(samples: _Samples, now_s: float) -> float:
    return now_s - samples[0][0] if samples else 0.0
