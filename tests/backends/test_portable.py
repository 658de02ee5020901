"""What a portable run sets in the environment of its nodes."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.backends.node_command import THREAD_VARIABLES
from neuros.backends.portable import (
    TUNABLES,
    check_this_process,
    common_variables,
    portable_project,
    portable_variables,
)
from neuros.errors import UsageError
from neuros.project.model import Node, Project

HWCAPS = "glibc.cpu.hwcaps="
OURS = portable_variables({})[TUNABLES].removeprefix(HWCAPS)


def project(affinity: tuple[int, ...] = (), **environment: str) -> Project:
    node = Node("n", "neuros_python", Path("p.py"), environment=environment, affinity=affinity)
    return Project("p", (node,), (), Path("project.json"))


def variables(of: Project, **shell: str) -> dict[str, str]:
    made = portable_project(of, shell)
    assert made.is_portable
    return dict(made.nodes[0].environment)


def test_fma_is_off_for_glibc() -> None:
    assert {"-FMA", "-FMA4", "-AVX2"} < {*OURS.split(",")}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("", f"{HWCAPS}{OURS}"),
        ("glibc.malloc.check=1", f"glibc.malloc.check=1:{HWCAPS}{OURS}"),
        (f"{HWCAPS}-AVX2,-FMA", f"{HWCAPS}{OURS}"),
        (f"{HWCAPS}-AVX2,FMA", f"{HWCAPS}{OURS}"),  # switched on
        (f"{HWCAPS}-SSE4_1,-FMA:glibc.malloc.check=1",
         f"glibc.malloc.check=1:{HWCAPS}-SSE4_1,{OURS}"),
        (f"{HWCAPS}-SSE4_1:{HWCAPS}-ERMS", f"{HWCAPS}-SSE4_1,-ERMS,{OURS}"),
        ("nonsense::", f"nonsense:{HWCAPS}{OURS}"),
    ],
)  # fmt: skip
def test_tunables_of_the_user_stay_but_for_the_features(given: str, expected: str) -> None:
    assert portable_variables({TUNABLES: given})[TUNABLES] == expected
    assert variables(project(), **{TUNABLES: given})[TUNABLES] == expected
    assert variables(project(**{TUNABLES: given}))[TUNABLES] == expected


@given(st.text("=:,-AFM", max_size=30))
def test_to_set_them_twice_is_to_set_them_once(given: str) -> None:
    once = portable_variables({TUNABLES: given})
    assert portable_variables(once) == once
    assert once[TUNABLES].endswith(OURS)


@pytest.mark.parametrize("place", ["shell", "project"])
@pytest.mark.parametrize(
    "name", ["OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES", "MKL_CBWR"]
)
def test_what_shell_and_project_choose_is_replaced(name: str, place: str) -> None:
    other = {name: "Haswell"}
    found = variables(project(**other if place == "project" else {}), **other)
    assert found[name] == portable_variables({})[name] != "Haswell"


def test_other_variables_of_the_project_stay_and_those_of_the_shell_are_not_taken_over() -> None:
    found = variables(project(SEED="7"), HOME="/home/me")
    assert found["SEED"] == "7"
    assert "HOME" not in found


@pytest.mark.parametrize(
    ("affinity", "own", "expected"),
    [((), {}, "1"), ((2, 3), {}, "2"), ((2, 3), {"OMP_NUM_THREADS": "4"}, "4")],
)
def test_the_project_says_the_number_of_threads_and_not_the_shell(
    affinity: tuple[int, ...], own: dict[str, str], expected: str
) -> None:
    found = variables(project(affinity, **own), OMP_NUM_THREADS="8")
    assert found["OMP_NUM_THREADS"] == expected
    assert found["OPENBLAS_NUM_THREADS"] == str(len(affinity) or 1)


def test_one_process_has_the_threads_of_the_widest_of_its_nodes() -> None:
    nodes = [*project((0,)).nodes, *project((0, 1)).nodes]
    found = common_variables(nodes, {})
    assert {found[name] for name in THREAD_VARIABLES} == {"2"}


def test_a_python_that_was_started_otherwise_is_refused_whatever_it_has_set_since(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in common_variables((), {}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(UsageError, match=r"this Python was started without .*OPENBLAS_CORETYPE"):
        check_this_process(())
