"""The doctor's proof that packets arrive: with real nodes, and with nodes that fail."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from neuros.cli.main import main
from neuros.doctor.checks import PROJECT, prove_delivery
from neuros.ports import FindingState


@pytest.mark.parametrize("backend", ["process", "in-process"])
def test_images_arrive_and_what_was_read_in_them_comes_back(backend: str) -> None:
    finding = prove_delivery(backend)
    assert finding.state is FindingState.GOOD, finding
    assert "20 of 20 on camera.image -> eye.image" in finding.text
    assert "20 of 20 on eye.seen -> camera.seen" in finding.text


def test_what_arrives_damaged_is_a_problem_and_the_reason_is_shown(tmp_path: Path) -> None:
    project = tmp_path / "delivery"
    shutil.copytree(PROJECT, project)
    eye = project / "eye.py"
    eye.write_text(eye.read_text().replace("sum(image.data)", "sum(image.data) - 1"))
    finding = prove_delivery("in-process", project)
    assert finding.state is FindingState.BAD
    assert "arrived with the sum 921599" in finding.remedy


def test_a_project_that_cannot_start_is_a_problem(tmp_path: Path) -> None:
    finding = prove_delivery("in-process", tmp_path / "none")
    assert finding.state is FindingState.BAD
    assert finding.remedy


def test_the_command_ends_with_0_where_nothing_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--no-delivery"]) == 0
    assert capsys.readouterr().out.startswith("ok       Python")


def test_the_command_ends_with_4_where_something_is_wrong(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    assert main(["doctor", "--no-delivery"]) == 4
    assert "PROBLEM  domain" in capsys.readouterr().out
