"""Every order of events in small projects: the rules of packets and ends hold in each of them."""

from __future__ import annotations

import pytest

from .mutants import MUTANTS, Mutant
from .projects import projects
from .search import search, told
from .world import Project

PROJECTS = {project.name: project for project in projects()}
SMALL = 2_000
"""More states take minutes: those of projects that end, or in which a node dies."""
LARGE = 100_000
ENDING = [name for name in PROJECTS if "ended" in name or "dies" in name]


def held(project: Project, most_states: int) -> bool:
    found = search(project, most_states)
    assert not found.broken, f"{found.broken}:\n{told(found.trace)}"
    return found.is_complete


@pytest.mark.parametrize("name", [name for name in PROJECTS if name not in ENDING])
def test_whatever_comes_first_no_rule_is_broken_and_the_last_packet_arrives(name: str) -> None:
    assert held(PROJECTS[name], SMALL)


@pytest.mark.acceptance
@pytest.mark.parametrize("name", ENDING)
def test_whatever_comes_first_a_project_that_is_ended_comes_to_its_end(name: str) -> None:
    assert held(PROJECTS[name], LARGE)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.rule)
def test_a_rule_that_does_not_hold_is_noticed(mutant: Mutant) -> None:
    with mutant.apply():
        assert search(PROJECTS[mutant.project], 20 * SMALL).broken
