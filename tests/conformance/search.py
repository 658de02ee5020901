"""Looks for projects that break a rule, makes them smaller, and keeps them.

A rule that rests on times counts as broken if a second run breaks it, too, while no other of these
projects runs: a machine may stand still for a moment, or have too much to do. A project that stands
still by itself is run once more for as long as it takes to be called a deadlock.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock, Semaphore
from typing import TypeVar

from .description import Connection, Hook, Node, Port, Project, tidied
from .judge import Judge, Violation
from .running import LoadMeter, run

KEPT = Path(__file__).parent / "kept"
"""Projects that once broke a rule; they are run first."""

_Part = TypeVar("_Part")
_DEADLOCK_S = 9.0  # the launcher asks after one second, and the answers are some seconds apart
_MORE_RUNS = 2
_SHRINKING_RUNS = 60


@dataclass(frozen=True)
class Case:
    """A project on a back end, and where it comes from."""

    name: str
    backend: str
    project: Project


@dataclass(frozen=True)
class Verdict:
    """What was found of a case: what is wrong, and what was seen once and not again."""

    case: Case
    violations: Sequence[Violation]
    unconfirmed: Sequence[Violation] = ()

    def __str__(self) -> str:
        lines = [f"{self.case.name} ({self.case.backend}):", *map(str, self.violations[:8])]
        more = len(self.violations) - 8
        return "\n  ".join([*lines, f"and {more} more"] if more > 0 else lines)


class Gate:
    """Lets so many in at a time, or one alone, in the order in which they come."""

    def __init__(self, places: int = 1) -> None:
        self._places = places
        self._free = Semaphore(places)
        self._turn = Lock()

    @contextmanager
    def one_of_many(self) -> Iterator[None]:
        with self._turn:
            self._free.acquire()
        try:
            yield
        finally:
            self._free.release()

    @contextmanager
    def alone(self) -> Iterator[None]:
        with self._turn:
            for _ in range(self._places):
                self._free.acquire()
            try:
                yield
            finally:
                self._free.release(self._places)


def verdict_of(case: Case, meter: LoadMeter, gate: Gate | None = None) -> Verdict:
    """Run a case, as often as it takes to be sure."""
    gate = gate or Gate()
    with gate.one_of_many():
        violations, is_dead = _judged(case, meter)
    if not violations and is_dead:
        patient = replace(case, project=replace(case.project, end="duration"))
        with gate.one_of_many():
            violations, _ = _judged(patient, meter, seconds=_DEADLOCK_S)
    doubtful = {each.rule for each in violations if each.is_timed}
    if not doubtful or len(doubtful) < len({each.rule for each in violations}):
        return Verdict(case, violations)
    for _ in range(_MORE_RUNS):
        with gate.alone():
            again, _ = _judged(case, meter)
        confirmed = doubtful & {each.rule for each in again}
        if confirmed or any(not each.is_timed for each in again):
            return Verdict(case, again)
    return Verdict(case, (), violations)


def _judged(case: Case, meter: LoadMeter, seconds: float = 0.0) -> tuple[list[Violation], bool]:
    observed = run(case.project, case.backend, meter, seconds=seconds)
    judge = Judge(case.project, observed)
    violations = list(judge.violations())
    may_be_dead = observed.looks_for_deadlocks and observed.exit_code != 1
    return violations, not violations and may_be_dead and judge.is_dead


def verdicts(cases: Iterable[Case], jobs: int) -> Iterator[Verdict]:
    """Of many cases, in their order, so many at a time."""
    gate = Gate(jobs)
    with LoadMeter() as meter, ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(lambda case: verdict_of(case, meter, gate), cases)


# ------------------------------------------------------------------ what is kept


def kept(folder: Path = KEPT) -> list[Case]:
    """The cases of a folder."""
    cases = []
    for file in sorted(folder.glob("*.json")):
        content = json.loads(file.read_text())
        project = Project.from_json(content["project"])
        cases += [Case(file.stem, backend, project) for backend in content["backends"]]
    return cases


def keep(verdict: Verdict, folder: Path = KEPT) -> Path:
    """Write a case down; returns its file."""
    rules = sorted({each.rule for each in verdict.violations})
    name = re.sub(r"\W+", "_", f"{'_'.join(rules)}_{verdict.case.name}")
    content = {
        "found": [str(each) for each in verdict.violations[:3]],
        "backends": [verdict.case.backend],
        "project": verdict.case.project.to_json(),
    }
    folder.mkdir(exist_ok=True)
    file = folder / f"{name}.json"
    file.write_text(json.dumps(content, indent=1) + "\n")
    return file


# ------------------------------------------------------------------ making smaller


def shrunk(
    verdict: Verdict,
    is_broken: Callable[[Project], Sequence[Violation]],
    runs: int = _SHRINKING_RUNS,
) -> Verdict:
    """The smallest project found that still breaks one of the same rules.

    Args:
        is_broken: judges a project by a run.
        runs: at most so many.
    """
    rules = {each.rule for each in verdict.violations}
    tried: set[str] = set()
    project, violations = verdict.case.project, verdict.violations
    is_smaller = True
    while is_smaller:
        is_smaller = False
        for candidate in smaller(project):
            key = json.dumps(candidate.to_json())
            if key in tried:
                continue
            if len(tried) == runs:
                break
            tried.add(key)
            found = is_broken(candidate)
            if rules & {each.rule for each in found}:
                project, violations, is_smaller = candidate, found, True
                break
    return Verdict(replace(verdict.case, project=project), violations)


def smaller(project: Project) -> Iterator[Project]:
    """Projects with something less, the largest steps first."""
    for node in project.nodes:
        yield _valid(replace(project, nodes=_without(project.nodes, node)))
    for c in project.connections:
        yield _valid(replace(project, connections=_without(project.connections, c)))
    for node in project.nodes:
        for hook in node.hooks:
            yield _with_node(project, node, replace(node, hooks=_without(node.hooks, hook)))
    for node in project.nodes:
        for hook in node.hooks:
            for part in _smaller_hooks(hook):
                yield _with_hook(project, node, hook, part)
    for simpler in (
        replace(project, end="duration"),
        replace(project, nodes=_simple(project)),
    ):
        if simpler != project:
            yield _valid(simpler)
    for c in project.connections:
        if c.queue_size > 1:
            yield _with_connection(project, c, replace(c, queue_size=1))
        if c.discard_limit:
            yield _with_connection(project, c, replace(c, discard_limit=1))


def _smaller_hooks(hook: Hook) -> Iterator[Hook]:
    for taken in hook.inputs:
        yield replace(hook, inputs=_without(hook.inputs, taken))
    for sent in hook.outputs:
        yield replace(hook, outputs=_without(hook.outputs, sent))
        if sent.is_optional:
            plain = replace(sent, is_optional=False, every=1, at_most=0, is_answer=False)
            yield replace(hook, outputs=tuple(plain if s is sent else s for s in hook.outputs))
    for taken in hook.inputs:
        if taken.is_all:
            plain_input = replace(taken, is_all=False)
            yield replace(hook, inputs=tuple(plain_input if t is taken else t for t in hook.inputs))
    if hook.shutdown_at:
        yield replace(hook, shutdown_at=0)
    if hook.sleep_ms > 5:
        yield replace(hook, sleep_ms=2)


def _simple(project: Project) -> tuple[Node, ...]:
    """The nodes with plain numbers for messages."""

    def simple(port: Port) -> Port:
        return Port("int", 0, port.external)

    return tuple(
        replace(
            node,
            inputs={name: simple(port) for name, port in node.inputs.items()},
            outputs={name: simple(port) for name, port in node.outputs.items()},
        )
        for node in project.nodes
    )


def _with_hook(project: Project, node: Node, old: Hook, new: Hook) -> Project:
    hooks = tuple(new if each is old else each for each in node.hooks)
    return _with_node(project, node, replace(node, hooks=hooks))


def _with_node(project: Project, old: Node, new: Node) -> Project:
    return _valid(replace(project, nodes=tuple(new if n is old else n for n in project.nodes)))


def _with_connection(project: Project, old: Connection, new: Connection) -> Project:
    connections = tuple(new if c is old else c for c in project.connections)
    return _valid(replace(project, connections=connections))


def _valid(project: Project) -> Project:
    """The project without loose ends, which ends if packets go round in it for ever."""
    tidy = tidied(project)
    return replace(tidy, end="interrupt") if tidy.circulates else tidy


def _without(parts: tuple[_Part, ...], part: _Part) -> tuple[_Part, ...]:
    return tuple(each for each in parts if each is not part)
