"""The lean ROS node of a NeuROS node, and the callbacks that a plugin registers there.

The node is rclpy's own, served by NeuROS's executor alone. Callbacks run between hooks, so a hook
that waits for a callback would wait for ever: it gets an error instead.

The node has services for parameters only if it has parameters. rclpy gives each node six of them:
twelve of some twenty endpoints that every process of a domain has to find before the first packet.
"""

from __future__ import annotations

import functools
import inspect
import threading
import types
from collections import deque
from collections.abc import Callable, Coroutine, Generator, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import rclpy
import service_msgs.msg  # noqa: F401  # rclpy imports it for any service, and NumPy with it
from rclpy.context import Context
from rclpy.exceptions import ParameterNotDeclaredException as ParameterNotDeclaredException
from rclpy.node import Node as RosNode
from rclpy.parameter import Parameter as Parameter
from rclpy.parameter_service import ParameterService
from rclpy.subscription import Subscription

from neuros.errors import NO_WAITING, NodeError
from neuros.project.model import NodeFile, Value
from neuros.project.names import Names
from neuros.transport.rclpy_patches import end_discovery
from neuros.transport.ros_loop import EXECUTOR_VARIABLE, RosLoop

_NO_NAMES = Names()
_NOTHING: Mapping[str, Value] = types.MappingProxyType({})
_OF_ROS = "use_sim_time"  # rclpy declares it itself

Fail: TypeAlias = Callable[[Any, BaseException], None]


class LeanNode(RosNode):  # type: ignore[misc]
    """Offers its parameters to others as soon as there is one besides those of ROS.

    Args:
        names: namespace and remapping rules, which hold for all that is created on it.
        parameters: declared from the start. A plugin may declare them once more, with a description
            for instance, and gets the value that is given here.

    Attributes:
        callbacks: guards what a plugin creates on the node; ``None`` before the plugin has it.
    """

    callbacks: PluginCallbacks | None = None

    def __init__(
        self,
        name: str,
        context: Context,
        names: Names = _NO_NAMES,
        parameters: Mapping[str, Value] = _NOTHING,
    ) -> None:
        self._is_complete = False
        self._declared_for_project = {*parameters} - {_OF_ROS}
        self._parameter_service: ParameterService | None = None
        super().__init__(
            name,
            context=context,
            namespace=names.namespace,
            cli_args=names.ros_arguments,
            start_parameter_services=False,
            parameter_overrides=[Parameter(key, value=value) for key, value in parameters.items()],
            automatically_declare_parameters_from_overrides=True,
        )
        self._is_complete = True
        if parameters:
            self._parameter_service = ParameterService(self)

    def declare_parameters(
        self, namespace: str, parameters: Sequence[Any], *arguments: Any, **keywords: Any
    ) -> Any:
        """As in rclpy, which comes here for a single one, too."""
        if self._is_complete:
            for name, *_ in parameters:
                full = f"{namespace}.{name}" if namespace else name
                if full in self._declared_for_project:
                    self._declared_for_project.remove(full)
                    self.undeclare_parameter(full)
        declared = super().declare_parameters(namespace, parameters, *arguments, **keywords)
        if self._is_complete and self._parameter_service is None:
            self._parameter_service = ParameterService(self)
        return declared

    @property
    def executor(self) -> Any:
        """The executor of the node; tasks that a plugin creates there are part of the node."""
        found = super().executor
        if found is None or self.callbacks is None:
            return found
        return _Tasks(found, self.callbacks.wrapped)

    @executor.setter
    def executor(self, executor: Any) -> None:
        current = super().executor
        if current is not None and executor is not None and executor is not current:
            executor.remove_node(self)  # it has counted the node in already
            raise _not_for_plugins(f"rclpy.spin or {type(executor).__name__}.add_node")
        RosNode.executor.fset(self, executor)

    def create_timer(
        self, timer_period_sec: float, callback: Any, *rest: Any, **keywords: Any
    ) -> Any:
        timer = super().create_timer(timer_period_sec, self._new(callback), *rest, **keywords)
        if self.callbacks is not None:
            self.callbacks.loop.add_ros_timer(timer)
        return timer

    def destroy_timer(self, timer: Any) -> bool:
        if self.callbacks is not None:
            self.callbacks.loop.remove_ros_timer(timer)
        is_destroyed: bool = super().destroy_timer(timer)
        return is_destroyed

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **keywords: Any) -> Any:
        """As in rclpy; a service does not answer after a failure of its node."""
        callbacks = self.callbacks
        if callbacks is None:
            return super().create_service(srv_type, srv_name, callback, **keywords)
        if callbacks.loop.is_limited and inspect.iscoroutinefunction(callback):
            raise NodeError(_not_served("create_service", "a coroutine as its callback"))
        service = super().create_service(srv_type, srv_name, self._new(callback), **keywords)
        send_response = service.send_response

        def answer(*arguments: Any) -> None:
            if not callbacks.is_closed:
                send_response(*arguments)

        service.send_response = answer
        return service

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **keywords: Any
    ) -> Subscription:
        guarded = self._new(callback)
        if guarded is not callback and not inspect.iscoroutinefunction(callback):
            depth = qos_profile if isinstance(qos_profile, int) else qos_profile.depth
            assert self.callbacks is not None
            guarded = _rationed(guarded, self.callbacks.loop, depth)
        return super().create_subscription(msg_type, topic, guarded, qos_profile, **keywords)

    def create_client(self, *arguments: Any, **keywords: Any) -> Any:
        """As in rclpy; a call that waits is an error in the thread of hooks."""
        if self.callbacks is None:
            return super().create_client(*arguments, **keywords)
        self.callbacks.expect_arrivals()
        client = super().create_client(*arguments, **keywords)
        self.callbacks.guard_client(client)
        return client

    def create_guard_condition(self, *arguments: Any, **keywords: Any) -> Any:
        """As in rclpy, unless the executor does not serve them."""
        if self.callbacks is not None and self.callbacks.loop.is_limited:
            raise NodeError(_not_served("create_guard_condition", "guard conditions"))
        return super().create_guard_condition(*arguments, **keywords)

    def add_waitable(self, waitable: Any) -> None:
        """As in rclpy: for the server or client of an action, or events of DDS."""
        waitable.execute = self._new(waitable.execute)
        super().add_waitable(waitable)

    def _new(self, callback: Any) -> Any:
        """The callback of something that is being created, guarded if a plugin creates it."""
        if self.callbacks is None:
            return callback
        self.callbacks.expect_arrivals()
        return self.callbacks.wrapped(callback)


class _Tasks:
    """An executor that wraps the tasks it is given."""

    def __init__(self, executor: Any, wrap: Callable[[Any], Any]) -> None:
        self._executor = executor
        self._wrap = wrap

    def create_task(self, callback: Any, *arguments: Any, **keywords: Any) -> Any:
        return self._executor.create_task(self._wrap(callback), *arguments, **keywords)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("spin"):
            raise _not_for_plugins(f"get_ros_node().executor.{name}")
        return getattr(self._executor, name)


def lean_node(file: NodeFile, context: Context) -> LeanNode:
    return LeanNode(file.node.name, context, file.names, file.node.parameters)


class PluginCallbacks:
    """Guards the callbacks of all that a plugin creates on its ROS node from now on.

    What they raise must not reach the executor of rclpy: it prints a traceback of its own, and
    where a task has failed (a coroutine, a callback of a future) it ends the process by SIGSEGV.

    Args:
        loop: serves the node.
        enter: called before each part of a callback that runs in one go.
        fail: is given a callback and what it has raised; no other is called from then on.
        thread: the loop runs hooks and callbacks in it; by default this one.

    Attributes:
        has_any: whether the plugin has created anything.
    """

    def __init__(
        self,
        ros_node: LeanNode,
        loop: RosLoop,
        enter: Callable[[], None],
        fail: Fail,
        thread: int | None = None,
    ) -> None:
        self.loop = loop
        self.is_closed = self.has_any = False
        self._enter = enter
        self._fail = fail
        self._thread = threading.get_ident() if thread is None else thread
        ros_node.callbacks = self

    def expect_arrivals(self) -> None:
        """The plugin creates something, which ROS will call."""
        self.has_any = True
        self.loop.expect_arrivals()

    def close(self) -> None:
        """Call none of them any more: the node has ended."""
        self.is_closed = True

    def wrapped(self, callback: Any) -> Any:
        """``callback`` as a part of its node. It returns its last argument where it has failed."""
        if not callable(callback):
            return callback
        if inspect.iscoroutinefunction(callback):

            @functools.wraps(callback)
            async def entering_steps(*arguments: Any, **keywords: Any) -> Any:
                if not self.is_closed:
                    try:
                        steps = callback(*arguments, **keywords)
                        return await _EnteringSteps(steps, self._enter, self.loop.note_execution)
                    except BaseException as error:
                        self._give_up(callback, error)
                return arguments[-1] if arguments else None

            return entering_steps

        @functools.wraps(callback)  # rclpy asks for its signature
        def entering(*arguments: Any, **keywords: Any) -> Any:
            if not self.is_closed:
                self._enter()
                try:
                    return callback(*arguments, **keywords)
                except BaseException as error:
                    self._give_up(callback, error)
                finally:
                    self.loop.note_execution()
            return arguments[-1] if arguments else None

        return entering

    def guard_client(self, client: Any) -> None:
        """Guard callbacks of a client's futures; refuse calls that wait in the loop's thread."""
        call, call_async = client.call, client.call_async

        def guarded_call(*arguments: Any, **keywords: Any) -> Any:
            if threading.get_ident() == self._thread:
                raise _not_for_plugins("client.call")
            return call(*arguments, **keywords)

        def guarded_call_async(request: Any) -> Any:
            future = call_async(request)
            add = future.add_done_callback
            future.add_done_callback = lambda callback: add(self.wrapped(callback))
            return future

        client.call, client.call_async = guarded_call, guarded_call_async

    def _give_up(self, callback: Any, error: BaseException) -> None:
        self.is_closed = True
        self._fail(callback, error)


class _EnteringSteps(Generator[Any, Any, Any]):
    """Enters the node for each step of a coroutine: code of another node may run between two steps.

    Attributes:
        cr_await: the coroutine, by the name under which coroutines show what they wait for.
    """

    def __init__(
        self,
        coroutine: Coroutine[Any, Any, Any],
        enter: Callable[[], object],
        note_execution: Callable[[], object],
    ) -> None:
        self.cr_await = coroutine
        self._enter = enter
        self._note_execution = note_execution

    def __await__(self) -> Generator[Any, Any, Any]:
        return self

    def send(self, value: Any) -> Any:
        self._enter()
        try:
            return self.cr_await.send(value)
        finally:
            self._note_execution()

    def throw(self, *error: Any) -> Any:
        """Raise in the coroutine; so does closing it."""
        return self.cr_await.throw(*error)


def _rationed(callback: Callable[..., Any], loop: RosLoop, depth: int) -> Callable[..., Any]:
    """A callback of a subscription, called for at most ``depth`` messages in one turn of the loop.

    rclpy queues an event for each message. With a callback that takes longer than the time between
    two messages, the messages before each hook would double from one hook to the next. Messages
    beyond ``depth`` wait for the next turn and replace older ones, as in DDS. A depth of 0
    (KEEP_ALL) drops nothing.
    """
    waiting: deque[tuple[Any, ...]] = deque(maxlen=depth or None)
    turn, left = -1, 0

    def may_call() -> bool:
        nonlocal turn, left
        if turn != loop.turns:
            turn, left = loop.turns, max(depth, 1)
        left -= 1
        return left >= 0

    def catch_up() -> None:
        while waiting and may_call():
            callback(*waiting.popleft())
        if waiting:
            loop.post(catch_up)

    @functools.wraps(callback)  # rclpy asks for its signature
    def receive(*message: Any) -> None:
        if not waiting and may_call():
            callback(*message)
            return
        if not waiting:
            loop.post(catch_up)
        waiting.append(message)

    return receive


def _not_served(name: str, what: str) -> str:
    return (
        f"get_ros_node().{name}: rclpy's EventsExecutor does not serve {what};"
        f" {EXECUTOR_VARIABLE}=wait_set chooses an executor that does"
    )


def _not_for_plugins(name: str) -> NodeError:
    return NodeError(f"{name}: {NO_WAITING}")


def give_up(context: Context, ros_nodes: Iterable[RosNode]) -> None:
    """Destroy all nodes of a context, and shut it down."""
    ros_nodes = list(ros_nodes)
    if ros_nodes:
        end_discovery(ros_nodes[0])  # they have one participant
    for ros_node in ros_nodes:
        ros_node.destroy_node()
    rclpy.shutdown(context=context)
