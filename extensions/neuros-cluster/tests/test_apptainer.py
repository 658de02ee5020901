"""The back end ``apptainer``: what it starts, and what it says is missing.

A program stands in for ``apptainer``, which could not be installed where this was written: it
checks and records its arguments, and starts the command with this Python in place of the image's.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from launching import launch as run
from neuros_cluster.apptainer import BACK_END

from neuros.cli.main import main
from neuros.distribution import PACKAGE
from neuros.doctor import checks
from neuros.ports import FindingState
from neuros.registry import BACK_ENDS

EXAMPLES = Path(__file__).parents[3] / "examples"
CLOCK, TENNIS = EXAMPLES / "1_tick/clock", EXAMPLES / "2_synchronisation/tennis"
# https://apptainer.org/docs/user/main/cli/apptainer_exec.html
APPTAINER = f"""#!{sys.executable} -I
import argparse, json, os, pathlib, sys
parser = argparse.ArgumentParser(allow_abbrev=False)
parser.add_argument("--quiet", action="store_true")
parser.add_argument("exec", choices=["exec"])
for flag in ("--no-home", "--nv"):
    parser.add_argument(flag, action="store_true")
parser.add_argument("--no-mount", choices=["cwd"])
parser.add_argument("--pwd", default="/")
parser.add_argument("--bind", action="append", default=[])
parser.add_argument("image", type=pathlib.Path)
parser.add_argument("command", nargs=argparse.REMAINDER)
given = parser.parse_args()
if given.image.read_text() != "image":
    sys.exit("FATAL: could not open image " + str(given.image))
with open(given.image.parent / "started", "a") as log:
    print(json.dumps(sys.argv[1:]), file=log)
libraries = [each.split(":")[0] for each in given.bind if ":/neuros/lib/" in each]
places = os.pathsep.join({{os.path.dirname(each) for each in libraries}})
command = [
    word.replace("/opt/neuros/bin/python", "{sys.executable}").replace("/neuros/lib", places)
    for word in given.command
]
os.chdir(given.pwd)
os.environ["HOME"] = "/root"  # as Apptainer does
os.execvp(command[0], command)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an image, and the program that stands in for Apptainer."""
    programs = tmp_path / "bin"
    programs.mkdir()
    runner = programs / "apptainer"
    runner.write_text(APPTAINER)
    runner.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    (tmp_path / "images").mkdir()
    (tmp_path / "images/neuros_python.sif").write_text("image")
    monkeypatch.setenv("NEUROS_IMAGE_FOLDER", str(tmp_path / "images"))
    return tmp_path / "images"


def launch(*options: str) -> int:
    return main(["launch", str(CLOCK), "--backend", "apptainer", "--dry-run", *options])


def test_each_node_runs_in_its_image_and_sees_the_folders_of_the_run_under_their_paths(
    folder: Path, tmp_path: Path
) -> None:
    finished = run(TENNIS, "--backend", "apptainer", cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    assert sum(each["consumed"] for each in finished.record["connections"]) == 10
    image = folder / "neuros_python.sif"
    assert finished.record["apptainer"] == {"neuros_python": str(image)}
    rows = [json.loads(row) for row in (folder / "started").read_text().splitlines()]
    command = rows[-1]
    options, inside = command[: command.index(str(image))], command[command.index(str(image)) :]
    assert options[:4] == ["--quiet", "exec", "--no-home", "--no-mount=cwd"]
    assert {f"--bind={TENNIS}:{TENNIS}", f"--bind={PACKAGE}:/neuros/lib/neuros"} < {*options}
    assert f"--bind={finished.run_folder}:{finished.run_folder}" in options
    assert "--nv" not in options
    assert inside[1:3] == ["/usr/bin/env", "HOME=/tmp"]
    assert "/opt/neuros/bin/python" in inside


def test_a_node_that_asks_for_gpus_gets_those_of_nvidia(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert launch("--set", 'nodes.clock.gpus=["all"]') == 0
    (line,) = (each for each in capsys.readouterr().out.split("\n") if "process clock: " in each)
    assert " --nv " in line


def test_an_image_that_is_not_there_is_named_with_the_command_that_makes_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert launch("--set", "nodes.clock.container=neuros_nest", "--image-folder", "/none") == 4
    said = capsys.readouterr().err
    assert "no image /none/neuros_nest.sif: apptainer build /none/neuros_nest.sif" in said
    assert " docker-daemon:neuros_nest:latest" in said
    assert "no image /none/neuros_python.sif: " in said


def test_an_image_in_which_nothing_starts_is_told_before_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "neuros_python.sif").write_text("another file")
    assert launch() == 4
    said = capsys.readouterr().err
    assert "has no /opt/neuros/bin/python that starts: FATAL: could not open image" in said
    assert "does this machine allow user namespaces" in said


def test_the_doctor_says_which_images_there_are(folder: Path) -> None:
    environ = {"PATH": str(folder.parent / "bin"), "NEUROS_IMAGE_FOLDER": str(folder)}
    (found,) = BACK_END.checks(environ)
    assert (found.state, found.text) == (FindingState.GOOD, f"images in {folder}: neuros_python")
    (found,) = BACK_END.checks({**environ, "NEUROS_IMAGE_FOLDER": "/none"})
    assert (found.state, found.text) == (FindingState.ABSENT, "no images in /none")
    (found,) = BACK_END.checks({**environ, "PATH": "/none"})
    assert found.state is FindingState.ABSENT
    assert "Apptainer is not installed" in found.text


def test_a_back_end_is_tried_with_the_defaults_of_its_options(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        checks, "_parts", lambda registry: ([BACK_END] if registry is BACK_ENDS else [], [])
    )
    monkeypatch.setattr("neuros_cluster.apptainer._require_runner", lambda environ: None)
    *_, delivery = (each for each in checks.findings({}, proves=True) if each.subject == "delivery")
    assert "apptainer: not tried" in delivery.text
    assert "image" in delivery.text
