"""What a plugin registers with ROS: a failure is reported once, with its callback."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from launching import BACKENDS, launch
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from neuros.backends.domain import choose_domain
from neuros.errors import NodeError
from neuros.node.failures import callback_error
from neuros.transport.lean_node import LeanNode, PluginCallbacks, give_up
from neuros.transport.messages import message_class
from neuros.transport.ros_loop import EXECUTOR_VARIABLE, RosLoop

LIMIT_S = 20.0


class Plugin:
    """A ROS node in the hands of a plugin, served by a loop.

    Attributes:
        failures: callbacks and what they have raised.
        entered: how often the node was entered.
    """

    def __init__(self, context: rclpy.Context) -> None:
        self.failures: list[tuple[Any, BaseException]] = []
        self.outside: list[BaseException] = []
        self.entered = 0
        self.loop = RosLoop(context, self._fail_outside)
        self.ros = LeanNode("plugin", context)
        self.loop.add_node(self.ros)
        self.callbacks = PluginCallbacks(self.ros, self.loop, self._enter, self._fail)

    def run(self) -> None:
        """Until a callback has failed, or :meth:`stop`."""
        limit = threading.Timer(LIMIT_S, self.loop.stop)
        limit.start()
        self.loop.run()
        is_in_time = limit.is_alive()
        limit.cancel()
        assert is_in_time, "nothing has happened"

    def stop(self, *_: Any) -> None:
        self.loop.stop()

    def _enter(self) -> None:
        self.entered += 1

    def _fail(self, callback: Any, error: BaseException) -> None:
        self.failures.append((callback, error))
        self.loop.stop()

    def _fail_outside(self, error: BaseException) -> None:
        self.outside.append(error)
        self.loop.stop()

    def ask_itself(self, then: Callable[[Any], None]) -> None:
        """Call the service ``ask`` as soon as it is there."""
        client = self.ros.create_client(Trigger, "ask")

        def ask() -> None:
            if client.service_is_ready():
                timer.cancel()
                then(client.call_async(Trigger.Request()))

        timer = self.ros.create_timer(0.01, ask)


@pytest.fixture(params=["events", "wait_set"])
def plugin(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Plugin]:
    monkeypatch.setenv(EXECUTOR_VARIABLE, request.param)
    message_class("std_msgs/msg/Int32")  # ROS's first conversion of a type imports what warns
    with choose_domain(None, {}, False) as domain:
        context = rclpy.Context()
        rclpy.init(
            context=context, domain_id=domain.id, signal_handler_options=SignalHandlerOptions.NO
        )
        made = Plugin(context)
        yield made
        made.callbacks.close()
        made.loop.close()
        give_up(context, [made.ros])


def fail(*_: Any) -> None:
    raise ValueError("on purpose")


async def fail_later(*_: Any) -> None:
    fail()


def by_timer(plugin: Plugin) -> None:
    plugin.ros.create_timer(0.001, fail)


def by_coroutine(plugin: Plugin) -> None:
    plugin.ros.create_timer(0.001, fail_later)


def by_subscription(plugin: Plugin) -> None:
    publisher = plugin.ros.create_publisher(Int32, "topic", 10)
    plugin.ros.create_subscription(Int32, "topic", fail, 10)
    plugin.ros.create_timer(0.01, lambda: publisher.publish(Int32()))


def by_service(plugin: Plugin) -> None:
    plugin.ros.create_service(Trigger, "ask", fail)
    plugin.ask_itself(lambda future: None)


def by_future(plugin: Plugin) -> None:
    plugin.ros.create_service(Trigger, "ask", lambda request, response: response)
    plugin.ask_itself(lambda future: future.add_done_callback(fail))


def by_task(plugin: Plugin) -> None:
    plugin.ros.executor.create_task(fail)


@pytest.mark.parametrize(
    "break_down", [by_timer, by_coroutine, by_subscription, by_service, by_future, by_task]
)
def test_a_failure_is_reported_once_with_its_callback(
    break_down: Callable[[Plugin], None], plugin: Plugin
) -> None:
    break_down(plugin)
    plugin.run()
    plugin.loop.run_for(0.02)
    ((callback, error),) = plugin.failures
    assert not plugin.outside
    assert plugin.entered >= 1
    known = callback_error(error, callback)
    name = "fail_later" if break_down is by_coroutine else "fail"
    assert str(known).endswith(f": callback '{name}': ValueError: on purpose")
    assert str(known).startswith(f"{__file__}:")


def test_what_fails_answers_no_request(plugin: Plugin) -> None:
    answers: list[object] = []
    plugin.ros.create_service(Trigger, "ask", fail)
    plugin.ask_itself(lambda future: future.add_done_callback(answers.append))
    plugin.run()
    plugin.loop.run_for(0.1)
    assert not answers


def test_a_coroutine_is_entered_again_after_it_has_waited(plugin: Plugin) -> None:
    plugin.ros.create_service(Trigger, "ask", lambda request, response: response)
    client = plugin.ros.create_client(Trigger, "ask")
    entered: list[int] = []

    async def ask() -> None:
        if client.service_is_ready() and not entered:
            entered.append(plugin.entered)
            await client.call_async(Trigger.Request())
            entered.append(plugin.entered)
            plugin.stop()

    # Where the executor knows groups, no other callback of the same one runs before this has ended.
    plugin.ros.create_timer(0.01, ask, callback_group=ReentrantCallbackGroup())
    plugin.run()
    assert entered[1] > entered[0]


def test_a_coroutine_goes_on_though_nothing_of_ros_follows(plugin: Plugin) -> None:
    future = Future()

    async def wait() -> None:
        timer.cancel()
        plugin.loop.post(lambda: future.set_result(None))
        await future
        plugin.stop()

    timer = plugin.ros.create_timer(0.01, wait)
    plugin.run()
    assert future.done()


def test_what_the_executor_does_not_serve_is_refused_where_it_is_made(plugin: Plugin) -> None:
    if not plugin.loop.is_limited:
        plugin.ros.create_guard_condition(plugin.stop).trigger()
        plugin.run()
        return
    with pytest.raises(NodeError, match="does not serve guard conditions; NEUROS_EXECUTOR"):
        plugin.ros.create_guard_condition(fail)
    with pytest.raises(NodeError, match="does not serve a coroutine as its callback"):
        plugin.ros.create_service(Trigger, "ask", fail_later)


def test_nothing_is_called_when_the_node_has_ended(plugin: Plugin) -> None:
    plugin.ros.create_timer(0.001, fail)
    plugin.callbacks.close()
    plugin.loop.run_for(0.05)
    assert not plugin.failures


def test_parameters_of_the_project_can_be_declared_again_with_their_value() -> None:
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = LeanNode("node", context, parameters={"gain.p": 1.5, "list": (1, 2)})
    assert node.get_parameter("gain.p").value == 1.5
    assert node.declare_parameter("gain.p", 0.0).value == 1.5
    assert [p.value for p in node.declare_parameters("gain", [("i", 0.5)])] == [0.5]
    with pytest.raises(rclpy.exceptions.ParameterAlreadyDeclaredException):
        node.declare_parameter("gain.p", 0.0)
    assert node.get_parameter("list").type_ == Parameter.Type.INTEGER_ARRAY
    give_up(context, [node])


WAITING = Path(__file__).parent / "waiting"
DO_THIS = (
    "NeuROS serves the callbacks of a node itself, between its hooks, so a hook must not wait for"
    " them: let it return, and take an answer with"
    " client.call_async(request).add_done_callback(function)"
)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_hook_that_waits_for_callbacks_is_told_what_to_do(backend: str, tmp_path: Path) -> None:
    run = launch(WAITING, "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 1, run.output
    assert "waiter.py:56: hook 'end': " in run.record["reason"]
    assert DO_THIS in run.record["reason"]
    *refused, _ = run.said("waiter")
    assert refused == [
        f"refused: {what}: {DO_THIS}"
        for what in (
            "client.call",
            "get_ros_node().executor.spin_once",
            "rclpy.spin or SingleThreadedExecutor.add_node",
            "rclpy.spin or SingleThreadedExecutor.add_node",
        )
    ]


class TestTimersBesideBusyHooks:
    """A hook that begins before a due timer is called makes the timer miss its next time."""

    def test_a_timer_that_is_due_at_the_end_of_a_hook_is_called_before_the_next(
        self, plugin: Plugin
    ) -> None:
        events: list[str] = []
        timer = plugin.ros.create_timer(0.005, lambda: events.append("timer"))

        def hook() -> None:
            limit_s = time.monotonic() + LIMIT_S
            while not timer.is_ready() and time.monotonic() < limit_s:
                time.sleep(0.001)
            events.append("hook")
            plugin.loop.note_execution()
            if events.count("hook") < 30:
                plugin.loop.post(hook)
            else:
                plugin.stop()

        plugin.loop.post(hook)
        plugin.run()
        assert ("hook", "hook") not in {*itertools.pairwise(events)}
        assert not plugin.failures

    def test_hooks_get_their_turn_beside_a_timer_that_is_always_due(self, plugin: Plugin) -> None:
        hooks: list[int] = []

        def tick() -> None:
            limit_s = time.monotonic() + LIMIT_S
            while not timer.is_ready() and time.monotonic() < limit_s:
                time.sleep(0.0001)

        timer = plugin.ros.create_timer(0.001, tick)

        def hook() -> None:
            hooks.append(len(hooks))
            plugin.loop.note_execution()
            if len(hooks) < 30:
                plugin.loop.post(hook)
            else:
                plugin.stop()

        plugin.loop.post(hook)
        plugin.run()
        assert len(hooks) == 30

    def test_timers_that_the_plugin_destroys_do_no_harm(self, plugin: Plugin) -> None:
        known, unknown = (plugin.ros.create_timer(0.001, lambda: None) for _ in range(2))
        events: list[str] = []

        def hook() -> None:
            if not events:
                plugin.ros.destroy_timer(known)
                unknown.destroy()  # without telling the node
            events.append("hook")
            plugin.loop.note_execution()
            if len(events) < 3:
                plugin.loop.post(hook)
            else:
                plugin.stop()

        plugin.loop.post(hook)
        plugin.run()
        assert len(events) == 3
        assert not plugin.failures
        assert not plugin.outside
