"""What a node did first, execution by execution, for a picture of how hooks and packets interlock.

The books of a run are sums; who waited for whom can only be seen in single executions. The first
ones are enough for that, and a list that ends costs nothing afterwards.
"""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neuros.core.hook import Hook
    from neuros.project.model import Connection

MOST_EXECUTIONS = 10_000
"""240 kB, which are given away as soon as they are written."""


class Trace:
    """The first executions of a node's hooks, and the acknowledgements that came meanwhile.

    Attributes:
        is_full: whether nothing more is noted.
        hooks: name and kind of each hook that has run, in the order of first executions.
        executions: place in ``hooks``, start and end (ns), one after the other.
        credits: index of a connection, position that was acknowledged and when (ns), likewise.
    """

    __slots__ = ("_left", "_places", "credits", "executions", "hooks", "is_full")

    def __init__(self, most: int = MOST_EXECUTIONS) -> None:
        self._left = most
        self._places: dict[Hook, int] = {}
        self.is_full = most <= 0
        self.hooks: list[tuple[str, str]] = []
        self.executions = array("q")
        self.credits = array("q")

    def note_execution(self, hook: Hook, start_ns: int, end_ns: int) -> None:
        """A hook has run."""
        place = self._places.get(hook)
        if place is None:
            place = self._places[hook] = len(self.hooks)
            self.hooks.append((hook.name, hook.spec.kind.value))
        self.executions.extend((place, start_ns, end_ns))
        self._left -= 1
        self.is_full = self._left <= 0

    def note_credit(self, connection: Connection, position: int, now_ns: int) -> None:
        """An acknowledgement has arrived."""
        self.credits.extend((connection.index, position, now_ns))
