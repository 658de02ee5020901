"""A hundred random projects on the real back ends; thousands by ``python -m tests.conformance``.

Most run in process, in a session and as processes, where a run takes a second or two; containers
take longer.
A fifth of them is run each time, the others before a release. What once broke a rule is in the
folder ``kept`` and run first.
"""

from __future__ import annotations

from itertools import chain, repeat

import pytest

from containers import require_containers

from .description import Project
from .projects import drawn
from .running import LOCAL, WITHOUT_ROS
from .search import Case, kept, verdicts

SEED = 15
RUNS = {"in-process": 24, WITHOUT_ROS: 10, LOCAL: 20, "process": 42, "docker": 4}
WITHOUT_CONTAINERS = [backend for backend in RUNS if backend != "docker"]
EACH_TIME = slice(None, None, 5)
JOBS = 2


def broken(cases: list[Case]) -> list[str]:
    """What is wrong with each of the cases that break a rule."""
    return [str(verdict) for verdict in verdicts(cases, JOBS) if verdict.violations]


def cases(backend: str) -> list[Case]:
    """The projects of a back end: of a hundred, each is run on one."""
    backends = chain.from_iterable(repeat(name, count) for name, count in RUNS.items())
    return [
        Case(f"{SEED}-{number}", name, project)
        for number, (name, project) in enumerate(
            zip(backends, drawn(sum(RUNS.values()), SEED), strict=True)
        )
        if name == backend
    ]


def test_what_once_broke_a_rule_does_so_no_more():
    assert not broken(kept())


@pytest.mark.parametrize("backend", WITHOUT_CONTAINERS)
def test_random_projects_break_no_rule(backend: str):
    assert not broken(cases(backend)[EACH_TIME])


@pytest.mark.acceptance
@pytest.mark.parametrize("backend", WITHOUT_CONTAINERS)
def test_further_random_projects_break_no_rule(backend: str):
    further = cases(backend)
    del further[EACH_TIME]
    assert not broken(further)


def test_nor_do_they_in_containers():
    require_containers()
    assert not broken(cases("docker"))


def test_a_description_survives_being_kept():
    for project in drawn(20, SEED):
        assert Project.from_json(project.to_json()) == project
