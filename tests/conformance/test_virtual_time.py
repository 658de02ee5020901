"""Random projects in virtual time: every start and every loss is that of the naive model."""

from __future__ import annotations

import pytest

from .projects import drawn
from .virtual import differences

PROJECTS = 24
BETWEEN_PROCESSES = 4


@pytest.mark.parametrize("number", range(PROJECTS))
def test_a_random_project_starts_its_hooks_when_the_model_does(number: int) -> None:
    assert [*differences(drawn(1, 500 + number)[0], number)] == []


@pytest.mark.parametrize("number", [13, 33])
def test_a_run_has_drained_when_packets_that_may_be_lost_have_arrived(number: int) -> None:
    project = drawn(number + 1, 4748)[number]
    assert [*differences(project, number, "process")] == []


@pytest.mark.parametrize("number", range(BETWEEN_PROCESSES))
def test_nodes_in_processes_of_their_own_do_the_same(number: int) -> None:
    assert [*differences(drawn(1, 600 + number)[0], number, "process")] == []
