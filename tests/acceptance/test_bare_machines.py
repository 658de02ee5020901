"""Both commands of README.md, whole, on a bare Debian: as an ordinary user, and as root."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from docker.errors import ImageNotFound
from needs import cannot_run

from containers import connected
from neuros.errors import EnvironmentFault

pytestmark = [pytest.mark.acceptance, pytest.mark.needs("root", "git")]

BARE = Path(__file__).resolve().parents[2] / ".ci" / "bare"
TIMEOUT_S = 3600.0


@pytest.fixture
def image() -> None:
    """Of a bare Debian."""
    try:
        with connected() as engine:
            engine.images.get("debian-python:bookworm")
    except (EnvironmentFault, ImageNotFound):
        cannot_run("a bare Debian", ".ci/docker-engine start makes it")


@pytest.mark.usefixtures("image")
@pytest.mark.parametrize("user", ["user", "root"])
def test_both_commands_succeed(user: str, tmp_path: Path) -> None:
    log = tmp_path / "log"  # it is long, and tells what goes on
    with log.open("wb") as file:
        done = subprocess.run(
            [BARE, "whole", user], stdout=file, stderr=file, timeout=TIMEOUT_S, check=False
        )
    text = log.read_text(errors="replace")
    assert done.returncode == 0, text[-5000:]
    assert "head_direction.png" in text
    assert "nothing was left behind; all passed" in text
    if user == "user":
        assert re.search(r"\d+ tests need git", text)
    else:
        assert not re.search(r"tests? needs? (git|gcc|OpenGL|Xvfb|Chromium|ip)\b", text)
