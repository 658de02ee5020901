"""Check of a run's record: lossless connections, and the budgets of its project."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from neuros.project.model import Budgets


def losses(record: Mapping[str, Any]) -> list[str]:
    """A sentence for each lossless connection that lost packets, or may have, from ``run.json``."""
    found = []
    for connection in record["connections"]:
        lost, sent, received = (connection[key] for key in ("lost", "sent", "received"))
        if connection["discard_limit"] != 0 or lost == 0 or not _has_begun(connection, record):
            continue
        name = connection["connection"]
        if lost is not None:
            packets = "packet" if lost == 1 else "packets"
            found.append(f"{name} lost {lost} {packets}, though it is lossless (discard_limit 0)")
        else:
            found.append(f"{name} is lossless (discard_limit 0), but {_unknown(sent, received)}")
    return found


def _unknown(sent: int | None, received: int | None) -> str:
    """Say which count is missing for that of lost packets."""
    if sent is None:
        return "the number of packets that were sent is not known"
    if received is None:
        return f"it is not known how many of {sent} packets arrived"
    return "the number of packets that it lost is not known: the last report of a node is missing"


def broken_budgets(
    record: Mapping[str, Any], budgets: Budgets, *, is_partial: bool = False
) -> list[str]:
    """A sentence for each budget that a run has broken, from its ``run.json``.

    A figure that is not known breaks its budget, except where another part of the project has it
    (``is_partial``).
    """
    return [
        *_losses(record, budgets.lost_packets),
        *_slowness(record, budgets.real_time_factor, is_partial),
        *_irregularity(record, budgets.tick_error_ms),
    ]


def _losses(record: Mapping[str, Any], limits: Mapping[str, int]) -> Iterator[str]:
    for connection in record["connections"]:
        limit = limits.get(connection["connection"])
        if limit is None or not _has_begun(connection, record):
            continue
        name, lost, discarded = (connection[key] for key in ("connection", "lost", "discarded"))
        if lost is None or discarded is None:
            yield f"it is not known how many packets {name} lost; the limit is {limit}"
        elif lost + discarded > limit:
            yield (
                f"{name} lost {lost + discarded} packets ({lost} on their way,"
                f" {discarded} discarded); the limit is {limit}"
            )


def _slowness(record: Mapping[str, Any], least: float | None, is_partial: bool) -> Iterator[str]:
    factor = record["real_time_factor"]
    if least is None:
        return
    owners = [n for n, node in record["nodes"].items() if node.get("sim_time") is not None]
    if not all(_is_known(record["nodes"][name]) for name in owners):
        yield (
            f"the real-time factor must be at least {least:g}, but is not known: the last report"
            f" of {' and '.join(owners)} is missing"
        )
    elif factor is not None and factor < least:
        yield f"the real-time factor was {factor:.3g}, but must be at least {least:g}"
    elif factor is None and not is_partial:
        yield (
            f"the real-time factor must be at least {least:g}, but there was none: no node owns"
            " simulated time, or the node that does never ran a hook"
        )


def _irregularity(record: Mapping[str, Any], limit_ms: float | None) -> Iterator[str]:
    if limit_ms is None:
        return
    for node, metrics in record["nodes"].items():
        if _has_ticks(metrics) and not _is_known(metrics):
            yield (
                f"it is not known how far ticks of {node} were off their period; the limit is"
                f" {limit_ms:g} ms"
            )
            continue
        for hook, figures in (metrics.get("hooks") or {}).items():
            ticks = figures.get("ticks")
            if ticks and ticks["largest_error_ms"] > limit_ms:
                yield (
                    f"a tick of '{hook}' of {node} was off its period by"
                    f" {ticks['largest_error_ms']:.3g} ms; the limit is {limit_ms:g} ms"
                )


def _has_begun(connection: Mapping[str, Any], record: Mapping[str, Any]) -> bool:
    """Whether a packet may have been sent: not before the nodes at both ends had been loaded."""
    ends = (end.partition(".")[0] for end in connection["connection"].split(" -> "))
    here = [record["nodes"][node] for node in ends if node in record["nodes"]]
    if len(here) < 2 and not (connection["sent"] or connection["received"]):
        return False  # the node elsewhere never came, as far as is known here
    return all(node["report"] is not None for node in here)


def _is_known(node: Mapping[str, Any]) -> bool:
    """Whether the figures of a node are those of its end."""
    return bool(node.get("report") == "final")


def _has_ticks(node: Mapping[str, Any]) -> bool:
    return any(figures.get("ticks") for figures in (node.get("hooks") or {}).values())
