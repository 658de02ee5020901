"""Examples carry the same packets in every run, on every back end, under changing load.

Strict ones do in real time, and all in virtual time.

``python -m tests.reproducibility`` runs each a hundred times.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from containers import IMAGES, require_containers

from .running import BACKENDS, STRICT, VIRTUAL, Repeated, changing_load, differing, repeat

QUICK = "2_synchronisation/tennis"


def check(project: str, backends: tuple[str, ...], runs: int, folder: Path) -> None:
    found = []
    with changing_load(seed=1):
        for backend in backends:
            (folder / backend).mkdir()
            found.append(repeat(project, backend, runs, folder / backend))
    assert [each.problems for each in found] == [[]] * len(backends)
    assert all(each.packets for each in found)
    assert differing(found) == [], [each.digests for each in found]


def test_two_runs_on_each_back_end_without_docker_carry_the_same_packets(tmp_path: Path) -> None:
    check(QUICK, BACKENDS[:2], 2, tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("project", STRICT)
def test_five_runs_on_each_back_end_carry_the_same_packets(project: str, tmp_path: Path) -> None:
    require_containers(*IMAGES)
    check(project, BACKENDS, 5, tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("project", VIRTUAL)
def test_three_runs_in_virtual_time_on_each_back_end_are_the_same(
    project: str, tmp_path: Path
) -> None:
    require_containers(*IMAGES)
    check(project, BACKENDS, 3, tmp_path)


def test_one_run_with_other_packets_is_noticed() -> None:
    same = Repeated("a", "process", digests=Counter({"1": 5}))
    other = Repeated("a", "docker", digests=Counter({"1": 4, "2": 1}))
    assert differing([same, same]) == []
    assert differing([same, other]) == ["a"]
