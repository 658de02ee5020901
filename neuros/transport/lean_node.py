"""The lean ROS node of a NeuROS node, and the callbacks that a plugin registers there.

It is rclpy's own, served by NeuROS and by no other executor. A hook that waits for a callback would
wait for what comes after the hook: an error says so.

It has services for parameters only where it has some. rclpy gives each node six of them: twelve of
some twenty endpoints, which every process of a domain hears of from every other, and more than half
of what has to be found before the first packet.
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
from neuros.transport.executors import EXECUTOR_VARIABLE
from neuros.transport.rclpy_patches import end_discovery
from neuros.transport.ros_loop import RosLoop

_NO_NAMES = Names()
_NOTHING: Mapping[str, Value] = types.MappingProxyType({})
_OF_ROS = "use_sim_time"  # rclpy declares it itself

Fail: TypeAlias = Callable[[Any, BaseException], None]

# Methods that take a callback, and its place among their arguments.
_CREATORS = (("create_timer", 1), ("create_service", 2))


class LeanNode(RosNode):  # type: ignore[misc]
    """Offers its parameters to others as soon as there is one besides those of ROS.

    Args:
        names: namespace and remapping rules, which hold for all that is created on it.
        parameters: declared from the start. A plugin may declare them once more, with a description
            for instance, and gets the value that is given here.
    """

    def __init__(
        self,
        name: str,
        context: Context,
        names: Names = _NO_NAMES,
        parameters: Mapping[str, Value] = _NOTHING,
    ) -> None:
        self._is_complete = False
        self._wrap: Callable[[Any], Any] | None = None
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
        return found if found is None or self._wrap is None else _Tasks(found, self._wrap)

    @executor.setter
    def executor(self, executor: Any) -> None:
        current = super().executor
        if current is not None and executor is not None and executor is not current:
            executor.remove_node(self)  # it has counted the node in already
            raise _not_for_plugins(f"rclpy.spin or {type(executor).__name__}.add_node")
        RosNode.executor.fset(self, executor)

    def wrap_tasks(self, wrap: Callable[[Any], Any]) -> None:
        """Wrap all callbacks that run as tasks from now on."""
        self._wrap = wrap


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
    """The ROS node of a node of a project."""
    return LeanNode(file.node.name, context, file.names, file.node.parameters)


class PluginCallbacks:
    """Wraps the callbacks of all that a plugin creates on its ROS node from now on.

    What they raise must not reach the executor of rclpy. It prints a traceback of its own, and
    where a task has failed (a coroutine, a callback of a future) it ends the process by SIGSEGV.

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
        self._thread = threading.get_ident()  # in which the loop runs hooks and callbacks
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
                wrapped = _rationed(wrapped, self._loop, depth)
            return create(msg_type, topic, wrapped, qos_profile, *rest, **keywords)

        return subscribing

    def _answering(self, send_response: Callable[..., None]) -> Any:
        """A service does not answer after a failure."""

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
            client.call = self._calling_and_waiting(client.call)
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

    def _calling_and_waiting(self, call: Callable[..., Any]) -> Any:
        @functools.wraps(call)
        def calling(*arguments: Any, **keywords: Any) -> Any:
            if threading.get_ident() == self._thread:
                raise _not_for_plugins("client.call")
            return call(*arguments, **keywords)

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
                    steps = callback(*arguments, **keywords)
                    return await _EnteringSteps(steps, self._enter, self._loop.note_execution)
                except BaseException as error:
                    self._give_up(callback, error)
            return arguments[-1] if arguments else None

        return entering

    def _give_up(self, callback: Any, error: BaseException) -> None:
        self._is_over = True
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
        """The next step."""
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

    rclpy queues an event for each message, and each event takes the newest there is. So with a
    callback that takes longer than there is between two messages, twice as many would come before
    each hook as before the last one. What comes beyond ``depth`` waits for the next turn, and takes
    the place of what is older, as it would in DDS. A depth of 0 (KEEP_ALL) drops nothing.
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


def _refuse_guard_condition(*_: Any, **__: Any) -> Any:
    raise NodeError(_not_served("create_guard_condition", "guard conditions"))


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
