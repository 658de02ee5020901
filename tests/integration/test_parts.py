"""One project, started in parts by several launchers on this machine: it begins and ends as one."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from deadlines import wait_until
from launching import Running, start

from neuros.backends.domain import choose_domain

STREAM = Path(__file__).parent / "network" / "stream"
CONNECTION = "source.image -> sink.image"
FOUND_S = 60.0  # on a machine that does many other things
ENDLESS = ("--set", "nodes.source.environment.COUNT=0")


class Parts:
    """Starts nodes of the project, each by a launcher of its own, in a domain of their own."""

    def __init__(self, folder: Path, domain: int) -> None:
        self._folder = folder
        self._domain = str(domain)

    def start(self, node: str, *arguments: str, project: Path = STREAM) -> Running:
        folder = self._folder / node
        folder.mkdir()
        return start(project, "-n", node, "-d", self._domain, *arguments, cwd=folder)


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Parts]:
    with choose_domain(None, {}, False) as domain:
        yield Parts(tmp_path, domain.id)


def test_parts_end_drained_together_and_each_knows_both_ends(parts: Parts) -> None:
    with parts.start("sink") as sink, parts.start("source") as source:
        finished = [source.finish(FOUND_S), sink.finish(FOUND_S)]
    for part in finished:
        assert part.exit_code == 0, part.output
        books = part.connection(CONNECTION)
        assert (books["sent"], books["received"], books["lost"]) == (100, 100, 0)
        assert books["consumed"] == 100
    assert finished[1].said("neuros")[-1].endswith("): source ended the project: all sent")


def test_the_duration_of_one_part_ends_all(parts: Parts) -> None:
    with (
        parts.start("sink", "--duration", "0.5") as sink,
        parts.start("source", *ENDLESS) as source,
    ):
        assert sink.finish(FOUND_S).exit_code == 0
        finished = source.finish(FOUND_S)
    assert finished.exit_code == 0
    assert finished.said("neuros")[-1].endswith("): 0.5 s are over")
    books = finished.connection(CONNECTION)
    assert books["sent"] == books["received"] == books["consumed"] > 0


def test_a_node_that_is_killed_ends_all_and_its_own_launcher_says_how(parts: Parts) -> None:
    with parts.start("sink", *ENDLESS) as sink, parts.start("source", *ENDLESS) as source:
        sink.wait_for("the first image is here", FOUND_S)
        sink.wait_for("found elsewhere: source", FOUND_S)  # else it waits for one that may come
        (child,) = children(source.process.pid, "source/node.json")
        child.kill()
        assert source.finish().exit_code == sink.finish().exit_code == 1
    assert "killed by SIGKILL" in source.output
    assert "node 'source' on " in sink.output


def test_a_part_that_still_imports_its_plugin_tells_the_others_that_it_was_ended(
    parts: Parts, tmp_path: Path
) -> None:
    imports = f"import pathlib, time; pathlib.Path({str(tmp_path / 'imports')!r}).touch()"
    project = tmp_path / "project"
    shutil.copytree(STREAM, project)
    with (project / "sink.py").open("a") as plugin:
        plugin.write(f"\n{imports}; time.sleep(60)\n")
    with (
        parts.start("source", *ENDLESS, project=project) as source,
        parts.start("sink", *ENDLESS, project=project) as sink,
    ):
        wait_until((tmp_path / "imports").exists, FOUND_S)
        source.wait_for("found elsewhere: sink", FOUND_S)
        sink.signal(signal.SIGINT)
        ended = sink.finish()
        assert source.finish().exit_code == ended.exit_code == 130, source.output


def test_a_part_that_is_alone_is_ended_by_ctrl_c_as_ever(parts: Parts) -> None:
    with parts.start("source") as source:
        source.wait_for("still waiting for nodes elsewhere: sink (", FOUND_S)
        source.signal(signal.SIGINT)
        finished = source.finish()
    assert finished.exit_code == 130
    assert finished.connection(CONNECTION)["received"] is None


def children(parent: int, argument: str) -> list[psutil.Process]:
    """The processes below a launcher that were given this argument."""
    found = psutil.Process(parent).children(recursive=True)
    return [child for child in found if any(argument in each for each in child.cmdline())]
