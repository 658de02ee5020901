"""The ROS node of a NeuROS node: rclpy's own, served by NeuROS and by nothing else.

Who waits in a hook for a callback (``rclpy.spin_until_future_complete``) waits for what comes after
the hook: that is refused in a sentence.

It has services for parameters only where it has some. rclpy gives each node six of them: twelve of
some twenty endpoints, which every process of a domain hears of from every other, and more than half
of what has to be found before the first packet.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService

from neuros.errors import NodeError
from neuros.project.model import NodeFile, Value
from neuros.project.names import Names

__all__ = [
    "LeanNode",
    "Parameter",
    "ParameterNotDeclaredException",
    "lean_node",
    "not_in_hooks",
    "without_spinning",
]

_NO_NAMES = Names()
_NOTHING: Mapping[str, Value] = MappingProxyType({})
_OF_ROS = "use_sim_time"  # rclpy declares it itself

_SPINNING = ("spin", "spin_once", "spin_until_future_complete")
_lock = threading.Lock()
_threads: list[int] = []
"""Threads in which nothing may wait for callbacks; a thread is in there as often as it asked."""
_replaced: dict[str, Callable[..., Any]] = {}


class LeanNode(Node):  # type: ignore[misc]
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
        """What serves the node; tasks that a plugin has it run are parts of the node, too."""
        found = super().executor
        return found if found is None or self._wrap is None else _Tasks(found, self._wrap)

    @executor.setter
    def executor(self, executor: Any) -> None:
        current = super().executor
        if current is not None and executor is not None and executor is not current:
            raise _not_for_plugins(f"{type(executor).__name__}.add_node")
        Node.executor.fset(self, executor)

    def wrap_tasks(self, wrap: Callable[[Any], Any]) -> None:
        """Wrap whatever is to run as a task from now on."""
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


@contextmanager
def without_spinning() -> Iterator[None]:
    """Meanwhile, ``rclpy.spin`` and the like are refused in this thread, and work in all others."""
    thread = threading.get_ident()
    with _lock:
        if not _threads:
            for name in _SPINNING:
                _replaced[name] = getattr(rclpy, name)
                setattr(rclpy, name, not_in_hooks(_replaced[name], f"rclpy.{name}"))
        _threads.append(thread)
    try:
        yield
    finally:
        with _lock:
            _threads.remove(thread)
            if not _threads:
                for name, replaced in _replaced.items():
                    setattr(rclpy, name, replaced)


def not_in_hooks(wait: Callable[..., Any], name: str) -> Callable[..., Any]:
    """``wait``, refused in threads that run hooks."""

    @functools.wraps(wait)
    def waiting(*arguments: Any, **keywords: Any) -> Any:
        if threading.get_ident() in _threads:
            raise _not_for_plugins(name)
        return wait(*arguments, **keywords)

    return waiting


def _not_for_plugins(name: str) -> NodeError:
    return NodeError(
        f"{name}: NeuROS serves the callbacks of a node itself, between its hooks, so a hook must"
        " not wait for them: let it return, and take an answer with"
        " client.call_async(request).add_done_callback(function)"
    )
