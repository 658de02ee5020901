"""The supervisor's record of each node, from which all judgements are made.

Nodes that finalise may write pictures, weights and files, which takes as long as it takes: a hook
that ends, ``node.progress`` and a file that grows in the folder of the node are progress.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from neuros.control import ExecutingHook, Report

SAVING_S = 1.0
"""After this long, the user is told what a node is doing."""

LEAVE_S = 5.0
"""What a process has for its end, once all its nodes have made their final report."""

_LOOK_S = 1.0


@dataclass
class NodeView:
    """The record of one node. Times are seconds on one monotonic clock.

    Attributes:
        finalise_s: how long it may finalise without progress.
        folder: its run folder.
        together: the nodes of its process; itself alone until that has connected.
        plugin: the file of its plugin, as its process sees it.
        is_there: whether its process has connected.
        is_loaded: whether its plugin has been imported.
        is_ready: whether it has initialised as far as it can alone.
        has_failed: whether it has reported that it failed, so that its process may end.
        is_killed: whether its process was killed, or is to be.
        report: the newest.
        heard_s: when it reported last, or its process has connected.
        hooks_left: finalise hooks that have not started.
        hook: the finalise hook that runs, empty while it closes what it holds.
        has_stopped: whether it runs no hook any more but finalise hooks.
    """

    name: str
    finalise_s: float = 5.0
    folder: Path = Path()
    together: tuple[str, ...] = ()
    plugin: str = ""
    is_there: bool = False
    is_loaded: bool = False
    is_ready: bool = False
    has_failed: bool = False
    is_killed: bool = False
    report: Report | None = None
    heard_s: float | None = None
    hooks_left: list[str] = field(default_factory=list)
    hook: str | None = None
    has_stopped: bool = False
    _since_s: float = 0.0  # of the finalise hook
    _moved_s: float = 0.0
    _told: set[str] = field(default_factory=set)
    _sizes: dict[str, int] | None = None
    _looked_s: float = 0.0

    def __post_init__(self) -> None:
        self.together = (self.name,)

    def connect(self, names: Sequence[str], plugins: Mapping[str, str], now_s: float) -> None:
        """The process of the node is there, with these nodes and files of plugins."""
        self.together, self.is_there = tuple(names), True
        self.plugin = plugins.get(self.name, self.plugin)
        if self.heard_s is None:
            self.heard_s = now_s

    @property
    def has_begun(self) -> bool:
        """Whether it may run hooks."""
        return self.report is not None and self.report.metrics is not None

    @property
    def executing(self) -> ExecutingHook | None:
        """The hook that it was executing when it reported last."""
        return self.report.metrics["executing"] if self.report and self.report.metrics else None

    def silent_s(self, now_s: float) -> float:
        """For how long it has not reported."""
        return 0.0 if self.heard_s is None else now_s - self.heard_s

    def shift(self, still_s: float) -> None:
        """The launcher stood still for so long: that was no silence of the node."""
        self._moved_s += still_s
        if self.heard_s is not None:
            self.heard_s += still_s

    # ------------------------------------------------------------------ its end

    def begin_to_end(self, now_s: float) -> None:
        """It has been asked to end; what it writes as it is told so is no news."""
        self._moved_s = self._looked_s = now_s

    def enter(self, hook: str | None, now_s: float) -> None:
        """It starts a finalise hook; ``""``: it closes what it holds; ``None``: it is done."""
        self.hook, self.has_stopped, self._since_s = hook, True, now_s
        if hook and hook in self.hooks_left:
            self.hooks_left.remove(hook)
        self.advance(now_s)

    def advance(self, now_s: float) -> None:
        self._moved_s = now_s

    def left_s(self, now_s: float) -> float:
        """Seconds until it has made no progress for too long."""
        if now_s - self._looked_s >= min(_LOOK_S, self.finalise_s / 4):
            self._looked_s = now_s
            before, self._sizes = self._sizes, _sizes(self.folder)
            if before is not None and any(self._sizes[p] > before.get(p, -1) for p in self._sizes):
                self.advance(now_s)
        return self._moved_s + self.finalise_s - now_s

    def unfinished(self) -> list[str]:
        """Clauses about its finalise hooks, before its final report."""
        clauses = []
        if self.hook:
            clauses.append(f"finalise hook '{self.hook}' of '{self.name}' did not finish")
        elif self.hook is not None:
            clauses.append(f"what '{self.name}' has registered with node.on_close did not end")
        if self.hooks_left:
            hooks = " and ".join(f"'{name}'" for name in self.hooks_left)
            noun = "hook" if len(self.hooks_left) == 1 else "hooks"
            clauses.append(f"finalise {noun} {hooks} of '{self.name}' did not run")
        return clauses

    def saving(self, now_s: float) -> str:
        """A sentence once it has finalised for a second, for each of its hooks; else empty."""
        hook = self.hook
        if hook is None or now_s - self._since_s < SAVING_S or hook in self._told:
            return ""
        self._told.add(hook)
        return f"saving: '{self.name}' ({f'finalise hook {hook!r}' if hook else 'closing'})"


def finalising(nodes: Sequence[NodeView]) -> NodeView | None:
    return next((node for node in nodes if node.hook is not None), None)


def left_s(nodes: Sequence[NodeView], now_s: float) -> float:
    """Seconds until the nodes of one process have made no progress for too long."""
    current = finalising(nodes)
    return max(node.left_s(now_s) for node in ([current] if current else nodes))


def _sizes(folder: Path) -> dict[str, int]:
    """The sizes of all files below a folder; what cannot be read does not count."""
    found = {}
    for parent, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(parent, name)
            with contextlib.suppress(OSError):  # it was a temporary file
                found[path] = os.lstat(path).st_size
    return found
