"""``neuros verify`` on real runs: the same project twice, across back ends, and changed."""

from __future__ import annotations

from pathlib import Path

import pytest
from launching import EXAMPLES, Finished, launch

from neuros.cli.main import main

PROJECT = EXAMPLES / "3_physics_simulation/elevator"
STRICT = ("--duration", "2sim")


def run(folder: Path, *arguments: str) -> Finished:
    folder.mkdir()
    finished = launch(PROJECT, *STRICT, *arguments, cwd=folder)
    assert finished.exit_code == 0, finished.output
    return finished


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run(tmp_path_factory.mktemp("runs") / "reference", "--backend", "process", "-r")


def verify(a: Finished, b: Finished, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = main(["verify", str(a.run_folder), str(b.run_folder)])
    return code, capsys.readouterr().out


@pytest.mark.parametrize("arguments", [("process",), ("in-process", "--digests")])
def test_a_strict_run_is_repeated_packet_by_packet(
    tmp_path: Path,
    reference: Finished,
    arguments: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = run(tmp_path / "other", "--backend", *arguments)
    code, text = verify(reference, other, capsys)
    assert code == 0, text
    assert text.startswith("identical: ")
    digests = [
        [each["digests"]["sent"] for each in finished.record["connections"]]
        for finished in (reference, other)
    ]
    assert digests[0] == digests[1]


def test_another_project_is_told_by_its_first_packet_and_the_field(
    tmp_path: Path, reference: Finished, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = run(tmp_path / "changed", "--set", "nodes.controller.environment.TOUR=3 0", "-r")
    code, text = verify(reference, changed, capsys)
    assert code == 1
    first = "different: controller.target -> elevator.target: packet 1 differs"
    assert f"{first} in data: " in text
    assert changed.run_folder is not None
    (changed.run_folder / "recording.json").write_text("{")
    _code, text = verify(reference, changed, capsys)
    assert "recording.json is damaged" in text
    assert f"{first} (which field, only --record can tell)" in text


def test_in_process_without_digests_there_is_nothing_to_compare(
    tmp_path: Path, reference: Finished, capsys: pytest.CaptureFixture[str]
) -> None:
    other = run(tmp_path / "other", "--backend", "in-process")
    code, text = verify(reference, other, capsys)
    assert code == 2
    assert "--digests" in text
    assert text.endswith("unknown: there is nothing to compare\n")


@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_in_process_what_was_recorded_is_compared(
    tmp_path: Path, reference: Finished, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    first = run(tmp_path / "first", "--backend", "in-process", "-r")
    if back_end == "process":
        other = reference
    else:
        other = run(tmp_path / "second", "--backend", "in-process", "-r", "--storage", "sqlite3")
    code, text = verify(first, other, capsys)
    assert code == 0, text
    assert text == f"identical: {sum(c['sent'] for c in first.record['connections'])} packets\n"


def test_latencies_are_there_with_and_without_digests(reference: Finished) -> None:
    for connection in reference.record["connections"]:
        latency_ms = connection["latency_ms"]
        assert 0 < latency_ms["p50"] <= latency_ms["p90"] <= latency_ms["p99"] <= latency_ms["max"]
        assert latency_ms["count"] == connection["consumed"]
