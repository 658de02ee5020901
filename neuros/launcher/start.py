"""Start of a run: every plugin loads, then every node initialises, then the run begins."""

from __future__ import annotations

from collections.abc import Iterable

from neuros.launcher.peers import Peers, Stage


class Start:
    """How far the nodes have come, here and at peers: none goes on before all have caught up.

    Args:
        names: the nodes that are started here.

    Attributes:
        has_begun: whether nodes may initialise: each plugin of the project is loaded.
        is_over: whether time 0 of the run has come: each node of the project is ready.
    """

    def __init__(self, names: Iterable[str], peers: Peers) -> None:
        self._names = frozenset(names)
        self._peers = peers
        self._loaded: set[str] = set()
        self._ready: set[str] = set()
        self.has_begun = False
        self.is_over = False

    def note_loaded(self, names: Iterable[str]) -> None:
        """The plugins of these nodes are imported."""
        self._loaded.update(names)
        if self._loaded >= self._names:
            self._peers.reach(Stage.LOADED)

    def note_ready(self, name: str) -> None:
        """A node has initialised as far as it can alone."""
        self._ready.add(name)
        if self._ready >= self._names:
            self._peers.reach(Stage.READY)

    def may_initialise(self) -> bool:
        """True once, when every node of the project is loaded."""
        if self.has_begun or not (
            self._loaded >= self._names and self._peers.have_reached(Stage.LOADED)
        ):
            return False
        self.has_begun = True
        return True

    def may_run(self) -> bool:
        """True once, when every node of the project is ready."""
        if self.is_over or not (
            self._ready >= self._names and self._peers.have_reached(Stage.READY)
        ):
            return False
        self.is_over = True
        return True
