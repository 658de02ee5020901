"""What the packets of a run say: how many arrived, and how fast simulated time went."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.reproduce.load import load_between
from neuros.api.run_record import PastRun


def packet_figures(past: PastRun, connections: Mapping[str, str]) -> dict[str, float | None]:
    """Packets sent and consumed (a hook started on them), by connection and in all.

    Args:
        connections: what they are called in the figures, by their names.
    """
    figures: dict[str, float | None] = {}
    whole = dict.fromkeys(("sent", "consumed"), 0)
    for name, short in connections.items():
        counts = past.connections[name]
        sent, consumed = counts["sent"] or 0, counts["consumed"] or 0
        figures |= {f"sent.{short}": sent, f"consumed.{short}": consumed}
        figures[f"consumed_percent.{short}"] = _percent(consumed, sent)
        whole["sent"] += sent
        whole["consumed"] += consumed
    figures |= whole
    return {**figures, "consumed_percent": _percent(whole["consumed"], whole["sent"])}


def _percent(part: float, whole: float) -> float | None:
    return 100 * part / whole if whole else None


def after_the_start(sent_ns: Any) -> Any:
    """When the last nine tenths of the packets of a sensor were sent, (n,).

    In the first tenth the simulator may wait for nodes that are starting.
    """
    return sent_ns[len(sent_ns) // 10 :]


def speed_percent(sent_ns: Any, period_s: float) -> float | None:
    """Simulated time in per cent of wall time, from a sensor that fires every ``period_s``."""
    if len(sent_ns) < 2:
        return None
    return float(100 * (len(sent_ns) - 1) * period_s * 1e9 / (sent_ns[-1] - sent_ns[0]))


def load_meanwhile(
    run_folder: Path, sent_ns: Any, unix_minus_monotonic_s: float
) -> dict[str, float]:
    """The load from the first of these packets to the last one."""
    if not len(sent_ns):
        return {}
    first, last = (float(ns) * 1e-9 + unix_minus_monotonic_s for ns in sent_ns[[0, -1]])
    return load_between(run_folder, first, last)
