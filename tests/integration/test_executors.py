"""The loop on each executor of rclpy; the one with a wait set is what it falls back to."""

from __future__ import annotations

import functools
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
from launching import EXAMPLES, launch
from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future, Task
from std_msgs.msg import Int32

from neuros.backends.domain import choose_domain
from neuros.errors import EnvironmentFault
from neuros.transport import ros_loop
from neuros.transport.lean_node import LeanNode, PluginCallbacks
from neuros.transport.messages import message_class
from neuros.transport.rclpy_patches import Turn
from neuros.transport.ros_loop import EXECUTOR_VARIABLE, RosLoop, WaitSetExecutor, make_executor

EVENTS = "rclpy.experimental.events_executor"
TIMEOUT_S = 20.0


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """A ROS domain of our own on this machine."""
    with choose_domain(None, {}, False) as lock, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(lock.id))
        yield


@pytest.fixture
def context() -> Iterator[rclpy.Context]:
    """A context of its own for each test."""
    message_class("std_msgs/msg/Int32")  # ROS's first conversion of a type imports what warns
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    yield context
    rclpy.shutdown(context=context)


class Loop:
    """A loop whose failures fail the test."""

    def __init__(self, context: rclpy.Context) -> None:
        self.failures: list[BaseException] = []
        self.loop = RosLoop(context, self.failures.append)

    def run(self) -> None:
        """Until it is stopped, at most for a while."""
        limit = threading.Timer(TIMEOUT_S, self.loop.stop)
        limit.start()
        try:
            self.loop.run()
            assert limit.is_alive(), f"the loop was not stopped within {TIMEOUT_S:g} s"
        finally:
            limit.cancel()
            self.loop.close()
        if self.failures:
            raise self.failures[0]


@pytest.fixture(params=["events", "wait_set"])
def loop(request: pytest.FixtureRequest, context: rclpy.Context) -> Loop:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(EXECUTOR_VARIABLE, request.param)
        return Loop(context)


def test_a_timer_that_is_due_at_time_zero_is_called_after_a_long_event(loop: Loop) -> None:
    """Zero is a time like others. A long event ends the wait for what is older than the timer."""
    calls = 0

    def long() -> None:
        end_ns = time.monotonic_ns() + 3_000_000
        while time.monotonic_ns() < end_ns:
            pass
        loop.loop.post_loop_back(long)

    def on_due() -> None:
        nonlocal calls
        calls += 1
        if calls == 10:
            loop.loop.stop()

    loop.loop.add_timer(lambda: 0, on_due)
    loop.loop.post(long)
    loop.run()
    assert calls == 10


def test_events_are_handled_in_the_order_in_which_they_were_posted(loop: Loop) -> None:
    seen: list[int] = []
    for number in range(5):
        loop.loop.post(lambda n=number: seen.append(n))  # type: ignore[misc]
    loop.loop.post(loop.loop.stop)
    loop.run()
    assert seen == [0, 1, 2, 3, 4]


def test_a_loop_back_comes_after_all_that_ros_has_waiting(
    loop: Loop, context: rclpy.Context
) -> None:
    node = RosNode("node", context=context)
    loop.loop.add_node(node)
    seen: list[object] = []
    receive = loop.loop.guarded(lambda message: seen.append(message.data))
    subscription = node.create_subscription(Int32, "numbers", receive, 10)
    publisher = node.create_publisher(Int32, "numbers", 10)

    def begin() -> None:
        if not (publisher.get_subscription_count() and subscription.get_publisher_count()):
            loop.loop.post(begin)
            return
        for number in range(5):
            publisher.publish(Int32(data=number))
        time.sleep(0.2)  # nothing can be asked whether it has arrived without taking it
        loop.loop.post_loop_back(lambda: seen.append("loop-back"))
        loop.loop.post(loop.loop.stop)

    loop.loop.post(begin)
    loop.run()
    node.destroy_node()
    assert seen == [0, 1, 2, 3, 4, "loop-back"]


@pytest.mark.parametrize("is_busy", [True, False], ids=["busy", "idle"])
def test_so_does_one_that_ros_has_caused(is_busy: bool, loop: Loop, context: rclpy.Context) -> None:
    """Whether or not events of engines have kept the loop busy all the time."""
    node = RosNode("node", context=context)
    loop.loop.add_node(node)
    seen: list[object] = []
    causes: list[int] = []
    subscriptions = [
        node.create_subscription(Int32, "numbers", lambda message: seen.append(message.data), 10),
        node.create_subscription(Int32, "causes", loop.loop.guarded(lambda _: cause()), 10),
    ]
    numbers, beginnings = (node.create_publisher(Int32, t, 10) for t in ("numbers", "causes"))

    def cause() -> None:
        causes.append(len(seen))
        for number in range(3):
            numbers.publish(Int32(data=number))
        time.sleep(0.2)  # as above
        loop.loop.post_loop_back(loop_back)

    def loop_back() -> None:
        seen.append("loop-back")
        if len(causes) < 4:
            beginnings.publish(Int32())
        else:
            loop.loop.stop()

    def begin() -> None:
        if all(s.get_publisher_count() for s in subscriptions) and all(
            p.get_subscription_count() for p in (numbers, beginnings)
        ):
            beginnings.publish(Int32())
            if is_busy:
                keep_busy()
        else:
            loop.loop.post(begin)

    def keep_busy() -> None:
        loop.loop.post(keep_busy)

    loop.loop.post(begin)
    loop.run()
    node.destroy_node()
    assert seen == [0, 1, 2, "loop-back"] * 4


def test_another_thread_wakes_and_stops_a_loop_that_has_nothing_to_do(loop: Loop) -> None:
    seen: list[threading.Thread] = []

    def event() -> None:
        seen.append(threading.current_thread())
        threading.Thread(target=loop.loop.stop).start()

    threading.Thread(target=lambda: loop.loop.post_from_thread(event)).start()
    loop.run()
    assert seen == [threading.main_thread()]


def test_a_stop_before_the_loop_runs_counts(loop: Loop) -> None:
    loop.loop.stop()
    loop.run()


def test_timers_are_called_when_they_are_due(loop: Loop) -> None:
    due_ns = [time.monotonic_ns() + 30_000_000 * n for n in (1, 2, 3)]
    late_ns: list[int] = []

    def on_due() -> None:
        late_ns.append(time.monotonic_ns() - due_ns.pop(0))
        if not due_ns:
            loop.loop.stop()

    loop.loop.add_timer(lambda: due_ns[0] if due_ns else None, on_due)
    loop.run()
    assert len(late_ns) == 3
    assert min(late_ns) >= 0


@pytest.mark.parametrize(
    ("turn_s", "expected"),
    [(60.0, ["tick", "hook", "hook", "hook"]), (0.0, ["tick", "hook", "tick", "hook"])],
    ids=["short", "long"],
)
def test_a_timer_that_is_always_overdue_alternates_with_long_events(
    turn_s: float, expected: list[str], loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those shorter than a turn that wait are all handled before it, or they would pile up."""
    monkeypatch.setattr(ros_loop, "_TURN_NS", int(turn_s * 1e9))
    seen: list[str] = []

    def hook() -> None:
        seen.append("hook")
        if seen.count("hook") == 3:
            loop.loop.stop()

    def on_due() -> None:
        seen.append("tick")
        if len(seen) == 1:
            for _ in range(3):
                loop.loop.post(hook)

    loop.loop.add_timer(lambda: 1, on_due)
    loop.run()
    assert seen[:4] == expected


def test_without_the_events_executor_a_wait_set_takes_its_place(
    context: rclpy.Context, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, EVENTS, None)  # as if it had been removed
    executor = make_executor(context, print)
    assert isinstance(executor, WaitSetExecutor)
    executor.shutdown(0)
    assert capfd.readouterr().err.count("falling back to a wait set") == 1


def test_with_an_events_executor_that_has_changed_too(
    context: rclpy.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{EVENTS}.EventsExecutor", lambda *, context: object())
    executor = make_executor(context, print)
    assert isinstance(executor, WaitSetExecutor)
    executor.shutdown(0)


def test_a_turn_stands_in_the_queue_itself_and_no_task_for_it(context: rclpy.Context) -> None:
    """What a loop-back costs depends on that; it goes on working where rclpy changes."""
    turn = Turn(lambda: None)
    executor = make_executor(context, print)
    assert executor.create_task(turn) is turn
    assert isinstance(executor.create_task(lambda: None), rclpy.task.Task)
    executor.shutdown(0)


def test_an_unknown_executor_is_refused(
    context: rclpy.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(EXECUTOR_VARIABLE, "fast")
    with pytest.raises(EnvironmentFault, match="'events' or 'wait_set'"):
        make_executor(context, print)


@pytest.mark.parametrize("backend", ["process", "in-process"])
def test_a_project_runs_on_a_wait_set(
    backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(EXECUTOR_VARIABLE, "wait_set")
    run = launch(EXAMPLES / "2_synchronisation/tennis", "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    for connection in run.record["connections"]:
        assert connection["sent"] == connection["received"] > 0, connection


def test_a_task_that_fails_is_an_error_and_does_not_end_the_process(
    loop: Loop, context: rclpy.Context
) -> None:
    node = RosNode("node", context=context)
    loop.loop.add_node(node)

    def fail() -> None:
        raise ValueError("in a task")

    async def fail_later() -> None:
        fail()

    loop.loop.post(lambda: node.executor.create_task(fail))
    loop.loop.post(lambda: node.executor.create_task(fail_later))
    loop.loop.post(lambda: loop.loop.post_loop_back(loop.loop.stop))
    with pytest.raises(ValueError, match="in a task"):
        loop.run()
    node.destroy_node()


@pytest.mark.parametrize("by", ["task", "event", "timer", "coroutine"])
def test_a_coroutine_goes_on_whatever_has_set_its_future(
    by: str, loop: Loop, context: rclpy.Context
) -> None:
    """Nothing of ROS follows; rclpy's executor would look at it again only then."""
    node = RosNode("node", context=context)
    loop.loop.add_node(node)
    future, further, due = Future(), Future(), [time.monotonic_ns() + 50_000_000]
    answer = functools.partial(future.set_result, None)

    async def stop_then() -> None:
        await future
        loop.loop.stop()

    async def answer_then() -> None:
        await further
        answer()

    def answer_once() -> None:
        due.clear()
        answer()

    node.executor.create_task(stop_then)
    if by == "task":
        node.executor.create_task(answer)
    elif by == "event":
        loop.loop.post(answer)
    elif by == "timer":
        loop.loop.add_timer(lambda: due[0] if due else None, answer_once)
    else:
        node.executor.create_task(answer_then)
        node.executor.create_task(functools.partial(further.set_result, None))
    loop.run()
    node.destroy_node()


def test_a_coroutine_that_goes_on_and_fails_is_an_error_once(context: rclpy.Context) -> None:
    """The executor asks for its error later, and would end the process by SIGSEGV."""
    loop = Loop(context)
    node = RosNode("node", context=context)
    loop.loop.add_node(node)
    future, told = Future(), []

    async def fail_then() -> None:
        await future
        raise ValueError("in a coroutine")

    async def hear_of_it(task: Task) -> None:
        try:
            await task
        except ValueError as error:
            told.append(str(error))
        node.create_timer(0.05, loop.loop.stop)  # with which the executor comes back to all tasks

    node.executor.create_task(hear_of_it, node.executor.create_task(fail_then))
    node.executor.create_task(functools.partial(future.set_result, None))
    with pytest.raises(ValueError, match="in a coroutine"):
        loop.run()
    assert (told, len(loop.failures)) == (["in a coroutine"], 1)
    node.destroy_node()


@pytest.mark.parametrize(
    ("event_ms", "has_ticks", "turn_ms"),
    [(0.1, False, 1.1), (2.0, False, 12.0), (30.0, False, 30.0), (2.0, True, 2.0)],
    ids=["short events", "long events", "an event that is longer", "beside ticks"],
)
def test_ros_waits_a_millisecond_or_as_long_as_a_few_of_the_long_events(
    event_ms: float, has_ticks: bool, turn_ms: float, loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_ns = [0]
    clock = SimpleNamespace(monotonic_ns=lambda: clock_ns[0], monotonic=time.monotonic)
    monkeypatch.setattr(ros_loop, "time", clock)
    if has_ticks:
        loop.loop.add_timer(lambda: None, lambda: None)
    waited_ns: list[int] = []

    def event() -> None:
        clock_ns[0] += round(event_ms * 1e6)
        if waited_ns:
            loop.loop.stop()
        else:
            loop.loop.post(event)

    def begin() -> None:
        loop.loop.post_from_thread(lambda: waited_ns.append(clock_ns[0]))
        event()

    loop.loop.post(begin)
    loop.run()
    assert waited_ns == [round(turn_ms * 1e6)]


# ------------------------------------------------------------------ arrivals first


class Hooked:
    """A node whose hooks and callbacks are played by the test; ``seen`` is what has happened.

    ``send`` publishes a number and waits until it has reached the node, which nobody is told.
    """

    def __init__(self, loop: RosLoop, context: rclpy.Context) -> None:
        self.loop, self.node = loop, LeanNode("node", context)
        self.seen: list[object] = []
        loop.add_node(self.node)
        loop.expect_arrivals()
        self._publishers: dict[str, Publisher] = {}

    def publisher(self, topic: str) -> None:
        self._publishers[topic] = self.node.create_publisher(Int32, topic, 10)

    def send(self, topic: str, *numbers: int) -> None:
        for number in numbers:
            self._publishers[topic].publish(Int32(data=number))
        time.sleep(0.2)  # nothing can be asked whether it has arrived without taking it

    def begin(self, event: Callable[[], None]) -> None:
        """Once all are connected."""
        if all(each.get_subscription_count() for each in self._publishers.values()):
            event()
        else:
            self.loop.post(lambda: self.begin(event))

    def execute(self, name: str) -> None:
        self.seen.append(name)
        self.loop.note_execution()


def test_what_has_arrived_while_a_hook_ran_is_taken_in_before_the_next(
    loop: Loop, context: rclpy.Context
) -> None:
    hooked = Hooked(loop.loop, context)
    taken_in: list[bool] = []

    def receive(message: Int32) -> None:
        hooked.seen.append(message.data)
        taken_in.append(loop.loop.has_taken_in)

    hooked.node.create_subscription(Int32, "data", loop.loop.guarded(receive), 10)
    hooked.publisher("data")

    def first() -> None:
        assert loop.loop.has_taken_in
        hooked.send("data", 1, 2, 3)
        hooked.execute("hook")
        assert not loop.loop.has_taken_in
        loop.loop.post_loop_back(second)

    def second() -> None:
        assert loop.loop.has_taken_in
        hooked.seen.append("next")
        loop.loop.stop()

    loop.loop.post(lambda: hooked.begin(first))
    loop.run()
    hooked.node.destroy_node()
    assert hooked.seen == ["hook", 1, 2, 3, "next"]
    assert taken_in == [False] * 3


def test_callbacks_that_keep_coming_do_not_put_off_the_next_hook(
    loop: Loop, context: rclpy.Context
) -> None:
    """A callback that takes longer than there is between two of its messages starves nothing."""
    hooked = Hooked(loop.loop, context)
    PluginCallbacks(hooked.node, loop.loop, lambda: None, lambda *_: None)
    hooked.publisher("data")

    def callback(message: Int32) -> None:
        hooked.seen.append("callback")
        hooked.send("data", message.data + 1, message.data + 2)  # meanwhile

    hooked.node.create_subscription(Int32, "data", callback, 1)

    def hook() -> None:
        hooked.execute("hook")
        if hooked.seen.count("hook") == 4:
            loop.loop.stop()
        loop.loop.post_loop_back(hook)

    def first() -> None:
        hooked.send("data", 1)
        hook()

    loop.loop.post(lambda: hooked.begin(first))
    loop.run()
    hooked.node.destroy_node()
    assert hooked.seen[0] == "hook"
    hooks = [place for place, name in enumerate(hooked.seen) if name == "hook"]
    assert len(hooks) == 4
    assert all(after - before <= 3 for before, after in itertools.pairwise(hooks)), hooked.seen
    assert "callback" in hooked.seen


def test_a_timer_that_is_always_overdue_keeps_no_event_waiting(loop: Loop) -> None:
    """All that waited when its turn came is handled before it, loop-backs included."""
    seen: list[str] = []

    def on_due() -> None:
        seen.append("timer")
        if seen.count("timer") == 3:
            loop.loop.stop()
        for kind in ("event", "other"):
            loop.loop.post(lambda kind=kind: seen.append(kind))  # type: ignore[misc]
            loop.loop.post_loop_back(lambda: seen.append("loop-back"))

    loop.loop.add_timer(lambda: 1, on_due)
    loop.run()
    a_round = ["timer", "event", "loop-back", "other", "loop-back"]
    assert seen == [*a_round, *a_round, "timer"]
