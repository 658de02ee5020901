"""The program of a node process."""

from __future__ import annotations

import gc
from typing import Any

import pytest

from neuros.errors import EnvironmentFault
from neuros.node.process import NodeProcess


def test_no_garbage_is_looked_for_while_the_middleware_is_imported() -> None:
    seen: list[bool] = []

    def make_middleware(*_: Any) -> Any:
        seen.append(gc.isenabled())
        raise EnvironmentFault("there is none")

    process = NodeProcess([], make_middleware, connect=lambda: pytest.fail("nobody listens"))
    with pytest.raises(EnvironmentFault):
        process._live()
    assert (seen, gc.isenabled()) == ([False], True)
