"""Engines that end in mid-run, and engines without room: what is said, and that nothing is left."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from container_bench import ContainerBench, container_bench
from deadlines import wait_until
from endings import RUNS
from engines import OwnEngine, own_engine, require_engines
from machines import Machine

from neuros.backends.run_processes import RunProcesses
from neuros.cli.main import main


@pytest.fixture(scope="module")
def with_little_room() -> Iterator[OwnEngine]:
    require_engines()
    with closing(Machine("engine")) as machine, own_engine(machine, disk="100m") as engine:
        yield engine


@pytest.fixture
def engine(with_little_room: OwnEngine, monkeypatch: pytest.MonkeyPatch) -> OwnEngine:
    """An engine of this module's own, which all commands use."""
    monkeypatch.setenv("DOCKER_HOST", with_little_room.address)
    return with_little_room


@pytest.fixture
def bench(engine: OwnEngine, tmp_path: Path) -> Iterator[ContainerBench]:
    with container_bench(tmp_path) as bench:
        yield bench


def test_when_the_engine_goes_away_the_run_ends_and_says_so(
    engine: OwnEngine, bench: ContainerBench
) -> None:
    bench.project({"a": RUNS, "b": RUNS})
    running = bench.start_and_wait("a", "b")
    run = bench.session(running).run
    engine.kill()
    finished = running.finish(30.0)
    assert finished.exit_code == 4
    reason = r"node '.' ended .*: the Docker engine went away .*: start it again"
    assert re.fullmatch(reason, finished.said("neuros")[-1])
    assert bench.has_saved("a", "b")
    assert not RunProcesses(run).alive()
    engine.start()
    wait_until(lambda: not bench.left())


def test_a_disk_that_is_full_is_said_and_nothing_half_built_has_a_name(
    engine: OwnEngine,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    recipe = tmp_path / "containers" / "large"
    recipe.mkdir(parents=True)
    dockerfile = "FROM neuros_python\nUSER 0\nRUN head -c 200M /dev/zero > /large\n"
    (recipe / "Dockerfile").write_text(dockerfile)
    assert main(["containers", "build", str(recipe)]) == 4
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("neuros: ")]
    assert "image 'large' cannot be built: " in said
    assert "the disk is full: make room" in said
    client = engine.connect()
    assert client.images.list("large") == []
    assert client.containers.list(all=True) == []
    client.close()


def test_where_a_container_has_no_room_the_run_does_not_begin(
    engine: OwnEngine, bench: ContainerBench
) -> None:
    room, large = os.statvfs(engine.data), engine.data / "large"
    large.write_bytes(bytes(room.f_bavail * room.f_bsize))
    bench.project({"a": RUNS, "b": RUNS})
    finished = bench.launch()
    large.unlink()
    assert finished.exit_code == 4, finished.output
    (said,) = [line for line in finished.output.splitlines() if line.startswith("neuros: ")]
    assert "cannot be started: " in said
    assert "the disk is full: make room" in said
    assert bench.left() == []
