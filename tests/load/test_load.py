"""Lossless connections lose nothing under load.

``python -m tests.load`` sends a million packets in each run.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest

from containers import require_containers

from .running import (
    BACKENDS,
    Load,
    count_problems,
    judge_memory,
    latency,
    latency_problems,
    run,
    while_all_live,
)
from .shapes import LARGEST_BYTES, SHAPES, Shape

_PACKETS = 3000


# Each shape and each back end once.
_SHORT = {("ring", "docker"), ("1-to-16", "in-process"), ("16-to-1", "process")}
_ROUND = [
    pytest.param(*cell, marks=[] if cell in _SHORT else [pytest.mark.acceptance])
    for cell in itertools.product(SHAPES, BACKENDS)
]


@pytest.mark.parametrize(("shape", "backend"), _ROUND)
def test_no_packet_is_lost_or_changed(shape: str, backend: str, tmp_path: Path) -> None:
    if backend == "docker":
        require_containers()
    load = run(shape, backend, _PACKETS, tmp_path, largest=LARGEST_BYTES)
    assert load.problems == []
    assert load.lossless >= 0.99 * _PACKETS


PAIR = Shape({"a": "source", "b": "sink"}, [("a", "b", 0, 1)])


def found(limit: int, lost: int = 0, **of_b: int) -> list[str]:
    """What is wrong where ``a`` has sent 5 packets and ``b`` notes this."""
    noted = {"count": 5, "chain": 77, "skipped": 0, **of_b}
    told: dict[str, Any] = {"a": {"sent": {"chain": 77}}, "b": {"sources": {"a": noted}}}
    shape = Shape(PAIR.plugins, [("a", "b", limit, 1)])
    return list(count_problems(shape, 5, told, [{"connection": "a.o -> b.x", "lost": lost}]))


def test_what_is_lost_or_changed_is_noticed() -> None:
    assert found(0) == []
    assert "4 of 5 packets" in found(0, count=4)[0]
    assert "hashes" in found(0, chain=78)[0]
    assert "1 lost" in found(0, lost=1)[0]
    assert found(3, skipped=3, count=2) == []
    assert "4 lost in a row" in found(3, skipped=4)[0]


def test_what_grows_is_noticed() -> None:
    flat, larger, short = (Load("ring", "process", lossless=n) for n in (10**6, 10**6, 10**5))
    judge_memory(flat, [10_000_000] * 200, processes=5)
    for load in (larger, short):
        judge_memory(load, [10_000_000 + 200_000 * n for n in range(200)], processes=5)
    assert flat.problems == short.problems == []
    assert larger.problems[0].startswith("memory grew from ")
    judge_memory(short, [10_000_000 + 1_000_000 * n for n in range(200)], processes=5)
    assert short.problems[0].startswith("memory grew from ")
    grown = Load("1-to-16", "process", lossless=10**6)
    judge_memory(grown, [600_000_000] * 30 + [730_000_000] * 170, processes=17)  # to its size
    assert grown.problems == []
    waiting = [*[220_000_000] * 8, *[340_000_000] * 12]  # 16 of the largest, at times
    judge_memory(grown, [*[340_000_000] * 10, *[220_000_000] * 190, *waiting], processes=17)
    assert grown.problems == []
    assert list(latency_problems(latency([[1.0] * 500]))) == []
    slower = latency([[1.0] * 250 + [5.0] * 250])
    assert list(latency_problems(slower)) == ["latency grew from 1.00 to 5.00 ms"]


def test_memory_is_that_of_moments_at_which_all_nodes_live() -> None:
    starting, running, removed = [(1, 30), (9, 400)], [(18, 700)] * 20, [(2, 50)] * 9
    assert while_all_live([*starting, *running, *removed]) == [700] * 20
    assert while_all_live([]) == []
