"""The first executions of a node's hooks, as :mod:`neuros.runtime.packet_log` writes them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuros.observe.packets import Numbers


@dataclass(frozen=True)
class Trace:
    """Times are of the monotonic clock, in nanoseconds.

    Attributes:
        hooks: name and kind of each hook that ran.
        which: of each execution, its hook's place in ``hooks``, (executions,).
        starts_ns, ends_ns: from when to when, (executions,).
        credits: index of the connection, position and arrival of each acknowledgement, (n, 3).
    """

    hooks: tuple[tuple[str, str], ...]
    which: Numbers
    starts_ns: Numbers
    ends_ns: Numbers
    credits: Numbers

    @property
    def is_running(self) -> Numbers:
        """Which executions were not of initialise hooks, (executions,)."""
        initialisers = [i for i, (_, kind) in enumerate(self.hooks) if kind == "initialise"]
        found: Numbers = ~np.isin(self.which, initialisers)
        return found


def read_trace(folder: Path) -> Trace:
    """Read the lists of a node; empty where there are none."""
    executions = _triples(folder / "executions")
    try:
        hooks = json.loads((folder / "hooks.json").read_text("utf-8"))
        names = [(str(hook["name"]), str(hook["kind"])) for hook in hooks]
    except (OSError, ValueError, TypeError, KeyError):
        names = []
    # A node that was killed may have listed a hook's execution, and not its name.
    count = int(executions[:, 0].max()) + 1 if len(executions) else 0
    names += [(f"hook {place + 1}", "function") for place in range(len(names), count)]
    which, starts_ns, ends_ns = executions.T
    return Trace(tuple(names), which, starts_ns, ends_ns, _triples(folder / "credits"))


def _triples(file: Path) -> Numbers:
    try:
        data = file.read_bytes()
    except OSError:
        data = b""
    return np.frombuffer(data[: len(data) // 24 * 24], np.int64).reshape(-1, 3)
