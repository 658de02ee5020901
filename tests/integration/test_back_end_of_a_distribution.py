"""A back end and a viewer from another distribution: found by name, and as good as ours."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from back_end_checks import COUNT, PROJECTS, BackEndChecks, finish, launcher
from distributions import install, path_with

CLOCK = Path(__file__).parents[2] / "examples/1_tick/clock"


@pytest.fixture(autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which Python finds the distribution, for programs that are started."""
    site = tmp_path_factory.mktemp("site")
    monkeypatch.setenv("PYTHONPATH", path_with(site, "neuros_nice"))
    return site


@pytest.mark.acceptance
class TestNice(BackEndChecks):
    back_end = "nice"
    options = ("--nice-level", "3")


def test_its_options_its_notices_and_its_record_are_those_of_the_run(tmp_path: Path) -> None:
    options = ("--backend", "nice", "--nice-level", "3")
    launched = finish(launcher(PROJECTS / "pipeline", tmp_path / "run", *options), tmp_path / "run")
    assert launched.exit_code == 0, launched.output
    assert "nodes have the nice level 3" in launched.output
    assert launched.record["nice"] == {"level": 3}
    assert launched.counts("relay.number -> sink.number", "sent", "consumed") == [COUNT] * 2


def neuros(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "neuros.cli", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
    )


def test_help_names_it_and_its_options() -> None:
    shown = " ".join(neuros("launch", "--help").stdout.split())
    assert "back end nice: each node in a process of low priority" in shown
    assert "--nice-level LEVEL how much lower, 1 to 19 (default: 10)" in shown


def test_the_doctor_looks_at_what_it_needs() -> None:
    assert "ok       nice " in neuros("doctor", "--no-delivery").stdout


def test_another_back_end_does_not_take_its_options() -> None:
    refused = neuros("launch", str(CLOCK), "--backend", "process", "--nice-level", "3")
    assert refused.returncode == 2
    assert "unrecognized arguments: --nice-level 3" in refused.stderr


def test_a_name_that_is_none_is_refused_with_all_that_there_are() -> None:
    refused = neuros("launch", str(CLOCK), "--backend", "nic")
    assert refused.returncode == 2
    assert refused.stderr == (
        "neuros: back end 'nic': choose one of auto, docker, process, in-process, nice,"
        " apptainer (did you mean 'nice'?)\n"
    )


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("no_such_module:BACK_END", "cannot be loaded: ModuleNotFoundError"),
        ("neuros_nice:NO_SUCH_NAME", "cannot be loaded: AttributeError"),
        ("neuros_nice:Nice", "is not a BackEnd, but <class 'neuros_nice.Nice'>"),
        ("neuros_nice:BACK_END", "calls itself 'nice'"),
    ],
)
def test_what_is_broken_is_named_with_its_distribution(
    installed: Path, value: str, why: str
) -> None:
    install(installed, "bad", {"neuros.backends": {"x": value}})
    refused = neuros("launch", str(CLOCK), "--backend", "x")
    assert refused.returncode == 4
    assert f"back end 'x' of the distribution bad ({value}) {why}" in refused.stderr
    assert "pip uninstall bad" in refused.stderr


def test_auto_passes_over_what_is_broken_and_says_so(installed: Path, tmp_path: Path) -> None:
    install(installed, "bad", {"neuros.backends": {"x": "no:X"}})
    folder = tmp_path / "run"
    described = finish(launcher(CLOCK, folder, "--backend", "auto", "--dry-run"), folder)
    assert described.exit_code == 0, described.output
    assert "back end 'x' of the distribution bad (no:X) cannot be loaded" in described.output


def test_a_name_that_two_distributions_have_is_refused(installed: Path) -> None:
    install(installed, "twin", {"neuros.backends": {"process": "twin:X"}})
    refused = neuros("launch", str(CLOCK), "--backend", "auto")
    assert refused.returncode == 4
    assert "both neuros and twin have a back end 'process'" in refused.stderr


def test_a_launch_by_name_asks_no_metadata() -> None:
    """Searching those of all distributions takes some 10 ms."""
    program = (
        "import sys, neuros.registry as r; r.BACK_ENDS.load('process');"
        " assert 'importlib.metadata' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-S", "-c", program], check=False).returncode == 0


def test_auto_takes_it_in_no_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has no rank."""
    monkeypatch.setenv("DOCKER_HOST", f"unix://{tmp_path}/none.sock")
    said = neuros("launch", str(CLOCK), "--backend", "auto", "--dry-run").stdout
    assert said.startswith("back end process;")
    assert "each node runs in a process, not in a container: no Docker engine answers" in said


def test_its_viewer_gets_the_run_and_is_told_of_its_end(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ("--backend", "in-process", "--viewer", "notes", "--duration", "0.2")
    shown = finish(launcher(CLOCK, folder, *options), folder)
    assert shown.exit_code == 0, shown.output
    assert f"notes: {folder / 'note.txt'}" in shown.output
    assert (folder / "note.txt").read_text() == "clock: clock, display\nended\n"


def test_a_viewer_that_is_none_is_refused_with_all_that_there_are() -> None:
    refused = neuros("launch", str(CLOCK), "--viewer", "rviz")
    assert refused.returncode == 2
    assert refused.stderr == (
        "neuros: viewer 'rviz': choose one of notes, dashboard, foxglove, rerun, rqt_graph, rviz2"
        " (did you mean 'rviz2'?)\n"
    )
