"""Progress of nodes that finalise: pictures, weights and files take as long as they take."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

SAVING_S = 1.0
"""After this long, the user is told what a node is doing."""

LEAVE_S = 5.0
"""What a process has for its end, once all its nodes have made their final report."""

_LOOK_S = 1.0


class FinaliseTimes:
    """How long the nodes of each process have made no progress since the end began.

    A hook that ends, ``node.progress`` and a file that grows in the folder of a node are progress.

    Args:
        limits_s: how long each node may make none.
        run_folder: with a folder for each node.
    """

    def __init__(self, limits_s: Mapping[str, float], run_folder: Path) -> None:
        self.limits_s = limits_s
        self._run_folder = run_folder
        self._moved_s: dict[str, float] = {}
        self._left: dict[str, list[str]] = {}
        self._hooks: dict[str, str | None] = {}
        self._since_s: dict[str, float] = {}
        self._named: set[tuple[str, str]] = set()
        self._sizes: dict[str, dict[str, int]] = {}
        self._looked_s: dict[str, float] = {}

    def declare(self, node: str, hooks: Sequence[str]) -> None:
        """These are the finalise hooks of a node."""
        self._left[node] = list(hooks)

    def begin(self, now_s: float) -> None:
        """The nodes have been asked to end."""
        for name in self.limits_s:
            self._moved_s.setdefault(name, now_s)
            self._looked_s.setdefault(name, now_s)  # what nodes write as they are told is no news

    def shift(self, still_s: float) -> None:
        """The run stood still for so long."""
        self._moved_s = {name: moved_s + still_s for name, moved_s in self._moved_s.items()}

    def advance(self, node: str, now_s: float) -> None:
        """A node has made progress."""
        self._moved_s[node] = now_s

    def enter(self, node: str, hook: str | None, now_s: float) -> None:
        """A node starts a finalise hook; ``""``: it closes what it holds; ``None``: it is done."""
        self._hooks[node] = hook
        if hook and hook in self._left.get(node, ()):
            self._left[node].remove(hook)
        self._since_s[node] = now_s
        self.advance(node, now_s)

    def has_begun(self, names: Sequence[str]) -> bool:
        """Whether a process with these nodes runs no hook any more but finalise hooks."""
        return any(name in self._hooks for name in names)

    def current(self, names: Sequence[str]) -> str:
        """The node of a process that finalises now; empty if there is none."""
        return next((name for name in names if self._hooks.get(name) is not None), "")

    def left_s(self, names: Sequence[str], now_s: float) -> float:
        """Seconds until the nodes of one process have made no progress for too long."""
        current = self.current(names)
        waiting = [current] if current else names
        for name in waiting:
            self._check_files(name, now_s)
        return max(self._moved_s[name] + self.limits_s[name] for name in waiting) - now_s

    def unfinished(self, node: str) -> list[str]:
        """Clauses about the finalise hooks of a node that has not made its final report."""
        clauses = []
        hook = self._hooks.get(node)
        if hook:
            clauses.append(f"finalise hook '{hook}' of '{node}' did not finish")
        elif hook is not None:
            clauses.append(f"what '{node}' has registered with node.on_close did not end")
        if names := self._left.get(node):
            hooks = " and ".join(f"'{name}'" for name in names)
            noun = "hook" if len(names) == 1 else "hooks"
            clauses.append(f"finalise {noun} {hooks} of '{node}' did not run")
        return clauses

    def remarks(self, now_s: float) -> Iterator[str]:
        """Sentences about nodes that have finalised for a second, each once."""
        for node, hook in self._hooks.items():
            is_long = hook is not None and now_s - self._since_s[node] >= SAVING_S
            if hook is not None and is_long and (node, hook) not in self._named:
                self._named.add((node, hook))
                yield f"saving: '{node}' ({f'finalise hook {hook!r}' if hook else 'closing'})"

    def _check_files(self, node: str, now_s: float) -> None:
        """Count it as progress if a file of the node has grown since the last look."""
        if now_s - self._looked_s.get(node, 0.0) < min(_LOOK_S, self.limits_s[node] / 4):
            return
        self._looked_s[node] = now_s
        before, now = self._sizes.get(node), _sizes(self._run_folder / node)
        self._sizes[node] = now
        if before is not None and any(now[path] > before.get(path, -1) for path in now):
            self.advance(node, now_s)


def _sizes(folder: Path) -> dict[str, int]:
    """The sizes of all files below a folder; what cannot be read does not count."""
    found = {}
    for parent, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(parent, name)
            try:
                found[path] = os.lstat(path).st_size
            except OSError:  # it was a temporary file
                continue
    return found
