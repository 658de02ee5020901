"""What an earlier version wrote, this one reads, runs and repeats."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from launching import launch

import neuros.bag
from neuros.cli.main import main
from neuros.cli.runs import EXIT_CONSUMED
from neuros.distribution import __version__

from .keeping import KEPT, PATIENCE_S, unpacked

VERSIONS = sorted(folder.name for folder in KEPT.iterdir())
NUMBERS = list(range(1, 11))


@pytest.fixture(scope="module", params=VERSIONS)
def kept(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with ``project`` and ``run`` of a version."""
    return unpacked(KEPT / request.param, tmp_path_factory.mktemp("kept") / request.param)


def said(capsys: pytest.CaptureFixture[str], *command: str | Path) -> str:
    """What a command prints that ends well."""
    code = main([str(each) for each in command])
    printed = capsys.readouterr()
    assert code == 0, printed.out + printed.err
    return printed.out


def test_this_version_has_its_files() -> None:
    assert __version__ in VERSIONS, "run python -m tests.upgrades, and commit what it writes"


def test_the_bag_has_all_packets(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "/neuros/counter/number/doubler/number" in said(capsys, "bag", "info", kept / "run")
    with neuros.bag.open(kept / "run") as bag:
        assert list(bag["counter.number"].array()["data"]) == NUMBERS
        assert [message.data for _, message in bag["doubler.double"].messages()] == [
            2 * number for number in NUMBERS
        ]
        assert json.loads(bag.custom["seeds"]) == {"counter.SEED": "7"}


def test_the_run_is_reported_and_verified(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "counter" in said(capsys, "report", kept / "run").partition("report.html")[0]
    assert said(capsys, "verify", kept / "run", kept / "run").startswith("identical: ")
    record = json.loads((kept / "run/run.json").read_text("utf-8"))
    assert record["exit_code"] == 0


@pytest.mark.parametrize("node", ["counter", "doubler", "judge"])
def test_each_node_is_replayed(node: str, kept: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "neuros.cli", "replay", kept / "run", "--node", node],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "identical: " in done.stdout


def test_the_project_is_valid_and_drawn(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said(capsys, "validate", kept / "project")
    assert "doubler" in said(capsys, "graph", kept / "project")


def test_the_project_runs_and_carries_the_same_packets(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--backend", "process", "-o", "again")
    finished = launch(kept / "project", *options, cwd=tmp_path, timeout_s=PATIENCE_S)
    assert finished.exit_code == 0, finished.output
    doubles = [2 * number for number in NUMBERS]
    assert finished.record["nodes"]["counter"]["results"] == {"doubles": doubles}
    # On the connection that may lose packets, a hook may have consumed others of them.
    assert main(["verify", str(kept / "run"), str(tmp_path / "again")]) in (0, EXIT_CONSUMED)
    *_, verdict = capsys.readouterr().out.splitlines()
    assert verdict.startswith(("identical: ", "sent packets identical: "))
