"""Judges what was observed of a run by the rules of the specification, and by nothing else.

It knows the description of the project and the log of each node; what the engine keeps of itself
it only compares with that. Times of different nodes are compared with a tolerance for what a
packet and an acknowledgement take on their way, which grows with how late this machine wakes up;
order, numbers and counts are exact. Where a rule speaks of what had arrived, a packet counts that
was sent a tolerance before.

The rules by name, as :class:`Violation` has them:

=================  ============================================================================
``single thread``  hooks of a node never overlap, nor any two hooks in process
``initialise``     each initialise hook once, before all others
``start``          no hook before every plugin is loaded; no tick or function hook of any node
                   before every initialise hook of nodes that need no packets for it has ended
``finalise``       each finalise hook once, after all others
``input``          a required input has a packet; the packets of an ``All`` input are in order
``content``        a packet arrives as it was sent, from a source of that input, after it was sent
``order``          numbers of a connection grow
``gap``            none with limit 0, at most N in a row with limit N
``window``         nothing is sent while K + N packets are outstanding
``oldest first``   a plain input takes the packet that has waited longest
``optional``       an ``Optional`` input takes what has arrived
``fresh``          a hook starts on one of the newest K packets that have arrived
``fair``           a ready hook starts after at most one execution of each other hook of its node
``awake``          a node does not rest while one of its hooks is ready
``age``            the age of a packet of a free input is bounded by an execution of each hook
``tick``           one execution per due time, never before it
``counts``         ``run.json`` says what was observed, and its counters add up
``end``            the exit code is right, the end comes in time, and nothing is left
``killed``         every node ends by itself, within the time that it has for that
``drain``          after the end was asked for, nothing that sends unasked starts any more
=================  ============================================================================
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

from .description import Connection, Hook, Node, Project, Taken
from .running import Execution, Observed, earliest_start_ns

TIMED = {
    "window",
    "oldest first",
    "optional",
    "fresh",
    "fair",
    "awake",
    "age",
    "tick",
    "drain",
}
"""Rules that compare times of different processes: a machine that stands still can break them."""

MS = 1_000_000
_TOLERANCE_NS = 60 * MS
_LOADS = 1
_TICK_START_NS = 50 * MS
_DRAIN_S, _FINALISE_S, _SLACK_S = 5.0, 5.0, 4.0
_DEAD_AFTER_S = 6.0
_NEVER = 2**62
_ALWAYS = -(2**62)


@dataclass(frozen=True)
class Violation:
    """A rule that was broken: by what, in a sentence."""

    rule: str
    text: str

    @property
    def is_timed(self) -> bool:
        """Whether it rests on a comparison of times."""
        return self.rule in TIMED

    def __str__(self) -> str:
        return f"{self.rule}: {self.text}"


def judge(project: Project, observed: Observed) -> list[Violation]:
    """Everything that was wrong with a run."""
    return list(Judge(project, observed).violations())


@dataclass
class _Intake:
    """What one hook has taken of one connection: numbers and starts, in the order of starts."""

    connection: Connection
    hook: Hook
    numbers: list[int]
    starts_ns: list[int]

    def position(self, ns: int) -> int:
        """The number of the last packet that it had started on at a time, that time included."""
        return self._last(bisect.bisect_right(self.starts_ns, ns))

    def position_before(self, ns: int) -> int:
        """The same, without a start at just that time."""
        return self._last(bisect.bisect_left(self.starts_ns, ns))

    def reaches_ns(self, number: int) -> int:
        """When it started on a packet with that number or a later one."""
        place = bisect.bisect_left(self.numbers, number)
        return self.starts_ns[place] if place < len(self.starts_ns) else _NEVER

    def after(self, number: int) -> int | None:
        """The packet that it took next after that one."""
        place = bisect.bisect_right(self.numbers, number)
        return self.numbers[place] if place < len(self.numbers) else None

    def _last(self, place: int) -> int:
        return self.numbers[place - 1] if place else 0


class Judge:
    """The rules, on one run."""

    def __init__(self, project: Project, observed: Observed) -> None:
        self.project = project
        self.seen = observed
        self.tolerance_ns = _TOLERANCE_NS + _LOADS * observed.late_ns
        self.is_one_process = observed.is_one_process
        self.hooks = {(node.name, hook.name): hook for node in project.nodes for hook in node.hooks}
        self.log = {node.name: observed.executions.get(node.name, []) for node in project.nodes}
        self.runs: dict[tuple[str, str], list[Execution]] = {key: [] for key in self.hooks}
        for log in self.log.values():
            for each in log:
                self.runs[each.node, each.hook].append(each)
        self.sent_ns: dict[str, list[int]] = {origin: [] for origin in project.origins}
        for name, log in self.log.items():
            for each in log:
                for port, number in sorted(each.sent.items()):
                    times = self.sent_ns[f"{name}.{port}"]
                    if number == len(times) + 1:
                        times.append(each.end_ns)
        self.busy = {name: _Busy(log) for name, log in self.log.items()}
        self.busy_elsewhere = {
            name: _Busy(e for other, log in self.log.items() if other != name for e in log)
            for name in (self.log if self.is_one_process else ())
        }
        self.earliest_ns = earliest_start_ns(project, observed)
        self.latest_ns = self._latest_start()
        self.begin_ns = {node.name: self._begin(node) for node in project.nodes}
        self._found: list[Violation] = []
        self.intakes: dict[tuple[str, str, Connection], _Intake] = {}
        for node in project.nodes:
            for hook in node.hooks:
                for c in self._feeding(node, hook):
                    self.intakes[node.name, hook.name, c] = _Intake(c, hook, [], [])
        for node in project.nodes:
            self._read(node)

    # ------------------------------------------------------------------ what is judged

    def violations(self) -> Iterator[Violation]:
        """All of them."""
        if self.seen.error:
            yield Violation("end", f"it could not be run: {self.seen.error}")
            return
        yield from self._found
        yield from self._overlaps()
        yield from self._phases()
        yield from self._gaps()
        yield from self._windows()
        for node in self.project.nodes:
            for each in self.log[node.name]:
                hook = self.hooks[node.name, each.hook]
                yield from self._oldest_first(node, hook, each)
                yield from self._missing_optionals(node, hook, each)
                yield from self._staleness(node, hook, each)
                yield from self._ages(node, hook, each)
            for hook in node.hooks:
                if hook.kind in ("tick", "function"):
                    yield from self._readiness(node, hook)
                if hook.kind == "tick":
                    yield from self._ticks(node, hook)
        yield from self._counts()
        yield from self._end()

    @property
    def is_whole(self) -> bool:
        """Whether the run came to an orderly end, so that its books have to close."""
        return self.seen.exit_code in (0, 1, 130) and not self._has_failed

    @property
    def _unbegun(self) -> set[str]:
        """Nodes that were still being loaded when the project ended: they never said a word.

        An end that is drained waits for them.
        """
        if self.seen.exit_code == 0:
            return set()
        nodes = self.seen.record.get("nodes", {})
        return {
            name
            for name, log in self.log.items()
            if not log and not nodes.get(name, {}).get("report")
        }

    @property
    def _has_failed(self) -> bool:
        return self.seen.exit_code == 1 and "deadlock" not in self.seen.reason.lower()

    @cached_property
    def end_ns(self) -> int:
        """Up to when hooks ran as they should: the end was not asked for before."""
        times = [self.seen.ending_ns or _NEVER]
        for (node, _), hook in self.hooks.items():
            log = self.runs[node, hook.name]
            if hook.shutdown_at and len(log) >= hook.shutdown_at:
                times.append(log[hook.shutdown_at - 1].start_ns)
        if self._has_failed or (min(times) == _NEVER and not self._is_deadlock):
            times.append(max((each.start_ns for log in self.log.values() for each in log),
                             default=0))  # fmt: skip
        return min(*times, self.seen.ended_ns)

    @property
    def _is_deadlock(self) -> bool:
        return "deadlock" in self.seen.reason.lower()

    # ------------------------------------------------------------------ reading

    def _latest_start(self) -> int:
        """Time 0 of the run, or after: a tick comes a period later; ``_NEVER``: nobody knows."""
        times = [
            log[0].start_ns - int(hook.seconds * 1e9 if hook.kind == "tick" else 0)
            for (node, name), hook in self.hooks.items()
            if hook.kind in ("tick", "function") and (log := self.runs[node, name])
        ]
        return max(min(times), self.earliest_ns) if times else _NEVER

    def _begin(self, node: Node) -> int:
        """When a node had certainly begun to run, ``_NEVER`` if that is not known."""
        done = [self.runs[node.name, hook.name] for hook in node.hooks if hook.kind == "initialise"]
        if not all(done):
            return _NEVER
        return max([self.latest_ns, *(log[0].end_ns for log in done)])

    def _feeding(self, node: Node, hook: Hook) -> list[Connection]:
        return [c for each in hook.inputs for c in self.project.sources(node.name, each.port)]

    def _read(self, node: Node) -> None:
        """Sort what the node took by hook and connection; what cannot be sorted is wrong."""
        for each in self.log[node.name]:
            hook = self.hooks[node.name, each.hook]
            for declared, packets in zip(hook.inputs, each.taken, strict=True):
                sources = self.project.sources(node.name, declared.port)
                if packets is None:
                    if not declared.is_optional:
                        self._complain("input", each, f"{declared.port} is required, yet None")
                    continue
                if declared.is_all:
                    self._read_all(each, declared, sources, packets)
                elif packets[0] is not None:
                    self._read_one(each, hook, sources, packets[0])

    def _read_all(
        self,
        each: Execution,
        declared: Taken,
        sources: Sequence[Connection],
        packets: Sequence[tuple[int, int, bool] | None],
    ) -> None:
        if len(packets) != len(sources):
            self._complain("input", each, f"{len(packets)} packets of {len(sources)} connections")
            return
        for c, packet in zip(sources, packets, strict=True):
            if packet is not None:
                if self.project.origins[packet[0]] != c.origin:
                    found = self.project.origins[packet[0]]
                    self._complain("input", each, f"a packet of {found} in the place of {c}")
                else:
                    self._read_one(each, self.hooks[each.node, each.hook], [c], packet)
            elif not declared.is_optional:
                self._complain("input", each, f"nothing of {c}, yet All was asked for")

    def _read_one(
        self,
        each: Execution,
        hook: Hook,
        sources: Sequence[Connection],
        packet: tuple[int, int, bool],
    ) -> None:
        origin, number, is_intact = packet
        name = self.project.origins[origin]
        c = next((c for c in sources if c.origin == name), None)
        if c is None:
            self._complain("content", each, f"a packet of {name}, which does not feed that input")
            return
        intake = self.intakes[each.node, hook.name, c]
        last = intake.numbers[-1] if intake.numbers else 0
        times = self.sent_ns[name]
        kind = self.project.by_name[c.destination_node].inputs[c.destination_input].kind
        if kind == "byte":
            number = self._whole_number(c, number, last, each.start_ns)
        if not is_intact:
            self._complain("content", each, f"packet {number} of {c} is not as it was sent")
        elif number > len(times) or times[number - 1] > each.start_ns:
            self._complain("content", each, f"packet {number} of {c} had not been sent by then")
        elif number <= last:
            self._complain("order", each, f"packet {number} of {c} after packet {last}")
        else:
            intake.numbers.append(number)
            intake.starts_ns.append(each.start_ns)

    def _whole_number(self, c: Connection, byte: int, last: int, now_ns: int) -> int:
        """The number that ends in a byte: the next such, or the newest where any may be lost."""
        first = last + 1 + (byte - last - 1) % 256
        if c.is_reliable:
            return first
        sent = bisect.bisect_right(self.sent_ns[c.origin], now_ns)
        newest = sent - (sent - byte) % 256
        return newest if newest > last else first

    def _complain(self, rule: str, each: Execution, text: str) -> None:
        self._found.append(Violation(rule, f"{each.node}.{each.hook}: {text}"))

    # ------------------------------------------------------------------ order, lifecycle

    def _overlaps(self) -> Iterator[Violation]:
        if self.is_one_process:
            together = [sorted(itertools.chain(*self.log.values()), key=lambda e: e.start_ns)]
        else:
            together = list(self.log.values())
        for log in together:
            for a, b in itertools.pairwise(log):
                if b.start_ns < a.end_ns:
                    yield Violation(
                        "single thread", f"{b.node}.{b.hook} starts in {a.node}.{a.hook}"
                    )

    def _phases(self) -> Iterator[Violation]:
        loaded_ns = max(self.seen.loaded_ns.values(), default=_NEVER)
        for (node_name, name), log in self.runs.items():
            kind = self.hooks[node_name, name].kind
            due_ns = {"initialise": loaded_ns, "finalise": _ALWAYS}.get(kind, self.earliest_ns)
            if log and log[0].start_ns < due_ns:
                early_ms = (due_ns - log[0].start_ns) / 1e6
                text = f"{node_name}.{name} ran {early_ms:.1f} ms before every node was ready"
                yield Violation("start", text)
        for node in self.project.nodes:
            log = self.log[node.name]
            kinds = [self.hooks[node.name, each.hook].kind for each in log]
            main = [i for i, kind in enumerate(kinds) if kind in ("tick", "function")]
            for hook in node.hooks:
                count = len(self.runs[node.name, hook.name])
                if hook.kind == "initialise" and (count > 1 or (main and not count)):
                    yield Violation("initialise", f"{node.name}.{hook.name} ran {count} times")
                has_begun = node.name in self.seen.loaded_ns and node.name not in self._unbegun
                if hook.kind == "finalise" and count != 1 and has_begun:
                    yield Violation("finalise", f"{node.name}.{hook.name} ran {count} times")
            if main and any(kind == "initialise" for kind in kinds[main[0] :]):
                yield Violation("initialise", f"{node.name}: another hook ran before")
            if "finalise" in kinds and any(
                kind != "finalise" for kind in kinds[kinds.index("finalise") :]
            ):
                yield Violation("finalise", f"{node.name}: another hook ran after")

    def _gaps(self) -> Iterator[Violation]:
        for (node, name, c), intake in self.intakes.items():
            if c.discard_limit is None:
                continue
            for a, b in itertools.pairwise([0, *intake.numbers]):
                if b - a - 1 > c.discard_limit:
                    text = f"{node}.{name} took {b} after {a} of {c}, limit {c.discard_limit}"
                    yield Violation("gap", text)

    # ------------------------------------------------------------------ windows

    def _takers(self, c: Connection) -> list[_Intake]:
        """Who counts for acknowledgements once the receiver runs."""
        node = self.project.by_name[c.destination_node]
        return [
            self.intakes[node.name, hook.name, c]
            for hook in node.takers(c.destination_input)
            if hook.kind != "initialise"
        ]

    def _acknowledged_ns(self, c: Connection, number: int) -> int:
        """When the receiver had, at the latest, acknowledged so many."""
        node = self.project.by_name[c.destination_node]
        sent = self.sent_ns[c.origin]
        initialisers = [h for h in node.takers(c.destination_input) if h.kind == "initialise"]
        if number > len(sent):
            return _NEVER
        times = [intake.reaches_ns(number) for intake in self._takers(c)] or [sent[number - 1]]
        if initialisers:
            times.append(self.begin_ns[node.name])
        return max(times)

    def _windows(self) -> Iterator[Violation]:
        for c in self.project.connections:
            if not c.is_reliable:
                continue
            node = self.project.by_name[c.destination_node]
            initialisers = [h for h in node.takers(c.destination_input) if h.kind == "initialise"]
            takers = self._takers(c)
            if initialisers or not takers:
                continue
            for each in self.log[c.source_node]:
                number = each.sent.get(c.source_output)
                if number is None:
                    continue
                # Its hook was ready when it started, at the latest with what it took itself; the
                # receiver's note of a start comes a moment after its acknowledgement.
                late_ns = 0 if self.is_one_process else self.tolerance_ns
                known = min(taker.position(each.start_ns + late_ns) for taker in takers)
                if number - 1 - known >= c.window:
                    yield Violation(
                        "window",
                        f"{each.node}.{each.hook} sent packet {number} of {c} with"
                        f" {number - 1 - known} outstanding, {c.window} may be",
                    )

    # ------------------------------------------------------------------ what a hook takes

    def _known_ns(self, ns: int, node: str) -> int:
        """Until when a packet must have been sent to have arrived at a node by ``ns``.

        In process an event may have to wait for those of other nodes, oldest first: their hooks do
        not count as time.
        """
        known_ns = ns - self.tolerance_ns
        if not self.is_one_process:
            return known_ns
        while True:
            others_ns = self._others_ns(node, known_ns, ns)
            if ns - known_ns >= self.tolerance_ns + others_ns:
                return known_ns
            known_ns = ns - self.tolerance_ns - others_ns

    def _others_ns(self, node: str, from_ns: int, to_ns: int) -> int:
        """For how long hooks of other nodes ran, in process."""
        if not self.is_one_process:
            return 0
        return self.busy_elsewhere[node].within(from_ns, to_ns)

    def _waiting_since(self, c: Connection, intake: _Intake, position: int) -> int:
        """When the packet was sent that ended the input queue's emptiness; ``_NEVER``: unknown."""
        sent = self.sent_ns[c.origin]
        number = position + 1 if self._lost(c) == 0 else intake.after(position)
        return sent[number - 1] if number is not None and number <= len(sent) else _NEVER

    def _lost(self, c: Connection) -> int | None:
        """How many packets of a connection were lost in transport; ``None``: unknown."""
        if c.is_reliable:
            return 0
        counters = self.seen.connection(str(c))
        lost: int | None = counters["lost"] if counters else None
        return lost

    def _oldest_first(self, node: Node, hook: Hook, each: Execution) -> Iterator[Violation]:
        for declared in hook.inputs:
            sources = self.project.sources(node.name, declared.port)
            if declared.is_all or len(sources) < 2:
                continue
            intakes = [self.intakes[node.name, hook.name, c] for c in sources]
            taken = next((i for i in intakes if _took(i, each)), None)
            if taken is None:
                continue
            number = taken.position(each.start_ns)
            sent_ns = self.sent_ns[taken.connection.origin][number - 1]
            for other in intakes:
                # What is taken next, and what was there all along: with limit 0 the very next one.
                position = other.position(each.start_ns)
                later = (
                    position + 1 if other.connection.discard_limit == 0 else other.after(position)
                )
                times = self.sent_ns[other.connection.origin]
                if other is taken or later is None or later > len(times):
                    continue
                since_ns = max(times[later - 1], self.begin_ns[node.name])
                if since_ns < self._known_ns(max(sent_ns, since_ns), node.name):
                    yield Violation(
                        "oldest first",
                        f"{node.name}.{hook.name} took packet {number} of {taken.connection}"
                        f" although packet {later} of {other.connection} had waited"
                        f" {(sent_ns - since_ns) / 1e6:.0f} ms longer",
                    )

    def _missing_optionals(self, node: Node, hook: Hook, each: Execution) -> Iterator[Violation]:
        if hook.kind == "initialise":
            return
        known_ns = self._known_ns(each.start_ns, node.name)
        for declared in hook.inputs:
            if not declared.is_optional:
                continue
            intakes = [
                self.intakes[node.name, hook.name, c]
                for c in self.project.sources(node.name, declared.port)
            ]
            if not declared.is_all and any(_took(intake, each) for intake in intakes):
                continue
            for intake in intakes:
                since_ns = self._waiting_since(
                    intake.connection, intake, intake.position_before(each.start_ns)
                )
                if not _took(intake, each) and since_ns < known_ns:
                    yield Violation(
                        "optional",
                        f"{node.name}.{hook.name} took nothing of {intake.connection}, of which a"
                        f" packet had been sent {(each.start_ns - since_ns) / 1e6:.0f} ms before",
                    )

    def _staleness(self, node: Node, hook: Hook, each: Execution) -> Iterator[Violation]:
        known_ns = self._known_ns(each.start_ns, node.name)
        for c in self._feeding(node, hook):
            intake = self.intakes[node.name, hook.name, c]
            if not _took(intake, each):
                continue
            number = intake.position(each.start_ns)
            arrived = bisect.bisect_left(self.sent_ns[c.origin], known_ns)
            newer = arrived - number
            if not c.is_reliable:  # some may have been lost: what was taken later was not
                later = bisect.bisect_right(intake.numbers, arrived) - bisect.bisect_right(
                    intake.numbers, number
                )
                lost = self._lost(c)
                newer = later if lost is None else max(later, newer - lost)
            if newer >= c.queue_size:
                age_ms = (each.start_ns - self.sent_ns[c.origin][number - 1]) / 1e6
                yield Violation(
                    "fresh",
                    f"{node.name}.{hook.name} took packet {number} of {c}, {age_ms:.0f} ms old,"
                    f" with {newer} newer ones there (queue_size {c.queue_size})",
                )

    def _ages(self, node: Node, hook: Hook, each: Execution) -> Iterator[Violation]:
        """Rule (c): of an input that nothing but the node's own hooks can hold up."""
        if hook.kind != "function" or each.start_ns > self.end_ns:
            return
        required = [declared for declared in hook.inputs if not declared.is_optional]
        sources = self._feeding(node, hook)
        is_free = (
            len(required) <= 1 and len(sources) == 1 and not self._reliable_outputs(node, hook)
        )
        if not is_free or sources[0].queue_size > 1:
            return
        intake = self.intakes[node.name, hook.name, sources[0]]
        if not _took(intake, each) or self.begin_ns[node.name] == _NEVER:
            return
        number = intake.position(each.start_ns)
        since_ns = max(self.sent_ns[sources[0].origin][number - 1], self.begin_ns[node.name])
        longest_ns = {
            name: max((r.end_ns - r.start_ns for r in self.runs[node.name, name]
                       if r.start_ns < each.start_ns), default=0)
            for name in (other.name for other in node.hooks)
        }  # fmt: skip
        others_ns = self._others_ns(node.name, since_ns, each.start_ns)
        bound_ns = sum(longest_ns.values()) + others_ns + self.tolerance_ns
        if each.start_ns - since_ns > bound_ns:
            yield Violation(
                "age",
                f"{node.name}.{hook.name} took packet {number} of {sources[0]} when it was"
                f" {(each.start_ns - since_ns) / 1e6:.0f} ms old, {bound_ns / 1e6:.0f} ms are"
                " an execution of each hook",
            )

    # ------------------------------------------------------------------ readiness

    def _reliable_outputs(self, node: Node, hook: Hook) -> list[Connection]:
        return [
            c
            for sent in hook.outputs
            for c in self.project.connections
            if c.origin == f"{node.name}.{sent.port}" and c.is_reliable
        ]

    def ready_ns(self, node: Node, hook: Hook, previous: Execution | None, now_ns: int) -> int:
        """Since when a hook was ready that started, or did not start, at ``now_ns``.

        That is an upper bound, without the time that packets and acknowledgements take (which
        the tolerance is for); ``_NEVER`` if it was not, or that cannot be known.
        """
        since_ns = [self.begin_ns[node.name], previous.end_ns if previous else _ALWAYS]
        if hook.kind == "tick":
            started_ns = previous.start_ns if previous else self.begin_ns[node.name]
            since_ns.append(started_ns + int(hook.seconds * 1e9))
        for declared in hook.inputs:
            if declared.is_optional:
                continue
            times = [
                self._waiting_since(c, intake, intake.position_before(now_ns))
                for c in self.project.sources(node.name, declared.port)
                for intake in [self.intakes[node.name, hook.name, c]]
            ]
            since_ns.append(max(times) if declared.is_all else min(times))
        for c in self._reliable_outputs(node, hook):
            sent = bisect.bisect_left(self.sent_ns[c.origin], now_ns)
            needed = sent - c.window + 1
            if needed > 0:
                acknowledged_ns = self._acknowledged_ns(c, needed)
                since_ns.append(_NEVER if acknowledged_ns >= now_ns else acknowledged_ns)
        return max(since_ns)

    def _readiness(self, node: Node, hook: Hook) -> Iterator[Violation]:
        previous: Execution | None = None
        for each in self.runs[node.name, hook.name]:
            if each.start_ns > self.end_ns:
                return
            yield from self._was_kept_waiting(node, hook, previous, each.start_ns, "started")
            previous = each
        if not self._has_failed:
            yield from self._was_kept_waiting(node, hook, previous, self.end_ns, "had not started")

    def _was_kept_waiting(
        self, node: Node, hook: Hook, previous: Execution | None, now_ns: int, how: str
    ) -> Iterator[Violation]:
        since_ns = self.ready_ns(node, hook, previous, now_ns)
        if since_ns >= now_ns - self.tolerance_ns:
            return
        log = self.log[node.name]
        first = bisect.bisect_right(log, since_ns + self.tolerance_ns, key=lambda e: e.start_ns)
        last = bisect.bisect_left(log, now_ns, key=lambda e: e.start_ns)
        counts: dict[str, int] = {}
        for other in log[first:last]:
            counts[other.hook] = counts.get(other.hook, 0) + 1
        waited_ms = (now_ns - since_ns) / 1e6
        for name, count in counts.items():
            if count > 1:
                yield Violation(
                    "fair",
                    f"{node.name}.{hook.name} {how} {waited_ms:.0f} ms after it was ready, and"
                    f" {name} ran {count} times in between",
                )
        busy_ns = self.busy[node.name].within(since_ns, now_ns) + self._others_ns(
            node.name, since_ns, now_ns
        )
        rested_ns = now_ns - since_ns - busy_ns
        if rested_ns > self.tolerance_ns:
            yield Violation(
                "awake",
                f"{node.name}.{hook.name} {how} {waited_ms:.0f} ms after it was ready, and no hook"
                f" ran for {rested_ns / 1e6:.0f} ms of them",
            )

    # ------------------------------------------------------------------ ticks

    def _ticks(self, node: Node, hook: Hook) -> Iterator[Violation]:
        starts = [each.start_ns for each in self.runs[node.name, hook.name]]
        if not starts:
            return
        period_ns = int(hook.seconds * 1e9)
        early_ns, late_ns = self._since(node)
        if starts[0] < early_ns + period_ns:
            yield Violation("tick", f"{node.name}.{hook.name} ran before its first due time")
        # Some phase has a due time between each two starts. A note is made a moment after a start,
        # and later still where the machine does something else just then.
        slack_ns = period_ns // 4
        pairs = [(a - slack_ns, b) for a, b in itertools.pairwise(starts) if b - a < period_ns]
        late_ns += _TICK_START_NS + self.seen.late_ns
        candidates = {
            phase
            for phase in (b % period_ns for _, b in pairs)
            if (phase - early_ns) % period_ns <= late_ns - early_ns
        }
        candidates.add(late_ns % period_ns)
        early = min(
            (
                sum((b - phase) // period_ns == (a - phase) // period_ns for a, b in pairs)
                for phase in candidates
            ),
            default=0,
        )
        if early > 1 + len(starts) // 20:
            text = f"{node.name}.{hook.name} ran {early} times before it was due again"
            yield Violation("tick", text)
        yield from self._missed_ticks(node, hook, starts)

    def _since(self, node: Node) -> tuple[int, int]:
        """Between which times the start lies from which ticks of a node are counted."""
        latest_ns = self.begin_ns[node.name]
        own = [each.end_ns for each in self.log[node.name]
               if self.hooks[node.name, each.hook].kind == "initialise"]  # fmt: skip
        return max([self.earliest_ns, *own]), latest_ns

    def _missed_ticks(self, node: Node, hook: Hook, starts: Sequence[int]) -> Iterator[Violation]:
        """Due times up to the last start are executions or counted as missed: no drift."""
        books = self.seen.record.get("nodes", {}).get(node.name, {}).get("hooks", {}).get(hook.name)
        early_ns, late_ns = self._since(node)
        if not books or late_ns == _NEVER:
            return
        period_ns = int(hook.seconds * 1e9)
        least = (starts[-1] - late_ns) // period_ns
        due = (starts[-1] - early_ns) // period_ns
        slack = 1 + (_TICK_START_NS + self.seen.late_ns) // period_ns
        counted = books["executions"] + books["missed_ticks"]
        if not least - slack <= counted <= due + 1:
            yield Violation(
                "tick",
                f"{node.name}.{hook.name}: {books['executions']} executions and"
                f" {books['missed_ticks']} missed ticks, but it was due {due} times",
            )

    # ------------------------------------------------------------------ counts

    def _counts(self) -> Iterator[Violation]:
        if not self.seen.record or not self.is_whole:
            return
        for node in self.project.nodes:
            books = self.seen.record["nodes"].get(node.name, {}).get("hooks", {})
            for hook in node.hooks:
                seen = len(self.runs[node.name, hook.name])
                said = books.get(hook.name, {}).get("executions")
                if hook.kind != "finalise" and said is not None and said != seen:
                    text = f"{node.name}.{hook.name} ran {seen} times, run.json says {said}"
                    yield Violation("counts", text)
        for c in self.project.connections:
            for text in self._sums(c):
                yield Violation("counts", f"{c}: {text}")

    def _sums(self, c: Connection) -> Iterator[str]:
        books = self.seen.connection(str(c))
        if books is None:
            yield "is not in run.json"
            return
        sent, received, lost = books["sent"], books["received"], books["lost"]
        consumed, discarded, unread = books["consumed"], books["discarded"], books["unread"]
        if None in (sent, received, lost, consumed, discarded, unread):
            if not self._unbegun & {c.source_node, c.destination_node}:
                yield f"unknown counts {dict(books)}"
            return
        # What a hook returns when the project is ended at once is not sent any more.
        seen = len(self.sent_ns[c.origin])
        last = self.log[c.source_node][-1:] if self.seen.exit_code == 130 else []
        if sent != seen and not (last and sent == seen - (c.source_output in last[0].sent)):
            yield f"{seen} packets were sent, run.json says {sent}"
        in_flight = books["in_flight"]
        if sent != received + in_flight + lost or received != consumed + discarded + unread:
            yield f"the counters do not add up: {dict(books)}"
        may_be_in_flight = c.window if c.is_reliable and self.seen.exit_code else 0
        if in_flight > may_be_in_flight:
            yield f"{in_flight} packets are in flight, {may_be_in_flight} may be"
        if lost and c.is_reliable:
            yield f"lost {lost} on a reliable connection"
        if discarded and c.discard_limit == 0:
            yield f"discarded {discarded} with limit 0"
        if c.is_reliable and books["longest_discard"] > (c.discard_limit or 0):
            yield f"{books['longest_discard']} discarded in a row"
        if unread > c.queue_size:
            yield f"{unread} unread with queue_size {c.queue_size}"
        yield from self._consumed(c, received, consumed, discarded)

    def _consumed(
        self, c: Connection, received: int, consumed: int, discarded: int
    ) -> Iterator[str]:
        node = self.project.by_name[c.destination_node]
        takers = node.takers(c.destination_input)
        if any(hook.kind == "initialise" for hook in takers):
            return  # packets count by who is a taker at the time
        if not takers:
            if consumed != received:
                yield f"{consumed} of {received} consumed though no hook takes them"
            return
        taken = [set(self.intakes[node.name, hook.name, c].numbers) for hook in takers]
        both = len(set.intersection(*taken))
        # A position counts what arrived; of what may be lost the numbers in packets are further on.
        if consumed != both and (c.is_reliable or len(takers) == 1):
            yield f"every taker started on {both}, run.json says {consumed} were consumed"
        if c.is_reliable:
            passed = min(max(each, default=0) for each in taken)
            skipped = sum(
                number not in each for number in range(1, passed + 1) for each in taken[:1]
            )
            if len(takers) == 1 and discarded < skipped:
                yield f"{skipped} were skipped, run.json says {discarded} were discarded"

    # ------------------------------------------------------------------ the end

    def _end(self) -> Iterator[Violation]:
        seen = self.seen
        for thing in seen.left:
            yield Violation("end", f"left behind: {thing}")
        if not seen.record:
            yield Violation("end", "there is no run.json")
            return
        if seen.is_overdue:
            yield Violation("end", "it did not end by itself")
            return
        yield from self._exit_code()
        if self.end_ns < seen.ended_ns and not self._is_deadlock:
            took_s = (seen.ended_ns - self.end_ns) / 1e9
            limit_s = _DRAIN_S + _FINALISE_S + _SLACK_S + self.tolerance_ns / 1e9
            if took_s > limit_s:
                yield Violation("end", f"it took {took_s:.1f} s to end")
        yield from self._drain()

    def _exit_code(self) -> Iterator[Violation]:
        code, reason = self.seen.exit_code, self.seen.reason
        if self._is_deadlock:
            if code != 1:
                yield Violation("end", f"a deadlock with exit code {code}")
        elif code == 1:
            rule = "killed" if "had to be killed" in reason else "end"
            yield Violation(rule, f"failed: {reason}")
        elif code == 130:
            if self.project.end != "interrupt" and self.last_start_ns:
                yield Violation("end", f"exit code 130: {reason}")
        elif code != 0:
            yield Violation("end", f"exit code {code}: {reason}")
        if self.seen.looks_for_deadlocks and not self._is_deadlock and self.is_dead and code != 1:
            rested_s = (self.end_ns - self.last_start_ns) / 1e9
            if rested_s > _DEAD_AFTER_S:
                yield Violation("end", f"dead for {rested_s:.1f} s, and no word of a deadlock")

    @property
    def last_start_ns(self) -> int:
        """When the last hook started before the end was asked for."""
        starts = [e.start_ns for log in self.log.values() for e in log if e.start_ns <= self.end_ns]
        return max(starts, default=0)

    @property
    def is_dead(self) -> bool:
        """Whether at the end no hook was ready, nor could be without one that is."""
        if any(c.is_external for c in self.project.all_connections):
            return False  # the world outside may always send
        return bool(self.last_start_ns) and all(
            self.ready_ns(node, hook, next(iter(self.runs[node.name, hook.name][-1:]), None),
                          self.end_ns) == _NEVER
            for node in self.project.nodes
            for hook in node.hooks
            if hook.kind in ("tick", "function")
        )  # fmt: skip

    def _drain(self) -> Iterator[Violation]:
        if self._is_deadlock or self._has_failed:
            return
        for (node, name), hook in self.hooks.items():
            log = self.runs[node, name]
            if hook.shutdown_at and len(log) >= hook.shutdown_at:
                ending = log[hook.shutdown_at - 1]
                for each in self.log[node]:
                    kind = self.hooks[node, each.hook].kind
                    if each.start_ns > ending.start_ns and kind != "finalise":
                        text = f"{node}.{each.hook} started after {name} had ended the project"
                        yield Violation("drain", text)
            if not hook.is_unasked or hook.kind == "initialise":
                continue
            # A hook may run, and the launcher be slow to hear of the first one.
            late_ns = 10 * self.tolerance_ns + self._longest_ns(node)
            if self.latest_ns != _NEVER:  # a duration is counted from between these two
                late_ns += self.latest_ns - self.earliest_ns
            for each in log:
                if each.start_ns > self.end_ns + late_ns:
                    late_s = (each.start_ns - self.end_ns) / 1e9
                    yield Violation("drain", f"{node}.{name} started {late_s:.1f} s after the end")

    def _longest_ns(self, node: str) -> int:
        logs: Iterable[list[Execution]] = (
            self.log.values() if self.is_one_process else [self.log[node]]
        )
        return sum(max((e.end_ns - e.start_ns for e in log), default=0) for log in logs)


def _took(intake: _Intake, each: Execution) -> bool:
    """Whether the hook took a packet of the connection as it started there."""
    place = bisect.bisect_left(intake.starts_ns, each.start_ns)
    return place < len(intake.starts_ns) and intake.starts_ns[place] == each.start_ns


class _Busy:
    """For how long the executions of a log, which do not overlap, ran in spans of time."""

    def __init__(self, log: Iterable[Execution]) -> None:
        self._log = sorted(log, key=lambda e: e.start_ns)
        self._starts = [e.start_ns for e in self._log]
        self._before = [0, *itertools.accumulate(e.end_ns - e.start_ns for e in self._log)]

    def within(self, from_ns: int, to_ns: int) -> int:
        """Between two moments."""
        return max(0, self._until(to_ns) - self._until(from_ns))

    def _until(self, ns: int) -> int:
        place = bisect.bisect_left(self._starts, ns)
        if not place:
            return 0
        last = self._log[place - 1]
        return self._before[place - 1] + min(last.end_ns, ns) - last.start_ns
