"""Watching a run from its reports: has anything moved, and what should the user hear of?"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

STALL_S = 5.0
"""Nodes are asked why nothing has moved for this long; a hook that runs for it is named."""

_FIRST_REMARK_S = 5.0
_NEXT_REMARK_S = 10.0


class Watch:
    """Keeps what the supervisor needs to know of the nodes between their reports."""

    def __init__(self, names: Sequence[str]) -> None:
        now_s = time.monotonic()
        self._silent = set(names)
        self._reports: dict[str, Mapping[str, Any]] = {}
        self._moved: dict[str, Any] = {}
        self._moved_s = now_s
        self._has_explained = False
        self._named_hooks: set[tuple[str, str, int]] = set()
        self._next_remark_s = now_s + _FIRST_REMARK_S

    def greet(self, names: Sequence[str]) -> None:
        """These nodes' process is there."""
        self._silent.difference_update(names)

    def report(self, name: str, report: Mapping[str, Any]) -> None:
        """Take a report."""
        self._reports[name] = report
        ledger = report["ledger"]
        moved = ledger and (
            [hook["executions"] for hook in ledger["hooks"].values()],
            [c["received"] for c in ledger["incoming"].values()],
        )
        if self._moved.get(name) != moved:
            self._moved[name] = moved
            self._moved_s = time.monotonic()
            self._has_explained = False

    def rested_s(self, now_s: float) -> float:
        """For how long no hook has run and no packet has arrived; 0 while one executes."""
        if any(self._executing(name) for name in self._reports):
            return 0.0
        return now_s - self._moved_s

    def has_just_stalled(self, now_s: float) -> bool:
        """True once per standstill, when it has lasted :data:`STALL_S`."""
        if self._has_explained or now_s - self._moved_s < STALL_S or not self._is_complete():
            return False
        self._has_explained = True
        return True

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """What to tell the user now, as ``(severity, text)``."""
        for name in self._reports:
            hook = self._executing(name)
            if hook and hook["for_s"] >= STALL_S:
                key = (name, hook["name"], hook["executions"])
                if key not in self._named_hooks:
                    self._named_hooks.add(key)
                    yield "WARN", f"{name} has been executing '{hook['name']}' for {STALL_S:g} s"
        if now_s >= self._next_remark_s:
            self._next_remark_s = now_s + _NEXT_REMARK_S
            if self._silent:
                yield "INFO", f"still starting: {', '.join(sorted(self._silent))}"
            waiting = sorted(
                {key for report in self._reports.values() for key in report["waiting_for"]}
            )
            if waiting:
                yield "INFO", f"connections still waiting for their other end: {'; '.join(waiting)}"

    def _is_complete(self) -> bool:
        return not self._silent and all(
            report["ledger"] is not None for report in self._reports.values()
        )

    def _executing(self, name: str) -> Mapping[str, Any] | None:
        ledger = self._reports[name]["ledger"]
        return ledger["executing"] if ledger else None
