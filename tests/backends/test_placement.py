"""Who gets which cores, and what a process really has."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.backends.guardian import Guardian
from neuros.backends.node_command import (
    THREAD_VARIABLES,
    NodeProcess,
    place,
    thread_limits,
    usable_cores,
)
from neuros.backends.process_launchers import RunningProcess
from neuros.errors import EnvironmentFault
from neuros.project.model import Node


def node(name: str, *affinity: int) -> Node:
    return Node(name, "neuros_python", Path("plugin.py"), affinity=affinity)


@given(st.lists(st.sets(st.integers(0, 40), max_size=3), min_size=1, max_size=8))
def test_a_node_has_the_cores_that_it_asks_for_and_the_kernel_places_the_others(
    asked: list[set[int]],
) -> None:
    nodes = [node(f"node{number}", *cores) for number, cores in enumerate(asked)]
    assert place(nodes) == {
        f"node{number}": tuple(sorted(cores)) for number, cores in enumerate(asked) if cores
    }


def test_thread_pools_have_as_many_threads_as_the_node_asks_for_cores() -> None:
    assert thread_limits([node("a")]) == {}
    assert thread_limits([node("a", 1, 2)]) == dict.fromkeys(THREAD_VARIABLES, "2")
    assert thread_limits([node("a", 1, 2), node("b", 0), node("c")])["OMP_NUM_THREADS"] == "2"


# ------------------------------------------------------------------ processes
@pytest.fixture
def guardian() -> Iterator[Guardian]:
    guardian = Guardian.start(secrets.token_hex(8))
    yield guardian
    guardian.finish()


def _mask_of(tmp_path: Path, cores: tuple[int, ...], guardian: Guardian) -> set[int]:
    program = "import json, os; print(json.dumps(sorted(os.sched_getaffinity(0))))"
    log = tmp_path / "log"
    log.unlink(missing_ok=True)
    command = ["python3", "-S", "-c", program]
    process = NodeProcess(("a",), command, command, os.environ, log, tmp_path, cores)
    host = RunningProcess(process, guardian)
    assert host.wait(10) == "exit code 0"
    return set(json.loads(log.read_text()))


def test_a_process_has_its_cores_and_the_next_one_all(tmp_path: Path, guardian: Guardian) -> None:
    before = usable_cores()
    for core in before:
        assert _mask_of(tmp_path, (core,), guardian) == {core}
    assert _mask_of(tmp_path, (), guardian) == before
    assert usable_cores() == before


def test_a_core_that_is_not_there_is_a_fault_of_the_machine(
    tmp_path: Path, guardian: Guardian
) -> None:
    before = usable_cores()
    with pytest.raises(EnvironmentFault, match="cannot start the process of a: "):
        _mask_of(tmp_path, (max(before) + 1000,), guardian)
    assert _mask_of(tmp_path, (), guardian) == before
