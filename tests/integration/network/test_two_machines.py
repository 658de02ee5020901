"""One project on two machines: how the sides find each other, what arrives, and how they end.

In containers, too, with an engine on each machine; all but the first test of that are long runs.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from launching import Finished, Running
from two_machines import ADDRESSES, TwoMachines

STREAM = Path(__file__).parent / "stream"
CONNECTION = "source.image -> sink.image"
FOUND_S = 60.0  # on a machine that does many other things
ENDED_S = 6.0
ENDLESS = ("--set", "nodes.source.environment.COUNT=0")
IMAGES = ("--set", "nodes.source.environment.SIZE=921600")
BEST_EFFORT = ("--set", "connections.source.image.sink.image.discard_limit=")

NETWORK = ("--network",)
TO_RIGHT = ("--peers", ADDRESSES["right"])
TO_LEFT = ("--peers", f"198.51.100.1,{ADDRESSES['left']}")  # and one that is not there

Start = Callable[..., Running]


@pytest.fixture
def start(machines: TwoMachines, backend: str, tmp_path: Path) -> Start:
    """``start("source", ...)`` on the left machine, ``start("sink", ...)`` on the right one."""
    sides = {"source": "left", "sink": "right"}

    def start_node(node: str, *arguments: str, reach: tuple[str, ...] = NETWORK) -> Running:
        options = ("-n", node, "--backend", backend, *reach, *arguments)
        return machines.start(sides[node], STREAM, *options, cwd=tmp_path)

    return start_node


def numbers_at(finished: Finished) -> list[int]:
    """The images that the sink has taken, by number."""
    assert finished.run_folder is not None
    text = (finished.run_folder / "sink" / "received.json").read_text()
    numbers: list[int] = json.loads(text)["numbers"]
    return numbers


def assert_all_arrived(source: Finished, sink: Finished, count: int) -> None:
    """Without a loss, and both sides know the whole of it."""
    assert (source.exit_code, sink.exit_code) == (0, 0), source.output + sink.output
    assert numbers_at(sink) == list(range(1, count + 1))
    for finished in (source, sink):
        books = finished.connection(CONNECTION)
        assert (books["sent"], books["received"], books["lost"]) == (count, count, 0)


# ------------------------------------------------------------------ finding each other


@pytest.mark.parametrize(
    ("backend", "has_multicast"), [("process", True), ("docker", True), ("docker", False)]
)
def test_two_sides_find_each_other_and_end_together(
    machines: TwoMachines, start: Start, backend: str, has_multicast: bool
) -> None:
    if not has_multicast:
        machines.stop_multicast()
    left, right = (NETWORK, NETWORK) if has_multicast else (TO_RIGHT, TO_LEFT)
    with start("source", reach=left) as source, start("sink", reach=right) as sink:
        sink_ended, source_ended = sink.finish(FOUND_S), source.finish()
    assert_all_arrived(source_ended, sink_ended, 100)
    reason = "source ended the project: all sent"
    assert source_ended.said("neuros")[-1] == reason
    assert sink_ended.said("neuros")[-1] == f"the project ended elsewhere (left): {reason}"
    assert "found elsewhere: sink (right)" in source_ended.said("neuros")
    assert "found elsewhere: source (left)" in sink_ended.said("neuros")
    assert source_ended.record["backend"] == sink_ended.record["backend"] == backend


@pytest.mark.parametrize("first", ["source", "sink"])
def test_without_multicast_who_is_there_first_names_the_other(
    first: str, machines: TwoMachines, start: Start
) -> None:
    machines.stop_multicast()
    peers = {"source": TO_RIGHT, "sink": TO_LEFT}
    second = "sink" if first == "source" else "source"
    with start(first, reach=peers[first]) as one:
        one.wait_for(f"still waiting for nodes elsewhere: {second} (", FOUND_S)
        with start(second, reach=peers[second]) as other:
            ended = {second: other.finish(FOUND_S), first: one.finish()}
    assert_all_arrived(ended["source"], ended["sink"], 100)


def test_without_network_a_run_is_not_found_from_another_machine(start: Start) -> None:
    with start("source") as source, start("sink", reach=()) as sink:
        source.wait_for("still waiting for nodes elsewhere: sink (", FOUND_S)
        sink.wait_for("still waiting for nodes elsewhere: source (", FOUND_S)
        source.signal(signal.SIGINT)
        sink.signal(signal.SIGINT)
        assert "found elsewhere" not in source.finish().output + sink.finish().output


# ------------------------------------------------------------------ what arrives


def test_a_tenth_is_lost_on_the_way_and_all_images_arrive(
    machines: TwoMachines, start: Start
) -> None:
    machines.lose(0.1)
    large = (*IMAGES, "--set", "nodes.source.environment.COUNT=20")
    with start("source", *large) as source, start("sink", *large) as sink:
        sink_ended, source_ended = sink.finish(FOUND_S), source.finish()
    assert_all_arrived(source_ended, sink_ended, 20)


def test_what_best_effort_loses_is_counted_on_both_sides(
    machines: TwoMachines, start: Start
) -> None:
    machines.lose(0.1)
    count = ("--set", "nodes.source.environment.COUNT=300", *BEST_EFFORT)
    with start("source", *count) as source, start("sink", *count) as sink:
        ended = [sink.finish(FOUND_S), source.finish()]
    for finished in ended:
        assert finished.exit_code == 0
        books = finished.connection(CONNECTION)
        assert books["sent"] == 300
        assert books["consumed"] == len(numbers_at(ended[0]))
        assert books["consumed"] <= books["received"] < 300
        assert books["lost"] == books["sent"] - books["received"]


# ------------------------------------------------------------------ ending together


@pytest.fixture
def pair(start: Start) -> tuple[Running, Running]:
    """Both sides, at work."""
    return start("source", *ENDLESS), start("sink", *ENDLESS)


def assert_ends_soon(running: Running, exit_code: int, reason: str) -> None:
    before_s = time.monotonic()
    finished = running.finish()
    assert time.monotonic() - before_s < ENDED_S
    assert finished.exit_code == exit_code, finished.output
    assert reason in finished.said("neuros")[-1]


def await_each_other(source: Running, sink: Running) -> None:
    """The stream flows, and neither side is one that the other has never heard of."""
    sink.wait_for("the first image is here", FOUND_S)
    sink.wait_for("found elsewhere: source", FOUND_S)
    source.wait_for("found elsewhere: sink", FOUND_S)


def test_ctrl_c_on_one_side_ends_the_other(pair: tuple[Running, Running]) -> None:
    with pair[0] as source, pair[1] as sink:
        await_each_other(source, sink)
        source.signal(signal.SIGINT)
        assert_ends_soon(sink, 130, "the project ended elsewhere (left): ended by Ctrl+C")
        assert source.finish().exit_code == 130


def test_a_failure_on_one_side_ends_the_other_as_failed(start: Start) -> None:
    broken = ("--set", "nodes.source.environment.BREAKS_AT=50")
    with start("sink") as sink, start("source", *broken) as source:
        finished = sink.finish(FOUND_S)
        assert finished.exit_code == source.finish().exit_code == 1
    before = "the project ended elsewhere (left): node 'source' failed: "
    assert finished.said("neuros")[-1].startswith(before)
    assert finished.connection(CONNECTION)["sent"] == 49


def test_a_launcher_that_is_killed_ends_the_other_side(pair: tuple[Running, Running]) -> None:
    with pair[0] as source, pair[1] as sink:
        await_each_other(source, sink)
        source.signal(signal.SIGKILL)
        assert_ends_soon(sink, 1, "node 'source' on left is gone")


def test_a_cable_that_is_pulled_ends_both(
    machines: TwoMachines, pair: tuple[Running, Running]
) -> None:
    with pair[0] as source, pair[1] as sink:
        await_each_other(source, sink)
        machines.unplug()
        assert_ends_soon(sink, 1, "node 'source' on left is gone")
        assert_ends_soon(source, 1, "node 'sink' on right is gone")
