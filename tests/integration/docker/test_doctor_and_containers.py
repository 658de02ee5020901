"""The doctor, where there is an engine: versions, images, and packets between two containers."""

from __future__ import annotations

import os

import pytest

from containers import require_containers
from neuros.backends.docker.back_end import check_containers
from neuros.cli.main import main
from neuros.doctor.checks import prove_delivery
from neuros.ports import FindingState


@pytest.fixture(autouse=True)
def _with_containers() -> None:
    require_containers()


def test_engine_and_images_are_named_with_their_versions() -> None:
    engine, image, missing = check_containers(["neuros_python", "no_such_image"], os.environ)
    assert engine.state is image.state is FindingState.GOOD
    assert engine.text.startswith("engine ")
    assert image.text.startswith("neuros_python:")
    assert missing.state is FindingState.ABSENT
    assert "'no_such_image'" in missing.text


def test_images_pass_from_container_to_container() -> None:
    finding = prove_delivery("docker")
    assert finding.state is FindingState.GOOD, finding
    assert "docker: packets arrived: 20 of 20 on camera.image -> eye.image" in finding.text


def test_an_image_that_is_to_be_removed_and_is_not_there_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["containers", "remove", "neuros_pithon"]) == 2
    assert capsys.readouterr().err == (
        "neuros: NeuROS has built no image for 'neuros_pithon' (did you mean 'neuros_python'?):"
        " nothing was removed; `neuros containers list` shows what there is\n"
    )
