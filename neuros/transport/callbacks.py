"""Callbacks that a plugin registers with ROS: run as parts of their node, and never failing in C++.

What they raise must not reach the executor of rclpy. It prints a traceback of its own, and where a
task has failed (a coroutine, what is called when a future is done) it ends the process by SIGSEGV.
So each is wrapped when the plugin hands it over.
"""

from __future__ import annotations

import functools
import inspect
import types
from collections import deque
from collections.abc import Callable, Coroutine, Generator
from typing import Any, TypeAlias

from rclpy.subscription import Subscription

from neuros.errors import NodeError
from neuros.transport.executors import EXECUTOR_VARIABLE
from neuros.transport.lean_node import LeanNode, not_in_hooks
from neuros.transport.ros_loop import RosLoop

Fail: TypeAlias = Callable[[Any, BaseException], None]

# What takes a callback, and at which place of its arguments.
_CREATORS = (("create_timer", 1), ("create_service", 2))


class PluginCallbacks:
    """Wraps the callbacks of all that a plugin creates on its ROS node from now on.

    Args:
        loop: serves the node.
        enter: called before each part of a callback that runs in one go.
        fail: is given a callback and what it has raised; no other is called from then on.
    """

    def __init__(
        self, ros_node: LeanNode, loop: RosLoop, enter: Callable[[], None], fail: Fail
    ) -> None:
        self._loop = loop
        self._enter = enter
        self._fail = fail
        self._is_over = False
        for name, place in _CREATORS:
            setattr(ros_node, name, self._creating(getattr(ros_node, name), name, place))
        ros_node.create_subscription = self._subscribing(ros_node.create_subscription)
        ros_node.create_client = self._creating_client(ros_node.create_client)
        ros_node.add_waitable = self._adding(ros_node.add_waitable)
        if loop.is_limited:
            ros_node.create_guard_condition = _refuse_guard_condition
        ros_node.wrap_tasks(self.wrapped)

    def close(self) -> None:
        """Call none of them any more: the node has ended."""
        self._is_over = True

    def wrapped(self, callback: Any) -> Any:
        """``callback`` as a part of its node. It returns its last argument where it has failed."""
        if not callable(callback):
            return callback
        if inspect.iscoroutinefunction(callback):
            return self._wrapped_coroutine(callback)

        @functools.wraps(callback)  # rclpy asks for its signature
        def entering(*arguments: Any, **keywords: Any) -> Any:
            if not self._is_over:
                self._enter()
                try:
                    return callback(*arguments, **keywords)
                except BaseException as error:
                    self._give_up(callback, error)
                finally:
                    self._loop.note_execution()
            return arguments[-1] if arguments else None

        return entering

    # ------------------------------------------------------------------ what creates something

    def _creating(self, create: Callable[..., Any], name: str, place: int) -> Any:
        is_service = name == "create_service"

        @functools.wraps(create)
        def creating(*arguments: Any, **keywords: Any) -> Any:
            if len(arguments) > place:
                callback = arguments[place]
                arguments = (*arguments[:place], self.wrapped(callback), *arguments[place + 1 :])
            else:
                callback = keywords.get("callback")
                keywords["callback"] = self.wrapped(callback)
            if is_service and self._loop.is_limited and inspect.iscoroutinefunction(callback):
                raise NodeError(_not_served(name, "a coroutine as its callback"))
            self._loop.expect_arrivals()
            made = create(*arguments, **keywords)
            if is_service:
                made.send_response = self._answering(made.send_response)
            return made

        return creating

    def _subscribing(self, create: Callable[..., Subscription]) -> Any:
        @functools.wraps(create)
        def subscribing(
            msg_type: Any, topic: str, callback: Any, qos_profile: Any, *rest: Any, **keywords: Any
        ) -> Subscription:
            self._loop.expect_arrivals()
            wrapped = self.wrapped(callback)
            if callable(callback) and not inspect.iscoroutinefunction(callback):
                depth = qos_profile if isinstance(qos_profile, int) else qos_profile.depth
                wrapped = _Rationed(wrapped, self._loop, depth).receive(callback)
            return create(msg_type, topic, wrapped, qos_profile, *rest, **keywords)

        return subscribing

    def _answering(self, send_response: Callable[..., None]) -> Any:
        """What has failed answers nothing."""

        def answering(*arguments: Any) -> None:
            if not self._is_over:
                send_response(*arguments)

        return answering

    def _creating_client(self, create: Callable[..., Any]) -> Any:
        @functools.wraps(create)
        def creating(*arguments: Any, **keywords: Any) -> Any:
            self._loop.expect_arrivals()
            client = create(*arguments, **keywords)
            client.call_async = self._calling(client.call_async)
            client.call = not_in_hooks(client.call, "client.call")
            return client

        return creating

    def _calling(self, call_async: Callable[[Any], Any]) -> Any:
        @functools.wraps(call_async)
        def calling(request: Any) -> Any:
            future = call_async(request)
            add = future.add_done_callback
            future.add_done_callback = lambda callback: add(self.wrapped(callback))
            return future

        return calling

    def _adding(self, add_waitable: Callable[[Any], None]) -> Any:
        """The server or client of an action, or events of DDS."""

        @functools.wraps(add_waitable)
        def adding(waitable: Any) -> None:
            self._loop.expect_arrivals()
            waitable.execute = self.wrapped(waitable.execute)
            add_waitable(waitable)

        return adding

    # ------------------------------------------------------------------ inside

    def _wrapped_coroutine(self, callback: Callable[..., Coroutine[Any, Any, Any]]) -> Any:
        @functools.wraps(callback)
        async def entering(*arguments: Any, **keywords: Any) -> Any:
            if not self._is_over:
                try:
                    return await self._entering_steps(callback(*arguments, **keywords))
                except BaseException as error:
                    self._give_up(callback, error)
            return arguments[-1] if arguments else None

        return entering

    @types.coroutine
    def _entering_steps(self, steps: Coroutine[Any, Any, Any]) -> Generator[Any, Any, Any]:
        """What runs between two steps of a coroutine may belong to another node."""
        try:
            while True:
                self._enter()
                try:
                    step = steps.send(None)
                finally:
                    self._loop.note_execution()
                yield step
        except StopIteration as end:
            return end.value

    def _give_up(self, callback: Any, error: BaseException) -> None:
        self._is_over = True
        self._fail(callback, error)


class _Rationed:
    """A callback of a subscription, called for at most ``depth`` messages in one turn of the loop.

    rclpy queues an event for each message, and each event takes the newest there is. So with a
    callback that takes longer than there is between two messages, hooks and timers would wait
    ever longer. What comes beyond ``depth`` in a turn waits here for the next one, and takes the
    place of what is older, as it would in DDS. A depth of 0 (KEEP_ALL) drops nothing.
    """

    def __init__(self, callback: Callable[..., Any], loop: RosLoop, depth: int) -> None:
        self._callback = callback
        self._loop = loop
        self._depth = depth
        self._waiting: deque[tuple[Any, ...]] = deque(maxlen=depth or None)
        self._turn = -1
        self._left = 0

    def receive(self, callback: Any) -> Any:
        """What to hand to rclpy, which asks for the signature of the plugin's ``callback``."""

        @functools.wraps(callback)
        def receive(*message: Any) -> None:
            if self._waiting or not self._may_call():
                if not self._waiting:
                    self._loop.post(self._catch_up)
                self._waiting.append(message)
            else:
                self._callback(*message)

        return receive

    def _may_call(self) -> bool:
        if self._turn != self._loop.turns:
            self._turn, self._left = self._loop.turns, max(self._depth, 1)
        self._left -= 1
        return self._left >= 0

    def _catch_up(self) -> None:
        while self._waiting and self._may_call():
            self._callback(*self._waiting.popleft())
        if self._waiting:
            self._loop.post(self._catch_up)


def _refuse_guard_condition(*_: Any, **__: Any) -> Any:
    raise NodeError(_not_served("create_guard_condition", "guard conditions"))


def _not_served(name: str, what: str) -> str:
    return (
        f"get_ros_node().{name}: rclpy's EventsExecutor does not serve {what};"
        f" {EXECUTOR_VARIABLE}=wait_set chooses an executor that does"
    )
