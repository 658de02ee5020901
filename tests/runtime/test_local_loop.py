"""The loop of nodes in one thread: events, timers and other threads, without ROS and with it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from neuros.backends.domain import choose_domain
from neuros.project.model import Folders, Node, NodeFile
from neuros.runtime.local import LocalLoop, LocalMiddleware
from neuros.runtime.one_process import LOCAL

TIMEOUT_S = 20.0
Event = Callable[[], None]


@contextmanager
def overdue(loop: LocalLoop) -> Iterator[None]:
    """Stop a loop that does not come to its end, and fail."""
    is_late = threading.Event()
    timer = threading.Timer(TIMEOUT_S, lambda: (is_late.set(), loop.stop(), loop.end_run()))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
    assert not is_late.is_set()


def counting_down(count: int, at_zero: Event) -> Event:
    left = count

    def call() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            at_zero()

    return call


def test_events_are_handled_in_the_order_of_posting_and_a_loop_back_after_them() -> None:
    loop, seen = LocalLoop(), []

    def first() -> None:
        loop.post_loop_back(lambda: (seen.append("loop-back"), loop.stop()))
        loop.post(lambda: seen.append("posted"))

    loop.post(first)
    loop.post(lambda: seen.append("waiting"))
    with overdue(loop):
        loop.run()
    assert seen == ["waiting", "loop-back"]  # nothing is handled once it was stopped
    loop.take_in()
    assert seen == ["waiting", "loop-back", "posted"]


def test_an_event_of_another_thread_wakes_the_loop() -> None:
    loop = LocalLoop()
    threads = [threading.Thread(target=loop.post_from_thread, args=(done,))
               for done in [counting_down(8, loop.stop)] * 8]  # fmt: skip
    for thread in threads:
        thread.start()
    with overdue(loop):
        loop.run()
    for thread in threads:
        thread.join()


def test_another_thread_stops_a_loop_that_waits() -> None:
    loop = LocalLoop()
    thread = threading.Thread(target=loop.stop)
    thread.start()
    with overdue(loop):
        loop.run()
    thread.join()


def test_a_timer_is_called_at_its_time_and_not_before() -> None:
    loop = LocalLoop()
    due_ns: int | None = time.monotonic_ns() + 20_000_000
    called_ns = []

    def on_due() -> None:
        nonlocal due_ns
        called_ns.append(time.monotonic_ns())
        begun_ns, due_ns = due_ns, None
        assert begun_ns is not None
        assert called_ns[0] >= begun_ns
        loop.post(loop.stop)

    loop.add_timer(lambda: due_ns, on_due)
    with overdue(loop):
        loop.run()
    assert len(called_ns) == 1


def test_neither_a_timer_that_is_always_overdue_nor_events_without_end_have_the_thread_alone() -> (
    None
):
    """Nor do they keep it from what other threads post."""
    loop = LocalLoop()
    counts = {"timer": 0, "events": 0, "thread": 0}

    def count(what: str) -> None:
        counts[what] += 1
        if min(counts.values()) >= 100:
            loop.stop()

    def again() -> None:
        count("events")
        loop.post_loop_back(again)

    def from_thread() -> None:
        for _ in range(100):
            loop.post_from_thread(lambda: count("thread"))

    loop.add_timer(lambda: 0, lambda: count("timer"))
    loop.post(again)
    thread = threading.Thread(target=from_thread)
    thread.start()
    with overdue(loop):
        loop.run()
    thread.join()


def test_a_signal_handler_interrupts_a_loop_that_waits() -> None:
    loop = LocalLoop()
    previous = signal.signal(signal.SIGALRM, lambda *_: loop.interrupt(KeyboardInterrupt()))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with overdue(loop), pytest.raises(KeyboardInterrupt):
            loop.run_for(TIMEOUT_S)
    finally:
        signal.signal(signal.SIGALRM, previous)


def test_what_an_event_raises_ends_the_run_of_the_loop() -> None:
    loop = LocalLoop()
    loop.post(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        loop.run()


# ---------------------------------------------------------------------- with ROS


@pytest.fixture(scope="module")
def domain() -> Iterator[None]:
    """A ROS domain of our own on this machine."""
    with choose_domain(None, {}, False) as lock, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(lock.id))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@contextmanager
def alone(tmp_path: os.PathLike[str]) -> Iterator[tuple[LocalMiddleware, LocalLoop, NodeFile]]:
    """One node in a process without ROS so far."""
    folders = Folders(tmp_path, tmp_path, tmp_path)  # type: ignore[arg-type]
    file = NodeFile(Node("a", "neuros_python", folders.run / "a.py"), (), folders)
    failures: list[BaseException] = []
    middleware = LOCAL.middleware([file], failures.append, digests=False, record=False, debug=False)
    middleware.transport(file)
    middleware.mark_own_entities(file, lambda: None, lambda _, error: failures.append(error))
    assert isinstance(middleware.loop, LocalLoop)
    try:
        yield middleware, middleware.loop, file
    finally:
        middleware.take_in()
        middleware.flush()
        middleware.close()
    assert not failures


@pytest.mark.usefixtures("domain")
@pytest.mark.parametrize("asks", ["before", "event", "thread"])
def test_events_timers_and_threads_go_on_when_ros_comes(
    tmp_path: os.PathLike[str], asks: str
) -> None:
    """Each goes on to the end, whenever the ROS node is asked for, and ROS is served, too."""
    with alone(tmp_path) as (middleware, loop, file):
        counts = dict.fromkeys(("timer", "events", "thread", "ros"), 0)
        is_over = threading.Event()

        def count(what: str) -> None:
            counts[what] += 1
            if min(counts.values()) >= 20:
                is_over.set()
                loop.stop()

        def ask() -> None:
            middleware.ros_node(file).create_timer(0.001, lambda: count("ros"))

        def again() -> None:
            count("events")
            loop.post_loop_back(again)

        def from_thread() -> None:
            if asks == "thread":
                ask()
            while not is_over.wait(0.0005):
                loop.post_from_thread(lambda: count("thread"))

        loop.add_timer(lambda: 0, lambda: count("timer"))
        loop.post(again)
        if asks == "before":
            ask()
        elif asks == "event":
            loop.post(ask)
        thread = threading.Thread(target=from_thread)
        thread.start()
        with overdue(loop):
            loop.run()
        is_over.set()
        thread.join()


@pytest.mark.usefixtures("domain")
def test_a_free_run_serves_ros_even_while_events_never_end(tmp_path: os.PathLike[str]) -> None:
    with alone(tmp_path) as (middleware, loop, file):

        def again() -> None:
            loop.post_loop_back(again)

        done = counting_down(5, loop.end_run)
        middleware.ros_node(file).create_timer(0.001, done)
        again()
        with overdue(loop):
            loop.run_for(TIMEOUT_S)
