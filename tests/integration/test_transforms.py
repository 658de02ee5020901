"""Frames of two nodes on ``/tf`` and ``/tf_static``."""

from __future__ import annotations

from pathlib import Path

import pytest
from launching import BACKENDS, launch
from needs import COMPILER

from neuros.backends.domain import choose_domain

PROJECT = Path(__file__).parent / "transforms"


@pytest.mark.needs(*COMPILER)
@pytest.mark.parametrize("back_end", BACKENDS)
def test_a_listener_chains_what_a_broadcaster_has_sent(tmp_path: Path, back_end: str) -> None:
    with choose_domain(None, {}, False) as domain:
        run = launch(PROJECT, "--backend", back_end, "-d", str(domain.id), cwd=tmp_path)
    assert run.exit_code == 0, run.output
    assert "viewer ended the project: the camera is 0.50 m ahead, 0.25 m up" in run.output
