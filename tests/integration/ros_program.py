"""An ordinary ROS program in the process of the tests: it knows nothing of NeuROS."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from neuros.transport.lean_node import give_up
from neuros.transport.messages import message_class

message_class("std_msgs/msg/Int32")  # loads parts of ROS that warn, where warnings are errors

_ANSWER_S = 2.0  # rmw_fastrtps gives an answer up after 0.1 s where it has not found the client


class RosProgram:
    """A node in a context of its own."""

    def __init__(self, name: str = "ros_program", domain_id: int | None = None) -> None:
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def listen(self, topic: str, type_name: str) -> list[Any]:
        """What is heard on a topic from now on; grows."""
        heard: list[Any] = []
        self.node.create_subscription(message_class(type_name), topic, heard.append, 10)
        return heard

    def call(self, service: type, name: str, request: Any, timeout_s: float = 20.0) -> Any:
        """Call a service until it answers, with one client for all calls of it.

        A client finds a service before that has found the client, and then the answer is lost. So
        the first request is one that can be repeated.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(service, name)
        client = self._clients[name]
        self.spin_until(client.service_is_ready, timeout_s)
        deadline_s = time.monotonic() + timeout_s
        while True:
            future = client.call_async(request)
            again_s = min(time.monotonic() + _ANSWER_S, deadline_s)
            while not future.done() and time.monotonic() < again_s:
                self.spin(0.01)
            if future.done():
                return future.result()
            client.remove_pending_request(future)
            assert time.monotonic() < deadline_s, f"{name}: no answer within {timeout_s:g} s"

    def spin(self, timeout_s: float = 0.0) -> None:
        """Handle one event, if there is one."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def spin_until(self, condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
        """Handle events until a condition holds."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline_s, f"not within {timeout_s:g} s"
            self.spin(0.01)

    def close(self) -> None:
        """End it."""
        self._executor.shutdown()
        give_up(self._context, [self.node])

    def __enter__(self) -> RosProgram:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
