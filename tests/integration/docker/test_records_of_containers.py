"""What a run in containers leaves behind: the bag, the load of each node, and versions."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import Finished, launch

import neuros.bag
from containers import nothing_left, require_containers
from neuros.cli.main import main

PROJECT = Path(__file__).parents[1] / "back_ends/time"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Finished]:
    """Recorded and monitored."""
    require_containers()
    folder = tmp_path_factory.mktemp("recorded")
    with nothing_left(folder):
        options = ("--backend", "docker", "--duration", "2.5", "-r", "-m")
        finished = launch(PROJECT, *options, cwd=folder, timeout_s=60.0)
        assert finished.exit_code == 0, finished.output
        yield finished


def test_the_bag_has_every_packet_that_was_sent(run: Finished) -> None:
    assert run.record["recording"]["problems"] == []
    sent = {each["connection"]: each["sent"] for each in run.record["connections"]}
    assert all(sent.values())
    assert run.run_folder is not None
    with neuros.bag.open(run.run_folder) as bag:
        assert {t.connection: t.count for t in bag.topics.values() if t.connection} == sent
        assert all(len(topic.array()) == topic.count for topic in bag.topics.values())
    assert list(run.run_folder.rglob("spool")) == []


def test_every_node_has_its_processor_time_memory_and_threads(run: Finished) -> None:
    assert run.run_folder is not None
    with open(run.run_folder / "system_load.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for node in run.record["nodes"]:
        assert any(int(row[f"{node}.memory_bytes"] or 0) > 20_000_000 for row in rows), rows
        assert any(float(row[f"{node}.cpu_percent"] or 0) > 0 for row in rows), rows
        assert run.record["system_load"]["processes"][node]["threads_max"] > 1


def test_its_record_names_engine_images_and_what_is_in_them(run: Finished) -> None:
    docker = run.record["docker"]
    assert docker["engine"]
    (image,) = docker["images"].values()
    assert image["name"].startswith("neuros_python:")
    assert image["id"].startswith("sha256:")
    for name in run.record["nodes"]:
        inside = run.record["versions"]["nodes"][name]
        assert inside["packages"]["ros_jazzy_rclpy"]
        assert inside["packages"] != run.record["versions"]["packages"]
        assert inside["python"].startswith("3.")
        assert inside["executable"] == "/opt/neuros/bin/python"


def test_it_becomes_a_page_with_every_figure(run: Finished) -> None:
    assert main(["report", str(run.run_folder)]) == 0
    assert run.run_folder is not None
    folder = run.run_folder / "report"
    names = {path.stem for path in folder.glob("*.png")}
    assert {"graph", "time_shares", "swim_lanes", "packets", "latency", "system_load"} <= names
    assert (folder / "report.html").read_text("utf-8").count("data:image/png;base64,") == len(names)


def test_its_packets_can_be_verified(run: Finished, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(run.run_folder), str(run.run_folder)]) == 0
    sent = sum(each["sent"] for each in run.record["connections"])
    assert capsys.readouterr().out.startswith(f"identical: {sent} packets")
