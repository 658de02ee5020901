"""A project in several parts, each with a launcher of its own: what this one knows of the others.

Launchers meet through their nodes alone: each has its nodes say how the run goes on its side (a
:class:`~neuros.launch.word.Word`), and is told what nodes elsewhere say. So the sides can come in
any order; each knows for which it still waits; and the end of one is the end of all.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from neuros.launch.word import DRAINED, DRAINING, OVER, STOPPING, Word, books_of, count, word_from
from neuros.project.model import Connection, NodeFile

_FIRST_REMARK_S = 5.0
_NEXT_REMARK_S = 10.0
# A node that is gone may have said why a moment before, on a longer way.
_GRACE_S = 0.3
# How long one side that has come to its end waits for what another has counted.
_PATIENCE_S = 2.0


class End(NamedTuple):
    """That the project ends elsewhere: with which exit code, why, and for how long it drains."""

    exit_code: int
    reason: str
    drain_s: float


class Sides:
    """This side of a project, and all others.

    Args:
        run: marks this run.
        elsewhere: the nodes of the project that are not started here; none: there is one side.
        files: the nodes that are.
        hint: what to add where nodes elsewhere are waited for.
    """

    def __init__(
        self, run: str, elsewhere: Sequence[str], files: Sequence[NodeFile], hint: str = ""
    ) -> None:
        self._elsewhere = elsewhere
        self._hint = hint
        here = {file.node.name for file in files}
        self._crossing = sorted(
            {c for file in files for c in file.connections if not _ends(c) <= here},
            key=lambda connection: connection.index,
        )
        neighbours = {name for connection in self._crossing for name in _ends(connection)}
        self._missing = neighbours - here
        self._found: list[str] = []
        self._say: Callable[[str], object] = lambda _: None
        self._own = Word(run, socket.gethostname())
        self._others: dict[str, Word] = {}
        self._run_of: dict[str, str] = {}
        self._gone_s: dict[str, float] = {}
        self._next_remark_s: float | None = None
        self._over_s: float | None = None

    # ------------------------------------------------------------------ speaking

    def speak_through(self, say: Callable[[str], object]) -> None:
        """Have nodes say what there is to say by ``say(text)``."""
        self._say = say

    @property
    def exist(self) -> bool:
        """Whether there is more than one side."""
        return bool(self._elsewhere)

    @property
    def word(self) -> str:
        """The last word of this side, for nodes that have just come."""
        return self._own.to_text()

    def drain(self, reason: str, drain_s: float) -> None:
        """This side drains."""
        self._utter(phase=DRAINING, drain_s=drain_s, **self._because(reason, 0))

    def settle(self, probes: Mapping[str, Mapping[str, Any]]) -> bool:
        """This side is drained by itself; returns whether others agree, and nothing is under way.

        Others count it as drained only while the counters of both ends are equal. A packet under
        way shows in them (Mattern's counters once more, see :mod:`neuros.launch.quiescence`).
        """
        books = books_of(probes, self._crossing)
        if (self._own.phase, self._own.books) != (DRAINED, books):
            self._utter(phase=DRAINED, books=books)
        return all(self._agrees(word) for word in self._living())

    def unsettle(self) -> None:
        """There is still something to do here."""
        if self._own.phase == DRAINED:
            self._utter(phase=DRAINING)

    def stop(self, exit_code: int, reason: str) -> None:
        """This side stops."""
        self._utter(phase=STOPPING, **self._because(reason, exit_code))

    def finish(self, reports: Mapping[str, Mapping[str, Any]], now_s: float) -> bool:
        """All nodes here have made their final report; returns whether they may go."""
        if self._over_s is None:
            self._over_s = now_s
            self._utter(phase=OVER, books=books_of(reports, self._crossing))
        return not self._unfinished() or now_s - self._over_s >= _PATIENCE_S

    # ------------------------------------------------------------------ hearing

    def hear(self, node: str, text: str | None, now_s: float) -> None:
        """A node elsewhere has said something, or is gone."""
        if text is None:
            if node in self._run_of:
                self._gone_s.setdefault(node, now_s)
            return
        word = word_from(text)
        if word is None or word.run == self._own.run:
            return
        if word.run not in self._others and not word.has_just_begun:
            return  # the rest of a run before this one
        if self._run_of.setdefault(node, word.run) != word.run:
            self._gone_s.setdefault(node, now_s)  # another has taken its place
            return
        if node in self._missing:
            self._missing.remove(node)
            self._found.append(f"{node} ({word.host})")
        if word.run not in self._others or word.number > self._others[word.run].number:
            self._others[word.run] = word

    def end(self, now_s: float) -> End | None:
        """How the project ends elsewhere, if it does."""
        for node, gone_s in self._gone_s.items():
            word = self._others[self._run_of[node]]
            if not word.is_ending and now_s - gone_s >= _GRACE_S:
                host = word.host
                return End(
                    1,
                    f"node '{node}' on {host} is gone: it was killed, or {host} or the network"
                    " to it is down",
                    0.0,
                )
        ending = [word for word in self._others.values() if word.is_ending]
        if not ending:
            return None
        worst = max(ending, key=lambda word: word.exit_code)
        reason = f"the project ended elsewhere ({worst.origin}): {worst.reason}"
        return End(worst.exit_code, reason, worst.drain_s)

    def books(self) -> Mapping[str, Mapping[str, Any]]:
        """What nodes elsewhere have counted on connections to here, of sides that are over."""
        over = [word for word in self._others.values() if word.phase == OVER]
        return {node: metrics for word in over for node, metrics in word.books.items()}

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """What to tell the user now, as ``(severity, text)``."""
        if self._found:
            yield "INFO", f"found elsewhere: {', '.join(self._found)}"
            self._found.clear()
        if self._next_remark_s is None:
            self._next_remark_s = now_s + _FIRST_REMARK_S
        if self._missing and now_s >= self._next_remark_s:
            self._next_remark_s = now_s + _NEXT_REMARK_S
            yield "INFO", f"nodes elsewhere are still waited for: {self._names()}{self._hint}"

    # ------------------------------------------------------------------ inside

    def _names(self) -> str:
        return ", ".join(sorted(self._missing))

    def _utter(self, **changes: Any) -> None:
        if self._elsewhere:
            self._own = replace(self._own, number=self._own.number + 1, **changes)
            self._say(self.word)

    def _because(self, reason: str, exit_code: int) -> dict[str, Any]:
        """The cause of the end; the first one stays, and where it is known from elsewhere."""
        for word in self._others.values():
            if word.is_ending and word.reason and reason.endswith(word.reason):
                return {"reason": word.reason, "origin": word.origin, "exit_code": exit_code}
        return {"reason": reason, "origin": self._own.host, "exit_code": exit_code}

    def _living(self) -> list[Word]:
        """The words of sides whose nodes run hooks."""
        return [word for word in self._others.values() if word.has_just_begun]

    def _unfinished(self) -> bool:
        """Whether a side that is there has not said what it has counted in all."""
        gone = {self._run_of[node] for node in self._gone_s}
        return any(w.phase != OVER and w.run not in gone for w in self._others.values())

    def _agrees(self, other: Word) -> bool:
        if other.phase != DRAINED:
            return False
        books = {**self._own.books, **other.books}
        return all(
            count(books, c.source_node, "outgoing", c, sent)
            == count(books, c.destination_node, "incoming", c, arrived)
            for c in self._crossing
            if c.is_reliable and _ends(c) & other.books.keys()
            for sent, arrived in (("sent", "received"), ("acknowledged", "acknowledged"))
        )


def _ends(connection: Connection) -> set[str]:
    return {connection.source_node, connection.destination_node}
