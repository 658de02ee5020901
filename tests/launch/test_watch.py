"""What the launcher notices of a run from the reports of its nodes, and what it says of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from neuros.launch.watch import Watch


def report(
    executions: int = 0,
    received: int = 0,
    *,
    executing: dict[str, Any] | None = None,
    waiting_for: tuple[str, ...] = (),
) -> dict[str, Any]:
    return {
        "waiting_for": list(waiting_for),
        "metrics": {
            "hooks": {"step": {"executions": executions}},
            "incoming": {"b.o -> a.x": {"received": received}},
            "executing": executing,
        },
    }


LOADING = {"waiting_for": [], "metrics": None}


def executing(for_s: float, executions: int = 7) -> dict[str, Any]:
    return {"name": "step", "for_s": for_s, "executions": executions}


def watch_of(*names: str) -> Watch:
    """A watch from second 0 on, whose nodes have all been loaded."""
    watch = Watch(names, 0.0, Path("nowhere"))
    watch.greet(names)
    for name in names:
        watch.report(name, report(), 0.0)
    return watch


def remarks(watch: Watch, now_s: float) -> list[str]:
    return [
        text
        for said in (
            watch.remarks_on_hooks(),
            watch.remarks_on_silence(now_s),
            watch.remarks(now_s),
        )
        for _, text in said
    ]


# ------------------------------------------------------------------ standstill


def test_a_standstill_is_asked_about_once_after_five_seconds() -> None:
    watch = watch_of("a", "b")
    assert not watch.has_just_stalled(4.9)
    assert watch.has_just_stalled(5.0)
    assert not watch.has_just_stalled(50.0)


def test_the_next_standstill_is_asked_about_again() -> None:
    watch = watch_of("a")
    assert watch.has_just_stalled(5.0)
    watch.report("a", report(executions=1), 6.0)
    assert not watch.has_just_stalled(10.9)
    assert watch.has_just_stalled(11.0)


def test_a_packet_that_arrives_is_a_movement() -> None:
    watch = watch_of("a")
    watch.report("a", report(received=1), 3.0)
    assert watch.rested_s(4.0) == 1.0


@given(st.lists(st.tuples(st.floats(0.01, 3.0), st.booleans()), max_size=30))
def test_rest_is_the_time_since_the_last_movement(steps: list[tuple[float, bool]]) -> None:
    watch, now_s, moved_s, count = watch_of("a"), 0.0, 0.0, 0
    for pause_s, moves in steps:
        now_s += pause_s
        if moves:
            count, moved_s = count + 1, now_s
        watch.report("a", report(executions=count), now_s)
        assert watch.rested_s(now_s) == now_s - moved_s


def test_nothing_rests_while_a_hook_executes() -> None:
    watch = watch_of("a", "b")
    watch.report("b", report(executing=executing(1.0)), 3.0)
    assert watch.rested_s(4.0) == 0.0


def test_there_is_no_standstill_before_all_nodes_are_loaded_and_registered() -> None:
    watch = Watch(["a", "b"], 0.0, Path("nowhere"))
    watch.greet(["a"])
    watch.report("a", report(), 0.0)
    assert not watch.has_just_stalled(9.0), "b has not come yet"
    watch.greet(["b"])
    watch.report("b", LOADING, 9.0)
    assert not watch.has_just_stalled(15.0), "b is importing its plugin"
    watch.report("b", report(waiting_for=("c.o -> b.x",)), 15.0)
    assert not watch.has_just_stalled(21.0), "b waits for its sender: that is said as a remark"
    watch.report("b", report(), 21.0)
    assert watch.has_just_stalled(21.0)


# ------------------------------------------------------------------ remarks


def test_waiting_connections_are_named_after_5_seconds_and_then_every_10() -> None:
    watch = watch_of("a")
    watch.report("a", report(waiting_for=("b.o -> a.x", "b.p -> a.y")), 1.0)
    said = []
    for tenths in range(300):
        watch.report("a", report(waiting_for=("b.o -> a.x", "b.p -> a.y")), tenths / 10)
        said += [(tenths / 10, text) for text in remarks(watch, tenths / 10)]
    text = "connections still waiting for their other end: b.o -> a.x; b.p -> a.y"
    assert said == [(5.0, text), (15.0, text), (25.0, text)]


def test_a_connection_that_both_ends_wait_for_is_named_once() -> None:
    watch = watch_of("a", "b")
    for name in "ab":
        watch.report(name, report(waiting_for=("b.o -> a.x",)), 4.0)
    (text,) = remarks(watch, 5.0)
    assert text.count("b.o -> a.x") == 1


def test_nodes_that_start_slowly_are_named() -> None:
    watch = Watch(["a", "b", "c"], 0.0, Path("nowhere"))
    watch.greet(["b", "c"])
    watch.report("b", LOADING, 4.0)
    watch.report("c", report(), 4.0)
    assert remarks(watch, 5.0) == ["still starting: a", "still importing their plugins: b"]


def test_when_all_is_well_nothing_is_said() -> None:
    watch = watch_of("a")
    for second in range(60):
        watch.report("a", report(executions=second), float(second))
        assert remarks(watch, float(second)) == []


def test_a_hook_that_has_run_for_5_seconds_is_named_once() -> None:
    watch = watch_of("a")
    watch.report("a", report(executing=executing(4.9)), 4.0)
    assert remarks(watch, 4.0) == []
    watch.report("a", report(executing=executing(5.9)), 5.0)
    assert remarks(watch, 5.0) == ["a has been executing 'step' for 5 s"]
    watch.report("a", report(executing=executing(6.9)), 6.0)
    assert remarks(watch, 6.0) == []
    watch.report("a", report(executing=executing(5.0, executions=8)), 20.0)
    assert remarks(watch, 20.0) == ["a has been executing 'step' for 5 s"], "another execution"


def test_a_node_that_does_not_report_is_named_once() -> None:
    watch = watch_of("a")
    watch.report("a", report(executing=executing(1.0)), 1.0)
    assert remarks(watch, 5.9) == []
    (text,) = remarks(watch, 6.0)
    assert text.startswith("a has not reported for 5 s, last seen executing 'step': ")
    assert remarks(watch, 7.0) == []
    watch.report("a", report(), 8.0)
    (text,) = remarks(watch, 13.0)
    assert text.startswith("a has not reported for 5 s: ")
