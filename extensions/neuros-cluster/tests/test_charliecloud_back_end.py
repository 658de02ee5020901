"""The back end ``charliecloud``: what it starts, and what it says is missing.

Its guarantees are checked with a real image, in ``integration/docker/test_charliecloud.py``.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from neuros_cluster.charliecloud import BACK_END

from neuros.cli.main import main
from neuros.distribution import PACKAGE
from neuros.doctor import checks
from neuros.ports import FindingState
from neuros.registry import BACK_ENDS

CLOCK = Path(__file__).parents[3] / "examples/1_tick/clock"
RUNNER = """#!/bin/sh
[ -z "$USER" ] && echo 'error: $USER not set' >&2 && exit 1
[ -e "$1/forbidden" ] && echo "error: can't init user+mount namespaces" >&2 && exit 1
exit 0
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an image that has a Python, and a ``ch-run`` that only looks."""
    programs = tmp_path / "bin"
    programs.mkdir()
    runner = programs / "ch-run"
    runner.write_text(RUNNER)
    runner.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/bin")
    monkeypatch.delenv("USER", raising=False)
    python = tmp_path / "images/neuros_python/opt/neuros/bin/python"
    python.parent.mkdir(parents=True)
    python.symlink_to("/usr/bin/python3")
    monkeypatch.setenv("NEUROS_IMAGE_FOLDER", str(tmp_path / "images"))
    return tmp_path / "images"


def launch(*options: str) -> int:
    return main(["launch", str(CLOCK), "--backend", "charliecloud", "--dry-run", *options])


def test_each_node_runs_in_its_image_and_sees_the_folders_of_the_run_under_their_paths(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert launch() == 0
    image = folder / "neuros_python"
    (line,) = (each for each in capsys.readouterr().out.split("\n") if "process clock: " in each)
    command = line.partition(": ")[2].split(" (log: ")[0]
    assert f"--bind={CLOCK}:{CLOCK} " in command
    assert f"--bind={PACKAGE}:/neuros/lib/neuros " in command
    assert f" {image} -- /opt/neuros/bin/python -c " in command
    assert " neuros.cli node " in command
    assert (image / "neuros/lib/neuros").is_dir()
    assert (image / CLOCK.relative_to("/")).is_dir()


def test_an_image_that_is_not_there_is_named_with_the_command_that_makes_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert launch("--set", "nodes.clock.container=neuros_nest", "--image-folder", "/none") == 4
    said = capsys.readouterr().err
    assert "no unpacked image /none/neuros_nest: ch-convert -i docker neuros_nest" in said
    assert "no unpacked image /none/neuros_python: " in said


def test_a_folder_that_is_no_image_of_ours_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "neuros_python/opt/neuros/bin/python").unlink()
    assert launch() == 4
    assert "has no /opt/neuros/bin/python" in capsys.readouterr().err


def test_a_machine_without_user_namespaces_is_told_before_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "neuros_python/forbidden").touch()
    assert launch() == 4
    said = capsys.readouterr().err
    assert "can't init user+mount namespaces: does this machine allow user namespaces?" in said


def test_the_doctor_says_which_images_there_are(folder: Path) -> None:
    environ = {"PATH": str(folder.parent / "bin"), "NEUROS_IMAGE_FOLDER": str(folder)}
    (found,) = BACK_END.checks(environ)
    assert (found.state, found.text) == (FindingState.GOOD, f"images in {folder}: neuros_python")
    (found,) = BACK_END.checks({**environ, "NEUROS_IMAGE_FOLDER": "/none"})
    assert (found.state, found.text) == (FindingState.ABSENT, "no unpacked images in /none")
    (found,) = BACK_END.checks({**environ, "PATH": "/none"})
    assert found.state is FindingState.ABSENT
    assert "Charliecloud is not installed" in found.text


def test_a_back_end_is_tried_with_the_defaults_of_its_options(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        checks, "_parts", lambda registry: ([BACK_END] if registry is BACK_ENDS else [], [])
    )
    monkeypatch.setattr("neuros_cluster.charliecloud._require_runner", lambda environ: None)
    *_, delivery = (each for each in checks.findings({}, proves=True) if each.subject == "delivery")
    assert "charliecloud: not tried" in delivery.text
    assert "images" in delivery.text
