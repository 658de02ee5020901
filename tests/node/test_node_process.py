"""The program of a node process."""

from __future__ import annotations

import gc
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuros.errors import EnvironmentFault
from neuros.node.process import NodeProcess


def test_no_garbage_is_looked_for_while_the_middleware_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[bool] = []

    def make_middleware(*_: Any) -> Any:
        seen.append(gc.isenabled())
        raise EnvironmentFault("there is none")

    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    file: Any = SimpleNamespace(
        folders=SimpleNamespace(run=tmp_path), node=SimpleNamespace(name="a", plugin=Path("a.py"))
    )
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert NodeProcess([file], make_middleware, lambda: ours).run() == 1
    assert (seen, gc.isenabled()) == ([False], True)
