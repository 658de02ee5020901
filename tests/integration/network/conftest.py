"""Two machines for each test of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from two_machines import TwoMachines, two_machines


@pytest.fixture
def machines() -> Iterator[TwoMachines]:
    """Joined by a cable that loses nothing and lets multicast pass."""
    with two_machines() as machines:
        yield machines
