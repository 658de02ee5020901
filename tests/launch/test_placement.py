"""Who gets which cores: decided from the project alone, and what a process really has."""

from __future__ import annotations

import json
import os
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.errors import EnvironmentFault
from neuros.launch.affinity import children_on, usable_cores
from neuros.launch.host import HostProcess
from neuros.launch.placement import THREAD_VARIABLES, place, thread_limits
from neuros.project.model import Node, Port

CAMERA = Port("image", "sensor_msgs/msg/Image", mujoco={"sensor": "camera", "element": "eye"})


def node(name: str, *affinity: int, outputs: tuple[Port, ...] = (), **environment: str) -> Node:
    return Node(
        name,
        "neuros_python",
        Path("plugin.py"),
        outputs=outputs,
        environment=environment,
        affinity=affinity,
    )


# ------------------------------------------------------------------ the pure function
@st.composite
def machines(draw: st.DrawFn) -> tuple[list[Node], set[int]]:
    cores = draw(st.sets(st.integers(0, 40), min_size=1, max_size=12))
    count = draw(st.integers(1, 8))
    nodes = []
    for i in range(count):
        asks = draw(st.sets(st.sampled_from(sorted(cores)), max_size=2))
        threads = draw(st.sampled_from([{}, {}, {"OMP_NUM_THREADS": "2"}]))
        nodes.append(node(f"node{i}", *asks, **threads))
    return nodes, cores


@given(machines())
def test_a_node_with_affinity_has_exactly_that(machine: tuple[list[Node], set[int]]) -> None:
    nodes, cores = machine
    chosen = place(nodes, cores)
    for each in nodes:
        if each.affinity:
            assert chosen[each.name] == tuple(sorted(each.affinity))


@given(machines())
def test_no_other_node_shares_a_core_or_leaves_those_that_may_be_used(
    machine: tuple[list[Node], set[int]],
) -> None:
    nodes, cores = machine
    chosen = place(nodes, cores)
    assert all(set(each) <= cores for each in chosen.values())
    for a, b in combinations(nodes, 2):
        if {a.name, b.name} <= set(chosen) and not (a.affinity and b.affinity):
            assert not set(chosen[a.name]) & set(chosen[b.name])


@given(machines())
def test_where_every_thread_can_have_a_core_all_are_placed_and_no_core_is_left_over(
    machine: tuple[list[Node], set[int]],
) -> None:
    nodes, cores = machine
    chosen = place(nodes, cores)
    others = [each for each in nodes if not each.affinity]
    threads = {each.name: int(each.environment.get("OMP_NUM_THREADS", "1")) for each in others}
    free = cores.difference(*(each.affinity for each in nodes))
    if others and sum(threads.values()) <= len(free):
        assert {core for each in others for core in chosen[each.name]} == free
        assert all(len(chosen[name]) >= count for name, count in threads.items())
    else:
        assert not any(each.name in chosen for each in others), "left to the kernel"


@given(machines())
def test_the_answer_is_the_same_every_time(machine: tuple[list[Node], set[int]]) -> None:
    nodes, cores = machine
    assert place(nodes, cores) == place(nodes, sorted(cores, reverse=True))


def test_two_nodes_divide_a_machine_and_three_on_two_cores_do_not() -> None:
    ping, echo, third = node("ping"), node("echo"), node("third")
    assert place([ping, echo], {0, 1}) == {"ping": (0,), "echo": (1,)}
    assert place([ping, echo], range(5)) == {"ping": (0, 1), "echo": (2, 3, 4)}
    assert place([ping, echo, third], {0, 1}) == {}
    assert place([ping, node("echo", 0)], {0, 1}) == {"echo": (0,), "ping": (1,)}


@given(machines(), st.integers(0, 100))
def test_where_the_count_begins_changes_who_has_which_cores_and_nothing_else(
    machine: tuple[list[Node], set[int]], begin: int
) -> None:
    nodes, cores = machine
    here, there = place(nodes, cores), place(nodes, cores, begin=begin)
    assert {name: len(each) for name, each in here.items()} == {
        name: len(each) for name, each in there.items()
    }
    assert all(list(each) == sorted(each) for each in there.values())
    assert all(there[node.name] == here[node.name] for node in nodes if node.affinity)
    assert {core for each in there.values() for core in each} == {
        core for each in here.values() for core in each
    }


def test_the_first_nodes_of_two_runs_have_different_cores() -> None:
    nodes = [node("ping"), node("echo")]
    assert place(nodes, {0, 1}, begin=1) == {"ping": (1,), "echo": (0,)}
    assert place(nodes, range(4), begin=1) == {"ping": (1, 2), "echo": (0, 3)}
    assert place(nodes, range(4), begin=4) == place(nodes, range(4))


def test_a_node_with_threads_is_counted_with_all_of_them() -> None:
    nodes = [node("net", OMP_NUM_THREADS="3"), node("robot")]
    assert place(nodes, range(4)) == {"net": (0, 1, 2), "robot": (3,)}
    assert place(nodes, range(3)) == {}
    assert place([node("a"), node("b")], range(2), {"OMP_NUM_THREADS": "4"}) == {}


def test_next_to_a_camera_which_may_take_every_core_nothing_is_spread() -> None:
    assert place([node("robot", outputs=(CAMERA,)), node("brain")], range(8)) == {}
    assert place([node("robot", 0, outputs=(CAMERA,)), node("brain")], {0, 1}) == {
        "robot": (0,),
        "brain": (1,),
    }


def test_thread_pools_have_as_many_threads_as_the_node_asks_for_cores() -> None:
    assert thread_limits([node("a")]) == {}
    assert thread_limits([node("a", 1, 2)]) == dict.fromkeys(THREAD_VARIABLES, "2")
    assert thread_limits([node("a", 1, 2), node("b", 0), node("c")])["OMP_NUM_THREADS"] == "2"


# ------------------------------------------------------------------ processes
def _mask_of(tmp_path: Path, cores: tuple[int, ...] | None) -> set[int]:
    program = "import json, os; print(json.dumps(sorted(os.sched_getaffinity(0))))"
    log = tmp_path / "log"
    log.unlink(missing_ok=True)
    host = HostProcess(
        ["a"],
        ["python3", "-S", "-c", program],
        log=log,
        folder=tmp_path,
        environment=os.environ,
        cores=cores,
    )
    assert host.wait(10) == "exit code 0"
    return set(json.loads(log.read_text()))


def test_a_process_has_its_cores_and_the_launcher_keeps_its_own(tmp_path: Path) -> None:
    before = usable_cores()
    for core in before:
        assert _mask_of(tmp_path, (core,)) == {core}
    assert _mask_of(tmp_path, None) == before
    assert usable_cores() == before


def test_a_core_that_is_not_there_is_a_fault_of_the_machine(tmp_path: Path) -> None:
    before = usable_cores()
    with pytest.raises(EnvironmentFault, match="cannot start the process of a: "):
        _mask_of(tmp_path, (max(before) + 1000,))
    assert usable_cores() == before


def test_cores_are_given_back_after_an_error() -> None:
    before = usable_cores()
    with pytest.raises(KeyError), children_on([min(before)]):
        raise KeyError
    assert usable_cores() == before
