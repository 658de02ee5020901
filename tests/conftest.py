"""For all tests: where they run, and that none leaves anything in the environment for the next.

A run is on the back end that a test names, else on that of processes. What ``auto`` would choose
depends on the machine: it has tests of its own, which name it.
"""

import os
from collections.abc import Iterator

import pytest

os.environ.setdefault("NEUROS_BACKEND", "process")


@pytest.fixture(autouse=True)
def environment_as_found() -> Iterator[None]:
    """What ROS nodes, simulators and kernels of the test's own process set is not inherited."""
    found = dict(os.environ)
    yield
    if dict(os.environ) != found:
        os.environ.clear()
        os.environ.update(found)
