"""Random projects in virtual time: every start and every loss is that of the naive model."""

from __future__ import annotations

import pytest

from .projects import drawn
from .virtual import differences

PROJECTS = 24


@pytest.mark.parametrize("number", range(PROJECTS))
def test_a_random_project_starts_its_hooks_when_the_model_does(number: int) -> None:
    assert [*differences(drawn(1, 500 + number)[0], number)] == []
