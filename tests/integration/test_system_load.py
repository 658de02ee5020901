"""``--monitor-system-load`` on real runs."""

from __future__ import annotations

import csv
from pathlib import Path

from launching import Finished, launch

PROJECT = Path(__file__).parent / "back_ends/time"


def watched(folder: Path, back_end: str) -> tuple[Finished, list[dict[str, str]]]:
    finished = launch(PROJECT, "--backend", back_end, "--duration", "2.5", "-m", cwd=folder)
    assert finished.exit_code == 0, finished.output
    with open(finished.run_folder / "system_load.csv", newline="") as file:
        return finished, list(csv.DictReader(file))


def test_every_node_has_figures_of_its_own(tmp_path: Path) -> None:
    finished, rows = watched(tmp_path, "process")
    nodes = list(finished.record["nodes"])
    assert len(nodes) == 2
    for node in nodes:
        assert any(int(row[f"{node}.memory_bytes"] or 0) > 20_000_000 for row in rows), rows
        assert finished.record["system_load"]["processes"][node]["threads_max"] > 1
    assert "system load" in finished.output
    assert finished.record["system_load"]["samples"] == len(rows) >= 2


def test_nodes_that_share_a_process_share_its_figures(tmp_path: Path) -> None:
    finished, rows = watched(tmp_path, "in-process")
    shown = [row["host.memory_bytes"] for row in rows]
    # The first reading may be of a process that is only starting, the last of one that has ended.
    assert any(int(memory or 0) > 20_000_000 for memory in shown), rows
    assert "0" not in shown, "a process that ends has no figures"
    assert not {f"{node}.threads" for node in finished.record["nodes"]} & rows[0].keys()


def test_without_the_option_nothing_is_written(tmp_path: Path) -> None:
    finished = launch(PROJECT, "--duration", "0.2", cwd=tmp_path)
    assert not (finished.run_folder / "system_load.csv").exists()
    assert "system_load" not in finished.record
