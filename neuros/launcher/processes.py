"""Node processes of a run: those that run, were killed, or ended without being asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from neuros.launcher.outcome import Outcome
from neuros.launcher.stall_detector import StallDetector
from neuros.ports import RunningNode


class Processes:
    """Processes that the back end has started, judged by the reports of their nodes.

    Attributes:
        killed: the names of all nodes whose processes were killed.
    """

    def __init__(self, detector: StallDetector, outcome: Outcome) -> None:
        self._detector = detector
        self._outcome = outcome
        self._running: list[RunningNode] = []
        self._has_told_failure: set[str] = set()
        self.killed: set[str] = set()

    def add(self, started: Sequence[RunningNode]) -> None:
        """These run from now on."""
        self._running += started

    def __len__(self) -> int:
        return len(self._running)

    def __iter__(self) -> Iterator[RunningNode]:
        return iter(tuple(self._running))

    def note_failure(self, name: str) -> None:
        """A node has told that it failed: its process may end now."""
        self._has_told_failure.add(name)

    def ended(self) -> list[tuple[RunningNode, str]]:
        """Processes that have ended since the last call, and how."""
        ended = [(process, how) for process in self._running if (how := process.poll())]
        for process, _ in ended:
            self._running.remove(process)
        return ended

    def kill(self, process: RunningNode) -> None:
        self.killed.update(process.names)
        process.kill()

    def not_loaded(self) -> list[RunningNode]:
        """Processes in which no node has come as far as its first hook."""
        return [
            process
            for process in self._running
            if not any(self._detector.is_loaded(name) for name in process.names)
        ]

    def have_reported(self) -> bool:
        """Whether every node has made its final report, but for those that were killed."""
        names = {name for process in self._running for name in process.names}
        return all(map(self._outcome.has_final_report, names - self.killed))

    def may_end(self, process: RunningNode, *, is_stopping: bool) -> bool:
        """Whether it was asked to end and has told its last, or has failed and said so."""
        names = set(process.names)
        if names <= self.killed or names & self._has_told_failure:
            return True
        return is_stopping and all(map(self._outcome.has_final_report, names))

    def how_it_failed(self, process: RunningNode, how: str, *, is_stopping: bool) -> str:
        """One sentence about a process that should not have ended."""
        noun = "node" if len(process.names) == 1 else "nodes"
        return f"{noun} {names_of(process)} {self._when(process, is_stopping)}: {how}"

    def _when(self, process: RunningNode, is_stopping: bool) -> str:
        if is_stopping:
            return "ended while finalising"
        if not any(map(self._detector.is_greeted, process.names)):
            were = "it was up (what it" if len(process.names) == 1 else "they were up (what they"
            return f"ended before {were} wrote is above)"
        seen = "".join(self._detector.last_seen(name) for name in process.names)
        return f"ended unexpectedly{seen}"


def names_of(process: RunningNode) -> str:
    """Its nodes, for people."""
    return " and ".join(f"'{name}'" for name in process.names)
