"""A project that ends by itself, or whose time is over, loses nothing on its way."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ending_bench import (
    COUNTS,
    RELAY,
    SINK,
    SOURCE,
    Bench,
    assert_ended,
    made_bench,
)
from launching import BACKENDS, Finished


@pytest.fixture(params=BACKENDS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    with made_bench(tmp_path, request.param) as bench:
        yield bench


# ------------------------------------------------------------------ drained ends


def assert_ledgers_close(finished: Finished) -> None:
    for connection in finished.record["connections"]:
        assert connection["received"] == (
            connection["consumed"] + connection["discarded"] + connection["unread"]
        )
        if connection["discard_limit"] is not None:
            assert connection["lost"] == 0, finished.output


def test_a_drained_end_loses_nothing_on_its_way(bench: Bench) -> None:
    bench.project(
        *("a.o -> b.x", "b.o -> c.x", ("b.o -> d.x", None)),
        a=SOURCE,
        b=RELAY,
        c=SINK,
        d=COUNTS,
    )
    finished = bench.launch()
    assert_ended(finished, 0, "d ended the project: enough")
    assert_ledgers_close(finished)
    first, second, _ = finished.record["connections"]
    assert first["consumed"] == first["sent"] == second["sent"] == second["consumed"] > 0
    assert bench.saved(*"abcd")
    assert all(node["report"] == "final" for node in finished.record["nodes"].values())


def test_packets_that_may_be_lost_do_not_hold_up_the_end(bench: Bench) -> None:
    serves = (
        '@neuros_initialise(outputs=["o", "kept"])\ndef serve(node):\n'
        '    return node.make_packet("o"), node.make_packet("kept")\n'
    )
    bench.project(
        *(("a.o -> b.x", None), ("b.o -> a.x", None), ("b.o -> d.x", None), "a.kept -> c.x"),
        a=serves + RELAY,
        b=RELAY,
        c=SINK,
        d=COUNTS,
    )
    finished = bench.launch()
    assert_ended(finished, 0, "d ended the project: enough")
    assert finished.connection("a.o -> b.x")["received"] >= 50, "it is a flood"
    assert not any("not drained" in text for text in finished.said("neuros"))
    assert_ledgers_close(finished)


def test_a_long_hook_is_waited_for(bench: Bench) -> None:
    bench.project(
        "a.o -> b.x",
        a="@neuros_tick(seconds=0.1, outputs='o')\ndef end(node):\n"
        "    node.shutdown('enough')\n    return node.make_packet('o')\n",
        b="@neuros_function(inputs='x')\ndef work(node, x):\n"
        "    time.sleep(1.0)\n    note(node, 'worked')\n",
    )
    finished = bench.launch()
    assert_ended(finished, 0, "a ended the project: enough")
    assert not any("not drained" in text for text in finished.said("neuros"))
    assert list(bench.folder.rglob("worked"))
    assert finished.connection("a.o -> b.x")["consumed"] == 1


def test_what_had_arrived_behind_a_hook_that_held_up_the_end_is_unread_and_not_lost(
    bench: Bench,
) -> None:
    bench.project(
        "a.o -> b.x",
        a="@neuros_tick(seconds=0.3, outputs='o')\ndef send(node):\n"
        "    if node.get_user_data():\n        node.shutdown('enough', drain_s=0.3)\n"
        "    node.set_user_data('sent one')\n    return node.make_packet('o')\n",
        b="@neuros_function(inputs='x')\ndef work(node, x):\n    time.sleep(1.5)\n",
    )
    finished = bench.launch()
    connection = finished.connection("a.o -> b.x")
    assert connection["sent"] == connection["received"] == 2
    assert_ended(finished, 0, "a ended the project: enough")


THREAD = """
@neuros_initialise()
def begin(node):
    def send():
        while node.submit({"o": node.make_packet("o")}, lambda: False):
            pass
        note(node, "stopped")
    thread = threading.Thread(target=send)
    thread.start()
    node.on_close(thread.join)
"""


@pytest.mark.parametrize("limit", [0, None], ids=["lossless", "best effort"])
def test_a_source_in_a_thread_of_its_own_stops_for_the_end(bench: Bench, limit: int | None) -> None:
    bench.project(("a.o -> b.x", limit), ("b.o -> c.x", None), a=THREAD, b=RELAY, c=COUNTS)
    finished = bench.launch()
    assert_ended(finished, 0, "c ended the project: enough")
    assert finished.connection("a.o -> b.x")["consumed"] > 0
    assert not any("not drained" in text for text in finished.said("neuros"))
    assert list(bench.folder.rglob("stopped"))
    assert_ledgers_close(finished)
