"""Watching a run from its reports: has anything moved, and what should the user hear of?

Reports come once per second, so what is said here is up to a second late.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

STALL_S = 5.0
"""After this long, nodes are asked why nothing moves, and a hook that still runs is named."""

_FIRST_REMARK_S = 5.0
_NEXT_REMARK_S = 10.0


class Watch:
    """Keeps what the supervisor needs to know of the nodes between their reports.

    Args:
        names: the nodes.
        now_s: the time now; all times are seconds on one monotonic clock.
    """

    def __init__(self, names: Sequence[str], now_s: float) -> None:
        self._names = tuple(names)
        self._silent = set(names)
        self._reports: dict[str, Mapping[str, Any]] = {}
        self._heard_s: dict[str, float] = {}
        self._moved: dict[str, Any] = {}
        self._moved_s = now_s
        self._has_explained = False
        self._named_hooks: set[tuple[str, str, int]] = set()
        self._named_as_mute: set[str] = set()
        self._next_remark_s = now_s + _FIRST_REMARK_S

    def greet(self, names: Sequence[str]) -> None:
        """These nodes' process is there."""
        self._silent.difference_update(names)

    def report(self, name: str, report: Mapping[str, Any], now_s: float) -> None:
        """Take a report."""
        self._reports[name] = report
        self._heard_s[name] = now_s
        self._named_as_mute.discard(name)
        ledger = report["ledger"]
        moved = ledger and (
            [hook["executions"] for hook in ledger["hooks"].values()],
            [c["received"] for c in ledger["incoming"].values()],
        )
        if self._moved.get(name) != moved:
            self._moved[name] = moved
            self._moved_s = now_s
            self._has_explained = False

    def is_greeted(self, name: str) -> bool:
        """Whether the process of a node has said hello."""
        return name not in self._silent

    def is_loaded(self, name: str) -> bool:
        """Whether a node has come as far as having an engine that may run hooks."""
        report = self._reports.get(name)
        return report is not None and report["ledger"] is not None

    @property
    def is_complete(self) -> bool:
        """Whether all nodes have been loaded."""
        return not self._silent and all(map(self.is_loaded, self._names))

    @property
    def is_driven(self) -> bool:
        """Whether some node starts hooks with no packet for them."""
        return any(report["is_driving"] for report in self._reports.values())

    def begin_anew(self, now_s: float) -> None:
        """Something has kept the nodes still that is no standstill of their own."""
        self._moved_s = now_s
        self._has_explained = False

    def rested_s(self, now_s: float) -> float:
        """For how long no hook has run and no packet has arrived; 0 while one executes."""
        if any(self._executing(name) for name in self._reports):
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

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """What to tell the user now, as ``(severity, text)``."""
        yield from self._remarks_on_hooks()
        yield from self._remarks_on_silence(now_s)
        if now_s >= self._next_remark_s:
            self._next_remark_s = now_s + _NEXT_REMARK_S
            if self._silent:
                yield "INFO", f"still starting: {', '.join(sorted(self._silent))}"
            loading = [name for name in sorted(self._reports) if not self.is_loaded(name)]
            if loading:
                yield "INFO", f"still importing their plugins: {', '.join(loading)}"
            if waiting := self._waiting():
                yield "INFO", f"connections still waiting for their other end: {'; '.join(waiting)}"

    def last_seen(self, name: str) -> str:
        """What a node was doing when it reported last: ``", last seen executing 'step'"``."""
        hook = self._executing(name) if name in self._reports else None
        return f", last seen executing '{hook['name']}'" if hook else ""

    def _remarks_on_hooks(self) -> Iterator[tuple[str, str]]:
        for name in self._reports:
            hook = self._executing(name)
            if hook and hook["for_s"] >= STALL_S:
                key = (name, hook["name"], hook["executions"])
                if key not in self._named_hooks:
                    self._named_hooks.add(key)
                    yield "WARN", f"{name} has been executing '{hook['name']}' for {STALL_S:g} s"

    def _remarks_on_silence(self, now_s: float) -> Iterator[tuple[str, str]]:
        for name, heard_s in self._heard_s.items():
            if now_s - heard_s >= STALL_S and name not in self._named_as_mute:
                self._named_as_mute.add(name)
                yield (
                    "WARN",
                    f"{name} has not reported for {STALL_S:g} s{self.last_seen(name)}: its process"
                    " is stopped, or a library holds Python's global lock",
                )

    def _waiting(self) -> list[str]:
        """Connections whose other end has not been found yet."""
        return sorted({key for report in self._reports.values() for key in report["waiting_for"]})

    def _executing(self, name: str) -> Mapping[str, Any] | None:
        ledger = self._reports[name]["ledger"]
        return ledger["executing"] if ledger else None
