"""What the doctor finds on machines that lack something."""

from __future__ import annotations

import gc
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from neuros.backends.docker.back_end import check_containers
from neuros.doctor import checks
from neuros.ports import Finding, FindingState
from neuros.stacks import ProcessThreads


def findings(environ: dict[str, str] | None = None) -> dict[str, Finding]:
    return {finding.subject: finding for finding in checks.look_at_machine(environ or {})}


def test_nothing_is_wrong_with_a_machine_that_runs_the_tests() -> None:
    states = {finding.subject: finding.state for finding in findings().values()}
    assert FindingState.BAD not in states.values()
    assert states["Python"] is states["ROS 2"] is states["domain"] is FindingState.GOOD


def test_missing_ros_is_a_problem_and_a_missing_simulator_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def version(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", version)
    ros, mujoco = findings()["ROS 2"], next(checks.look_at_simulators({}))
    assert ros.state is FindingState.BAD
    assert "./install.py" in ros.remedy
    assert mujoco.state is FindingState.ABSENT
    assert "--extras mujoco" in mujoco.remedy


def test_shared_memory_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(checks, "SHARED_MEMORY", tmp_path / "none")
    assert findings()["memory"].state is FindingState.BAD
    assert str(tmp_path / "none") in findings()["memory"].text


def test_shared_memory_too_small_for_images_is_a_problem(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usage: Any = shutil.disk_usage("/")._replace(free=2**20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    assert findings()["memory"].state is FindingState.BAD
    assert "1 MiB free" in findings()["memory"].text


def test_a_domain_id_that_is_none_is_a_problem() -> None:
    assert findings({"ROS_DOMAIN_ID": "many"})["domain"].state is FindingState.BAD


def test_whether_a_run_can_show_where_a_node_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    assert findings()["stacks"].state is FindingState.GOOD
    monkeypatch.setattr(checks, "threads_of", lambda _: ProcessThreads(problem="nobody may"))
    found = findings()["stacks"]
    assert (found.state, found.text) == (
        FindingState.ABSENT,
        "those of nodes that hang cannot be shown: nobody may",
    )


def test_the_display_is_the_one_that_the_environment_names() -> None:
    assert findings({})["display"].state is FindingState.ABSENT
    assert findings({"DISPLAY": ":7"})["display"].text == "DISPLAY=:7"


def test_a_gpu_tool_that_fails_is_a_problem(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\nexit 9\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert findings()["GPU"].state is FindingState.BAD
    tool.write_text("#!/bin/sh\necho 'Some GPU, 555.1'\n")
    assert findings()["GPU"].text == "Some GPU, 555.1"


def test_a_finding_is_one_line_with_its_remedy() -> None:
    assert str(Finding.bad("ROS 2", "not installed", "run ./install.py")) == (
        "PROBLEM  ROS 2        not installed: run ./install.py"
    )


# The Docker SDK leaves a socket that could not connect to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_without_an_engine_one_line_says_why_and_nothing_is_wrong(tmp_path: Path) -> None:
    environ = {"DOCKER_HOST": f"unix://{tmp_path}/none.sock"}
    (finding,) = check_containers(["neuros_python"], environ)
    assert finding.state is FindingState.ABSENT
    assert finding.subject == "Docker"
    assert f"{tmp_path}/none.sock" in finding.text
    gc.collect()
