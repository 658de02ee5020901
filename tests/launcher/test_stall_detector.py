"""What the launcher notices of a run from the reports of its nodes, and what it says of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from neuros.control import Report
from neuros.launcher.nodes import NodeView
from neuros.launcher.stall_detector import Backlog, StallDetector, ThreadReader
from neuros.ports import RunningNode
from neuros.project.model import Connection
from neuros.stacks import ProcessThreads, Stack, Thread


def report(
    node: str = "a",
    executions: int = 0,
    received: int = 0,
    *,
    executing: dict[str, Any] | None = None,
    waiting_for: tuple[str, ...] = (),
    acknowledged: int = 0,
    lacks: str = "",
) -> Report:
    metrics: Any = {
        "state": {"state": "waiting" if lacks else "idle", "cause": lacks},
        "hooks": {"step": {"executions": executions}},
        "incoming": {"b.o -> a.x": {"received": received}},
        "outgoing": {"a.o -> c.x": {"acknowledged": acknowledged}},
        "executing": executing,
    }
    return Report(node=node, waiting_for=waiting_for, metrics=metrics)


LOADING = Report(node="b")


def executing(for_s: float, executions: int = 7) -> dict[str, Any]:
    return {"name": "step", "for_s": for_s, "executions": executions}


@dataclass
class Process:
    threads: Callable[[], ProcessThreads]


class AtOnce(ThreadReader):
    """One whose user need not come again."""

    def begin(self, name: str) -> None:
        super().begin(name)
        self.wait(10.0)


def reader_of(*reads: ProcessThreads) -> ThreadReader:
    """A reader of processes that finds this, one after the other."""
    left = [*reads]
    process = Process(lambda: left.pop(0) if len(left) > 1 else left[0])
    return AtOnce(lambda _: cast(RunningNode, process))


class Detector(StallDetector):
    """A detector from second 0 on, with a record of each node."""

    def __init__(self, names: Iterable[str], reader: ThreadReader | None = None) -> None:
        self.nodes = {name: NodeView(name) for name in names}
        super().__init__(self.nodes, 0.0, reader or reader_of(ProcessThreads()))

    def greet(self, names: Sequence[str], plugins: dict[str, str], now_s: float) -> None:
        """The process of these nodes connects."""
        for name in names:
            self.nodes[name].connect(names, plugins, now_s)


def detector_of(*names: str) -> Detector:
    """One whose nodes have all been loaded, in one process."""
    detector = Detector(names)
    detector.greet(names, {}, 0.0)
    for name in names:
        detector.report(report(name), 0.0)
        detector.nodes[name].is_ready = True
    return detector


def remarks(detector: Detector, now_s: float) -> list[str]:
    return [
        text
        for said in (
            detector.remarks_on_hooks(),
            detector.remarks_on_silence(now_s),
            detector.remarks(now_s),
        )
        for _, text in said
    ]


# ------------------------------------------------------------------ standstill


def test_a_standstill_is_asked_about_once_after_five_seconds() -> None:
    detector = detector_of("a", "b")
    assert not detector.has_just_stalled(4.9)
    assert detector.has_just_stalled(5.0)
    assert not detector.has_just_stalled(50.0)


def test_each_node_tells_why_it_does_not_move_unless_it_executes_a_hook_or_is_silent() -> None:
    detector = detector_of("a", "b", "busy", "silent")
    for name in ("a", "b", "busy", "silent"):
        detector.greet([name], {}, 0.0)
        if name == "silent":
            continue
        found = report(name, executing=executing(9.0) if name == "busy" else None)
        found.reasons = ("waits for `x` from b", "and more")
        detector.report(found, 5.0)
    assert [*detector.reasons(5.0)] == [
        ("WARN", "a waits for `x` from b; and more"),
        ("WARN", "b waits for `x` from b; and more"),
    ]


def test_the_next_standstill_is_asked_about_again() -> None:
    detector = detector_of("a")
    assert detector.has_just_stalled(5.0)
    detector.report(report("a", executions=1), 6.0)
    assert not detector.has_just_stalled(10.9)
    assert detector.has_just_stalled(11.0)


def test_a_packet_that_arrives_is_a_movement() -> None:
    detector = detector_of("a")
    detector.report(report("a", received=1), 3.0)
    assert detector.rested_s(4.0) == 1.0


def test_while_the_launcher_itself_stood_still_nobody_rested_or_was_silent() -> None:
    detector = detector_of("a")
    detector.shift(10.0)
    detector.nodes["a"].shift(10.0)
    assert not detector.has_just_stalled(14.9)
    assert remarks(detector, 14.9) == []
    assert detector.has_just_stalled(15.0)
    assert len(remarks(detector, 15.0)) == 1, "a has not reported for 5 s"


@given(st.lists(st.tuples(st.floats(0.01, 3.0), st.booleans()), max_size=30))
def test_rest_is_the_time_since_the_last_movement(steps: list[tuple[float, bool]]) -> None:
    detector, now_s, moved_s, count = detector_of("a"), 0.0, 0.0, 0
    for pause_s, moves in steps:
        now_s += pause_s
        if moves:
            count, moved_s = count + 1, now_s
        detector.report(report("a", executions=count), now_s)
        assert detector.rested_s(now_s) == now_s - moved_s


def test_a_node_that_has_never_got_its_input_is_named_once_while_others_move() -> None:
    detector = detector_of("a", "c")
    said = []
    for second in range(1, 40):
        detector.report(report("a", lacks="x"), second)
        detector.report(report("c", executions=second), second)
        said += [(second, text) for _, text in detector.remarks(second)]
    assert said == [(15, "a still waits for `x` from b, where nothing has ever come")]


def test_a_node_that_has_got_its_input_before_may_wait_for_long() -> None:
    detector = detector_of("a", "c")
    for second in range(1, 40):
        detector.report(report("a", received=1, lacks="x"), second)
        detector.report(report("c", executions=second), second)
        assert list(detector.remarks(second)) == []


def test_nothing_rests_while_a_hook_executes() -> None:
    detector = detector_of("a", "b")
    detector.report(report("b", executing=executing(1.0)), 3.0)
    assert detector.rested_s(4.0) == 0.0


def test_there_is_no_standstill_before_all_nodes_are_loaded_and_registered() -> None:
    detector = Detector(["a", "b"])
    detector.greet(["a"], {}, 0.0)
    detector.report(report("a"), 0.0)
    assert not detector.has_just_stalled(9.0), "b has not come yet"
    detector.greet(["b"], {}, 0.0)
    detector.report(LOADING, 9.0)
    assert not detector.has_just_stalled(15.0), "b is importing its plugin"
    detector.report(report("b", waiting_for=("c.o -> b.x",)), 15.0)
    assert not detector.has_just_stalled(21.0), "b waits for its sender: that is said as a remark"
    detector.report(report("b"), 21.0)
    assert detector.has_just_stalled(21.0)


# ------------------------------------------------------------------ remarks


def test_waiting_connections_are_named_after_5_seconds_and_then_every_10() -> None:
    detector = detector_of("a")
    detector.report(report("a", waiting_for=("b.o -> a.x", "b.p -> a.y")), 1.0)
    said = []
    for tenths in range(300):
        detector.report(report("a", waiting_for=("b.o -> a.x", "b.p -> a.y")), tenths / 10)
        said += [(tenths / 10, text) for text in remarks(detector, tenths / 10)]
    text = "connections still waiting for their other end: b.o -> a.x; b.p -> a.y"
    assert said == [(5.0, text), (15.0, text), (25.0, text)]


def test_connections_that_have_carried_packets_wait_for_nobody() -> None:
    detector = detector_of("a")
    waiting = ("a.o -> c.x", "b.o -> a.x")
    detector.report(report("a", received=1, waiting_for=waiting), 4.0)
    (text,) = remarks(detector, 5.0)
    assert "a.o -> c.x" in text
    assert "b.o -> a.x" not in text
    detector.report(report("a", received=1, acknowledged=1, waiting_for=waiting), 14.0)
    assert remarks(detector, 15.0) == []


def test_a_connection_that_both_ends_wait_for_is_named_once() -> None:
    detector = detector_of("a", "b")
    for name in "ab":
        detector.report(report(name, waiting_for=("b.o -> a.x",)), 4.0)
    (text,) = remarks(detector, 5.0)
    assert text.count("b.o -> a.x") == 1


def test_nodes_that_start_slowly_are_named() -> None:
    detector = Detector(["a", "b", "c"])
    detector.greet(["b", "c"], {}, 0.0)
    detector.report(LOADING, 4.0)
    detector.nodes["c"].is_loaded = True  # and waits for the others in its process
    detector.report(structs.replace(LOADING, node="c"), 4.0)
    assert remarks(detector, 5.0) == ["still starting: a", "still importing their plugins: b"]


def test_nodes_that_keep_the_others_waiting_are_named() -> None:
    slow = Detector(["a", "b"])
    slow.greet(["a", "b"], {}, 0.0)
    slow.nodes["a"].is_ready = True
    for name in ("a", "b"):
        slow.report(report(name), 4.0)
    assert remarks(slow, 5.0) == ["still initialising: b"]
    slow.nodes["b"].is_ready = True
    for name in ("a", "b"):
        slow.report(report(name), 14.0)
    assert remarks(slow, 15.0) == []


def test_when_all_is_well_nothing_is_said() -> None:
    detector = detector_of("a")
    for second in range(60):
        detector.report(report("a", executions=second), float(second))
        assert remarks(detector, float(second)) == []


def test_a_hook_that_has_run_for_5_seconds_is_named_once() -> None:
    detector = detector_of("a")
    detector.report(report("a", executing=executing(4.9)), 4.0)
    assert remarks(detector, 4.0) == []
    detector.report(report("a", executing=executing(5.9)), 5.0)
    assert remarks(detector, 5.0) == ["a has been executing 'step' for 5 s"]
    detector.report(report("a", executing=executing(6.9)), 6.0)
    assert remarks(detector, 6.0) == []
    detector.report(report("a", executing=executing(5.0, executions=8)), 20.0)
    assert remarks(detector, 20.0) == ["a has been executing 'step' for 5 s"], "another execution"


def test_a_node_that_does_not_report_is_named_once() -> None:
    detector = detector_of("a")
    detector.report(report("a", executing=executing(1.0)), 1.0)
    assert remarks(detector, 5.9) == []
    (text,) = remarks(detector, 6.0)
    assert text.startswith("a has not reported for 5 s, last seen executing 'step': ")
    assert remarks(detector, 7.0) == []
    detector.report(report("a"), 8.0)
    (text,) = remarks(detector, 13.0)
    assert text.startswith("a has not reported for 5 s: ")


IN_HOOK = (("/lib/engine.py", 7, "run"), ("/a.py", 3, "step"), ("/lib/solver.py", 9, "solve"))
MAIN = Thread("MainThread", is_main=True, has_lock=False, frames=IN_HOOK)
WORKER = Thread("worker", is_main=False, has_lock=True, frames=(("/a.py", 20, "work"),))
HELD = ProcessThreads((replace(MAIN, has_lock=True),))
STACK = '  File "/a.py", line 3, in step\n  File "/lib/solver.py", line 9, in solve'
AT_WORK = 'worker holds Python\'s global lock:\n  File "/a.py", line 20, in work'


def of_plugins(reader: ThreadReader, *processes: dict[str, str]) -> Detector:
    """A detector of processes that have nodes with these plugins, and have reported at second 0."""
    detector = Detector([name for plugins in processes for name in plugins], reader)
    for plugins in processes:
        detector.greet([*plugins], plugins, 0.0)
        for name in plugins:
            detector.report(report(name), 0.0)
    return detector


def silence(detector: Detector, now_s: float = 5.0) -> list[str]:
    """What is said of nodes that do not report."""
    return [text for _, text in detector.remarks_on_silence(now_s)]


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (
            HELD,
            "a has been executing 'step' for 5 s, and cannot report:"
            f" a library holds Python's global lock:\n{STACK}",
        ),
        (
            ProcessThreads((MAIN, WORKER)),
            f"b, a have not reported for 5 s, last seen executing 'step': {AT_WORK}",
        ),
        (
            replace(HELD, stopped="the process is stopped"),
            "b, a have not reported for 5 s, last seen executing 'step': the process is stopped",
        ),
        (
            ProcessThreads((MAIN,)),
            "b, a have not reported for 5 s, last seen executing 'step':"
            " the process gets no processor time",
        ),
        (
            ProcessThreads(problem="nobody may"),
            "b, a have not reported for 5 s: the process is stopped, or a library holds Python's"
            " global lock (where it stands is not known: nobody may)",
        ),
    ],
    ids=["in a hook", "in a thread", "stopped", "late", "not to be read"],
)
def test_of_a_process_that_does_not_report_it_is_read_and_said_once_why(
    read: ProcessThreads, said: str
) -> None:
    reader = reader_of(read)
    detector = of_plugins(reader, {"b": "/b.py", "a": "/a.py"})
    assert silence(detector) == [said]
    assert list(detector.remarks_on_silence(60.0)) == []
    detector.report(report("a"), 60.0)
    assert detector.executing("a") == "", "what was read has passed"


def test_a_process_that_cannot_be_read_for_long_is_named_all_the_same() -> None:
    goes_on = threading.Event()
    process = Process(lambda: (goes_on.wait(), HELD)[1])
    reader = ThreadReader(lambda _: cast(RunningNode, process))
    detector = of_plugins(reader, {"a": "/a.py"})
    assert list(detector.remarks_on_silence(5.0)) == list(detector.remarks_on_silence(7.9)) == []
    ((_, text),) = detector.remarks_on_silence(8.0)
    assert text.endswith("(where it stands is not known: it could not be read in time)")
    goes_on.set()


def test_a_plugin_whose_import_keeps_the_lock_is_named() -> None:
    frames = (("/lib/importlib.py", 1, "exec_module"), ("/a.py", 1, "<module>"))
    held = Thread("MainThread", is_main=True, has_lock=True, frames=frames)
    reader = reader_of(ProcessThreads((held,)))
    detector = Detector(["a"], reader)
    detector.greet(["a"], {"a": "/a.py"}, 1.0)
    ((severity, text),) = detector.remarks_on_silence(6.0)
    line, _, stack = text.partition("\n")
    assert severity == "INFO"
    assert line == (
        "a has been importing its plugin for 5 s, and cannot report: a library that is loaded lets"
        " no other thread run (where it stands is in launcher.log)"
    )
    assert '"/a.py", line 1, in <module>' in stack


def test_so_is_one_that_has_not_come_to_its_plugin_yet() -> None:
    frames = (("/lib/importlib.py", 1, "exec_module"), ("/lib/rclpy.py", 1, "<module>"))
    held = Thread("MainThread", is_main=True, has_lock=True, frames=frames)
    detector = Detector(["a", "b"], reader_of(ProcessThreads((held,))))
    detector.greet(["a", "b"], {"a": "/a.py", "b": "/b.py"}, 1.0)
    (text,) = silence(detector, 6.0)
    assert text.startswith("a, b have been importing their plugins for 5 s, and cannot report")


def test_nodes_of_one_plugin_are_each_named_in_processes_of_their_own() -> None:
    reader = reader_of(HELD)
    detector = of_plugins(reader, {"a": "/a.py"}, {"b": "/a.py"})
    begins = [text.partition(" for 5 s")[0] for text in silence(detector)]
    assert begins == ["a has been executing 'step'", "b has been executing 'step'"]
    assert detector.where(["b"], 6.0)[0] == {"b": STACK}


def test_of_nodes_of_one_plugin_in_one_process_the_one_is_named_that_executed_last() -> None:
    reader = reader_of(HELD)
    detector = of_plugins(reader, {"a": "/a.py", "b": "/a.py"})
    detector.report(report("b", executing=executing(1.0)), 0.0)
    (text,) = silence(detector)
    assert text.startswith("b has been executing 'step' for 5 s")
    assert detector.where(["a", "b"], 6.0)[0] == {"b": STACK}


def test_a_process_tells_only_of_plugins_of_its_own() -> None:
    detector = of_plugins(reader_of(HELD), {"a": "/a.py"}, {"b": "/b.py"})
    detector.greet(["b"], {"b": "/b.py", "a": "/elsewhere.py"}, 0.0)
    (text,) = silence(detector)[:1]
    assert text.startswith("a has been executing 'step'")


def test_where_a_node_stands_is_what_was_read_else_what_it_told() -> None:
    reader = reader_of(HELD, ProcessThreads(problem="nobody may"))
    detector = of_plugins(reader, {"a": "/a.py"})
    detector.report(structs.replace(report("a"), stack=Stack("a", "before", "told")), 0.0)
    reader.begin("a")
    assert detector.where(["a"], 3.0) == ({"a": STACK}, HELD)
    assert detector.where(["a"], 1.0) == ({"a": "told"}, HELD), "that is new, and has source lines"
    detector.report(structs.replace(report("a"), stack=Stack("a", "after", "told again")), 1.0)
    reader.begin("a")
    texts, read = detector.where(["a"], 9.0)
    assert (texts, read.problem) == ({"a": "told again"}, "nobody may")


def test_another_thread_that_keeps_the_lock_is_shown_if_the_node_does_not_report() -> None:
    """In one that reports, the lock goes from thread to thread."""
    reader = reader_of(ProcessThreads((MAIN, WORKER)))
    detector = of_plugins(reader, {"a": "/a.py"})
    reader.begin("a")
    assert detector.where(["a"], 1.0)[0] == {"a": STACK}
    assert detector.where(["a"], 3.0)[0] == {"a": f"{STACK}\n{AT_WORK}"}


# ------------------------------------------------------------------ packets that wait

KEY = "camera.image -> brain.image"
CONNECTION = Connection("camera", "image", "brain", "image", 0, 100, 0)


def counted(
    *,
    sent: int | None = None,
    received: int | None = None,
    unread: int = 0,
    taker: str | None = "look",
) -> Report:
    """Of the sender or of the receiver."""
    incoming = {"received": received, "unread": unread, "taker": taker if unread else None}
    metrics: Any = {
        "outgoing": {} if sent is None else {KEY: {"sent": sent, "is_reliable": True}},
        "incoming": {} if received is None else {KEY: incoming},
    }
    return Report(node="camera" if received is None else "brain", metrics=metrics)


def said(backlog: Backlog, now_s: float) -> list[str]:
    return [text for _, text in backlog.remarks(now_s)]


def test_a_node_whose_packets_wait_for_long_has_fallen_behind_which_is_said_once() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(5):
        backlog.report(counted(received=100 * second, unread=90 * second), float(second))
        assert said(backlog, float(second)) == []
    backlog.report(counted(received=1000, unread=950), 6.0)
    (text,) = said(backlog, 6.0)
    assert text.startswith(f"brain has fallen behind: the oldest of 950 unread packets on `{KEY}`")
    assert "hook 'look' is ready for it" in text
    assert said(backlog, 7.0) == []


def test_a_node_that_keeps_up_has_not_however_many_packets_it_gets() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(60):
        backlog.report(counted(received=100 * second + 1, unread=1), float(second))
        assert said(backlog, float(second)) == []


def test_nor_has_one_that_waits_for_another_input_or_is_blocked() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(60):
        backlog.report(counted(received=1, unread=1, taker=None), float(second))
        assert said(backlog, float(second)) == []


def test_packets_that_are_not_taken_in_are_said_too() -> None:
    backlog = Backlog([CONNECTION])
    for second in range(7):
        backlog.report(counted(sent=3), float(second))
        backlog.report(counted(received=2), float(second))
    (text,) = said(backlog, 6.0)
    assert text.startswith("brain has fallen behind: it has taken in no packet for over 5 s")
    assert f"`{KEY}`" in text


def test_a_node_that_can_take_in_nothing_has_not_fallen_behind() -> None:
    detector = Detector(["camera", "brain"])
    detector.greet(["camera", "brain"], {}, 0.0)
    backlog = Backlog([CONNECTION], detector.is_held_up)
    for second in range(7):
        backlog.report(counted(sent=3), float(second))
        backlog.report(counted(received=2), float(second))
        detector.report(report("brain"), float(second))
    detector.report(report("camera", executing=executing(6.0)), 6.0)
    assert said(backlog, 6.0) == [], "a hook executes in its process"
    detector.report(report("camera"), 7.0)
    assert said(backlog, 9.0) == [], "it does not report"
    detector.report(report("brain"), 9.0)
    assert "has taken in no packet for over 5 s" in said(backlog, 9.0)[0]


def test_a_pause_does_not_count() -> None:
    backlog = Backlog([CONNECTION])
    backlog.report(counted(received=5, unread=5), 0.0)
    backlog.begin_anew()
    backlog.report(counted(received=5, unread=5), 8.0)
    assert said(backlog, 9.0) == []
