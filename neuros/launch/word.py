"""What a launcher has its nodes say to nodes elsewhere: how the run goes on its side."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from neuros.project.model import Connection

Books = Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]]
"""``books[node]["outgoing" or "incoming"][connection]``: counters, as in a node's metrics."""

RUNNING, DRAINING, DRAINED, STOPPING, OVER = "running", "draining", "drained", "stopping", "over"
_BEGUN = (RUNNING, DRAINING, DRAINED)


@dataclass(frozen=True)
class Word:
    """The state of a run on one side; each word says all, so that one that is missed is no loss.

    Attributes:
        run: which run it is.
        host: the name of the machine.
        number: a later word has a higher one.
        phase: of the run on that side.
        exit_code, reason: how it ends, from when it is to end on.
        origin: the machine on which the cause of that lies.
        drain_s: for how long it drains at most.
        books: of the connections to other sides, when drained or over.
    """

    run: str
    host: str
    number: int = 0
    phase: str = RUNNING
    exit_code: int = 0
    reason: str = ""
    origin: str = ""
    drain_s: float = 0.0
    books: Books = field(default_factory=dict)

    def to_text(self) -> str:
        """As it travels."""
        return json.dumps(asdict(self))

    @property
    def has_just_begun(self) -> bool:
        """Whether somebody who comes now can still take part."""
        return self.phase in _BEGUN

    @property
    def is_ending(self) -> bool:
        """Whether the end has been asked for."""
        return self.phase != RUNNING


def word_from(text: str) -> Word | None:
    """The inverse of :meth:`Word.to_text`; ``None`` for anything else."""
    try:
        return Word(**json.loads(text))
    except (TypeError, ValueError):
        return None


def books_of(reports: Mapping[str, Mapping[str, Any]], crossing: Sequence[Connection]) -> Books:
    """The counters of connections to other sides, from the reports of the nodes here."""
    keys = {str(connection) for connection in crossing}
    return {
        name: {
            part: {key: dict(c) for key, c in report["metrics"][part].items() if key in keys}
            for part in ("outgoing", "incoming")
        }
        for name, report in reports.items()
        if report["metrics"] is not None
    }


def count(books: Books, node: str, part: str, connection: Connection, what: str) -> int | None:
    """One counter, ``None`` where it is not known."""
    found = books.get(node, {}).get(part, {}).get(str(connection), {}).get(what)
    return None if found is None else int(found)
