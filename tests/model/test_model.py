"""Every order of events in small projects: the rules of packets and ends hold in each of them."""

from __future__ import annotations

import pytest

from .mutants import MUTANTS, Mutant
from .projects import projects
from .search import search, told
from .world import Project

PROJECTS = {project.name: project for project in projects()}
SMALL = 1_000
"""More states take minutes: those projects are searched by ``python -m tests.model``."""


def held(project: Project, most_states: int) -> bool:
    found = search(project, most_states)
    assert not found.broken, f"{found.broken}:\n{told(found.trace)}"
    return found.is_complete


@pytest.mark.parametrize(
    "name", [name for name in PROJECTS if "ended" not in name and "dies" not in name]
)
def test_whatever_comes_first_no_rule_is_broken_and_the_last_packet_arrives(name: str) -> None:
    assert held(PROJECTS[name], SMALL)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.rule)
def test_a_rule_that_does_not_hold_is_noticed(mutant: Mutant) -> None:
    with mutant.apply():
        assert search(PROJECTS[mutant.project], 20 * SMALL).broken
