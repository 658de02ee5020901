"""The back end ``charliecloud`` gives the guarantees of all back ends, in an image of Docker's."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from back_end_checks import BackEndChecks, Launched
from needs import require

from containers import require_containers

pytestmark = pytest.mark.acceptance
_CONVERTED_S = 1200.0


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the image of the recipe, unpacked: yours, or made for these tests."""
    if given := os.environ.get("NEUROS_IMAGE_FOLDER"):
        return Path(given)
    require("ch-run", "ch-convert", "docker")
    require_containers("neuros_python")
    folder = tmp_path_factory.mktemp("images")
    subprocess.run(
        ["ch-convert", "-i", "docker", "neuros_python", str(folder / "neuros_python")],
        env={"USER": "root", **os.environ},
        timeout=_CONVERTED_S,
        check=True,
    )
    return folder


@pytest.fixture(autouse=True)
def unpacked(images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NEUROS_IMAGE_FOLDER", str(images))


class TestCharliecloud(BackEndChecks):
    back_end = "charliecloud"

    def test_its_image_is_told_in_the_record(
        self, run: Callable[..., Launched], images: Path
    ) -> None:
        launched = run("pipeline")
        assert launched.record["charliecloud"] == {"neuros_python": str(images / "neuros_python")}
