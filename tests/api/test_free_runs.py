"""A session that lets its run go freely, in the thread of the program."""

from __future__ import annotations

from pathlib import Path

import pytest
from api_projects import COUNTER, dice

import neuros
from neuros.errors import RunError

LONG_S = 40.0


def test_it_ends_as_soon_as_a_node_ends_the_project(tmp_path: Path) -> None:
    with neuros.Project.from_file(dice(tmp_path)).session() as session:
        assert not session.run(duration_s=LONG_S)
        assert session.close().record["wall_s"] < LONG_S


def test_it_ends_as_soon_as_a_node_fails(tmp_path: Path) -> None:
    failing = COUNTER.replace("eyes.data == 13", "len(seen) == 3")
    with neuros.Project.from_file(dice(tmp_path, failing)).session() as session:
        with pytest.raises(RunError, match="thirteen eyes"):
            session.run(duration_s=LONG_S)
        assert session.close().record["wall_s"] < LONG_S
