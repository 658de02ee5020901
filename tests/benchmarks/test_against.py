"""A commit beside another one: which rows are slower, beyond the noise."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks import against
from benchmarks.against import Pair
from neuros.cli.main import main
from neuros.errors import EnvironmentFault

ROUNDS = 6


def pair(here: Sequence[float], there: Sequence[float], unit: str = "us") -> Pair:
    return Pair("round trip", unit, tuple(here), tuple(there))


@pytest.mark.parametrize(
    ("here", "unit", "verdict"),
    [
        ([110] * ROUNDS, "us", "slower"),
        ([110] * ROUNDS, "1/s", "faster"),
        ([90] * ROUNDS, "1/s", "slower"),
        ([104] * ROUNDS, "us", ""),
        ([90, 95, 100, 105, 110, 130], "us", ""),
        ([110] * (ROUNDS - 1), "us", ""),  # too few rounds for an interval
        ([200] * ROUNDS, "", ""),
    ],
)
def test_a_row_is_slower_if_its_whole_interval_is(
    here: Sequence[float], unit: str, verdict: str
) -> None:
    assert pair(here, [100] * len(here), unit).verdict == verdict


@pytest.fixture
def trees(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """Another commit, in which a round takes 100 us; here it takes 120. Returns who measured."""
    measured: list[Path] = []

    def rows(
        tree: Path, arguments: Sequence[str], prefix: Sequence[str] = ()
    ) -> list[dict[str, Any]]:
        measured.append(tree)
        value = 100.0 if tree == tmp_path else 120.0
        return [{"subject": "good", "name": "round trip", "unit": "us", "values": [value]}]

    for name in ("good", "guard"):
        (tmp_path / "benchmarks" / "subjects").mkdir(parents=True, exist_ok=True)
        (tmp_path / "benchmarks" / "subjects" / f"{name}.py").touch()
    monkeypatch.setattr(against, "installed", lambda commit, say: tmp_path)
    monkeypatch.setattr(against, "_rows", rows)
    return measured


def test_rounds_of_both_are_interleaved(trees: list[Path], tmp_path: Path) -> None:
    (found,) = against.measure("main", ["good"], lambda _: None, rounds=2)
    assert [tree == tmp_path for tree in trees] == [False, True, True, False]
    assert (found.here, found.there) == ((120.0, 120.0), (100.0, 100.0))


def test_a_slower_row_is_exit_code_1(trees: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "good", "--against", "main", "--quick"]) == 1
    assert "1.2 (1.2 to 1.2)" in capsys.readouterr().out


def test_a_commit_that_is_none_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--against", "no-such-commit"]) == 2
    assert capsys.readouterr().err == "neuros: --against: there is no such commit\n"


def test_the_guard_measures_both_at_once_and_they_exchange_cores(
    trees: list[Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: set[tuple[bool, Sequence[str]]] = set()
    measure_rows = against._rows

    def rows(tree: Path, arguments: Sequence[str], prefix: Sequence[str]) -> list[dict[str, Any]]:
        given.add((tree == tmp_path, prefix))
        return measure_rows(tree, arguments, prefix)

    monkeypatch.setattr(against, "_rows", rows)
    monkeypatch.setattr(against, "cores", lambda: (3, 5))
    (found,) = against.measure("main", ["guard"], lambda _: None, rounds=6)
    cores = [("taskset", "-c", "3"), ("taskset", "-c", "5")]
    assert given == {(side, core) for side in (False, True) for core in cores}
    assert found.verdict == "slower"


def test_a_subject_that_the_other_commit_lacks_is_no_error(
    trees: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "new", "--against", "main"]) == 0
    assert capsys.readouterr().out == "nothing was compared\n"
    assert trees == []


@pytest.fixture
def repository(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """An empty repository in place of this one; returns ``git``."""

    def git(*arguments: str) -> str:
        identity = ("-c", "user.name=A", "-c", "user.email=a@example.org")
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "--quiet", "--initial-branch", "main")
    monkeypatch.setattr(against, "ROOT", tmp_path)
    return git


def commit(git: Callable[..., str], folder: Path, file: str, text: str) -> str:
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    (folder / file).write_text(text)
    git("add", "--all")
    git("commit", "--quiet", "--message", file)
    return git("rev-parse", "HEAD")


@pytest.mark.needs("git")
def test_the_last_landed_commit_is_that_of_origin_or_the_one_before(
    repository: Callable[..., str], tmp_path: Path
) -> None:
    first = commit(repository, tmp_path, "a", "1")
    commit(repository, tmp_path, "a", "2")
    commit(repository, tmp_path, "a", "3")
    assert against.landed() == "HEAD^1"
    repository("update-ref", "refs/remotes/origin/main", first)
    assert against.landed() == first
    repository("update-ref", "refs/remotes/origin/main", "HEAD")
    assert against.landed() == "HEAD^1"


@pytest.mark.needs("git")
def test_a_commit_that_requires_the_same_shares_this_environment(
    repository: Callable[..., str], tmp_path: Path
) -> None:
    project = 'dependencies = ["x"]\n\n[tool.ruff]\n'
    commit(repository, tmp_path, "pyproject.toml", project)
    lines = "import sys; print('installed'); sys.exit(3)"
    with_script = commit(repository, tmp_path, "install.py", lines)
    (tmp_path / "pyproject.toml").write_text(project + "line-length = 100\n")
    folder = against.installed(with_script, lambda _: None)
    assert (folder / "install.py").read_text() == lines
    (tmp_path / "pyproject.toml").write_text(project.replace("x", "y"))
    (folder / ".complete").unlink()
    with pytest.raises(EnvironmentFault, match="cannot be installed: installed"):
        against.installed(with_script, lambda _: None)
