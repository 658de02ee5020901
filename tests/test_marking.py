"""Markers tell what a test uses, and a unit test that leaves its process fails."""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from launching import EXAMPLES, launch
from marking import Watch, longest_first, reached_from

from containers import connected


@pytest.fixture(scope="module")
def watch() -> Watch:
    return Watch()


def starts_a_run() -> None:
    launch(EXAMPLES, cwd=Path())


def asks_the_engine_within_a_helper() -> None:
    def helper() -> None:
        with connected():
            pass

    helper()


def imports_where_it_is_used() -> None:
    import playwright.sync_api  # noqa: F401


class Bench:
    def method(self) -> None:
        subprocess.run(["true"], check=True)


def takes_a_bench() -> None:
    Bench().method()


def stays() -> Path:
    return EXAMPLES


@pytest.mark.parametrize(
    ("function", "kind"),
    [
        (starts_a_run, "ros"),
        (asks_the_engine_within_a_helper, "docker"),
        (imports_where_it_is_used, "browser"),
        (takes_a_bench, "process"),
    ],
)
def test_what_a_test_reaches_is_found(function: Callable[[], None], kind: str) -> None:
    assert kind in reached_from(function)


def test_what_reaches_nothing_is_a_unit() -> None:
    assert not reached_from(stays)


def test_a_process_is_noted(watch: Watch) -> None:
    with pytest.raises(pytest.fail.Exception, match=r"subprocess\.Popen"), watch.nothing_leaves():
        subprocess.run(["true"], check=True)


def test_a_ros_context_is_noted(watch: Watch) -> None:
    context = rclpy.Context()
    with pytest.raises(pytest.fail.Exception, match="ROS context"), watch.nothing_leaves():
        rclpy.init(context=context)
    rclpy.shutdown(context=context)


def test_a_connection_to_an_engine_is_noted(watch: Watch, tmp_path: Path) -> None:
    with (
        socket.socket(socket.AF_UNIX) as client,
        pytest.raises(pytest.fail.Exception, match=r"docker\.sock"),
        watch.nothing_leaves(),
        pytest.raises(FileNotFoundError),
    ):
        client.connect(str(tmp_path / "docker.sock"))


def test_what_was_done_before_does_not_count(watch: Watch) -> None:
    subprocess.run(["true"], check=True)
    with watch.nothing_leaves():
        pass


def test_files_that_wait_come_first_and_computing_ones_among_them() -> None:
    def items(count: int, *kinds: str) -> list[Any]:
        marks = [SimpleNamespace(name=kind) for kind in kinds]
        kind = kinds[0] if kinds else "unit"
        return [
            SimpleNamespace(path=Path(f"{kind}{n}"), iter_markers=lambda: marks)
            for n in range(count)
        ]

    files = [*items(4), *items(2, "process"), *items(2, "ros"), *items(1, "docker")]
    longest_first(files)
    names = [file.path.name for file in files]
    kinds = [name.rstrip("0123456789") for name in names]
    assert [kind for kind in kinds if kind != "unit"] == [
        *("docker", "ros", "ros", "process", "process")
    ]
    assert kinds[:4] == ["docker", "unit", "ros", "unit"]
    assert names[-1] == "unit3"
