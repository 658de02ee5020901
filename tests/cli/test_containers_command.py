"""``neuros containers`` without an engine: what it understands, and what it says."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuros.cli.main import main


@pytest.fixture(autouse=True)
def no_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    address = f"unix://{tmp_path}/none.sock"
    monkeypatch.setenv("DOCKER_HOST", address)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return address


@pytest.mark.parametrize("action", ["build", "list", "remove"])
def test_without_an_engine_it_says_so(
    action: str, no_engine: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["containers", action]) == 4
    assert capsys.readouterr().err.startswith(f"neuros: no Docker engine answers at {no_engine} ")


def test_where_an_engine_is_not_asked_for_it_is_one_line_and_no_failure(
    no_engine: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["containers", "build", "--if-engine"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(
        "no containers are built, so projects run as processes: no Docker engine answers at "
    )
    assert out.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--build-arg", "VARIANT"], "'VARIANT' is not KEY=VALUE"),
        (["--base-image", "=debian"], "'=debian' is not KEY=VALUE"),
        (["--base-image", "a="], "'a=' is not KEY=VALUE"),
        (["--wheelhouse", "nowhere"], "--wheelhouse nowhere: there is no such folder"),
        (["--ca-bundle", "nowhere"], "--ca-bundle nowhere: there is no such file"),
    ],
)
def test_what_cannot_be_meant_is_wrong_usage(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["containers", "build", *arguments]) == 2
    assert capsys.readouterr().err == f"neuros: {complaint}\n"


def test_a_project_with_problems_is_an_invalid_project(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "project.json").write_text('{"nodes": [}')
    assert main(["containers", "build", str(tmp_path)]) == 3
    assert "project.json:1:12" in capsys.readouterr().err


def test_a_folder_that_holds_no_recipe_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "containers" / "brain"
    folder.mkdir(parents=True)
    (tmp_path / "a.py").touch()
    (tmp_path / "project.json").write_text(
        '{"nodes": [{"name": "a", "container": "brain", "plugin": "a.py"}], "connections": []}'
    )
    assert main(["containers", "build", str(tmp_path)]) == 4
    assert f"{folder}: there is neither a Dockerfile nor a requirements.txt" in (
        capsys.readouterr().err
    )
