"""Whether a run has kept its project's budgets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from neuros.project.model import Budgets


def broken_budgets(
    record: Mapping[str, Any], budgets: Budgets, *, is_partial: bool = False
) -> list[str]:
    """A sentence for each budget that a run has broken, from its ``run.json``.

    What nobody reported breaks none: a node that was killed (the run has failed anyway), or those
    that run elsewhere (``is_partial``).
    """
    return [
        *_losses(record, budgets.lost_packets),
        *_slowness(record, budgets.real_time_factor, is_partial),
        *_irregularity(record, budgets.tick_error_ms),
    ]


def _losses(record: Mapping[str, Any], limits: Mapping[str, int]) -> Iterator[str]:
    for connection in record["connections"]:
        limit = limits.get(connection["connection"])
        lost, discarded = connection["lost"], connection["discarded"]
        if limit is None or lost is None or discarded is None or lost + discarded <= limit:
            continue
        yield (
            f"{connection['connection']} lost {lost + discarded} packets ({lost} on their way,"
            f" {discarded} discarded), allowed are {limit}"
        )


def _slowness(record: Mapping[str, Any], least: float | None, is_partial: bool) -> Iterator[str]:
    factor = record["real_time_factor"]
    if least is None:
        return
    if factor is not None and factor < least:
        yield f"the real-time factor was {factor:.3g}, and must be at least {least:g}"
    elif factor is None and not is_partial:
        yield (
            f"the real-time factor must be at least {least:g}, and there was none: no node owned"
            " simulated time, or it never began to run"
        )


def _irregularity(record: Mapping[str, Any], limit_ms: float | None) -> Iterator[str]:
    if limit_ms is None:
        return
    for node, books in record["nodes"].items():
        for hook, figures in (books.get("hooks") or {}).items():
            ticks = figures.get("ticks")
            if ticks and ticks["largest_error_ms"] > limit_ms:
                yield (
                    f"a tick of '{hook}' of {node} was off its period by"
                    f" {ticks['largest_error_ms']:.3g} ms, allowed are {limit_ms:g} ms"
                )
