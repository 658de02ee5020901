"""A middleware that carries nothing, for one node without neighbours, with a real ROS node.

The caller plays the neighbours: it decides which packets arrive, and when. Packets that the node
sends go nowhere. The ROS node is one of rclpy, so that plugins find its whole interface, but
callbacks that a plugin registers there are not served.
"""

from __future__ import annotations

import queue
from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from neuros.ports import Inbox
from neuros.project.model import Connection, NodeFile, Port
from neuros.runtime.local import WithoutPeers
from neuros.transport.lean_node import give_up, lean_node
from neuros.transport.messages import RosPackets

Event = Callable[[], None]


class HeldLoop:
    """A loop that handles nothing by itself (:class:`neuros.ports.EventLoop`).

    Attributes:
        from_threads: events that threads have posted.
        has_taken_in: always true, since nothing comes by itself.

    Args:
        post, post_loop_back: where events go that the node posts itself.
    """

    has_taken_in = True

    def __init__(
        self, post: Callable[[Event], None], post_loop_back: Callable[[Event], None]
    ) -> None:
        self.post = post
        self.post_loop_back = post_loop_back
        self.from_threads: queue.SimpleQueue[Event] = queue.SimpleQueue()

    @property
    def has_waiting_events(self) -> bool:
        """Nothing waits for this loop."""
        return False

    def note_execution(self) -> None:
        """Nothing has arrived meanwhile."""

    def post_from_thread(self, event: Event) -> None:
        """Keep an event until the caller takes it."""
        self.from_threads.put(event)

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        """Timers are up to the caller."""

    def run(self) -> None:
        """There is nothing to run."""

    def stop(self) -> None:
        """There is nothing to stop."""


class _NullTransport:
    """A transport that carries nothing (:class:`neuros.ports.Transport`)."""

    digests: Mapping[Connection, array[int]] = {}
    compressed: Mapping[str, tuple[int, int]] = {}

    def open(self, inbox: Inbox) -> None: ...
    def send_external(self, port: Port, packet: Any) -> None: ...
    def close(self) -> None: ...

    def note_execution(self) -> None: ...

    def give_way(self) -> None: ...

    def has_taken_in(self) -> bool:
        return True

    def sender(self, connections: Sequence[Connection]) -> Callable[[Any], None]:
        return _nowhere

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return _nowhere

    def waiting_for(self) -> Sequence[Connection]:
        return ()


def _nowhere(_: object) -> None:
    """Carries a packet, or an acknowledgement."""


class NullMiddleware(WithoutPeers):
    """The middleware of one node that has no neighbours (:class:`neuros.ports.Middleware`)."""

    def __init__(self, file: NodeFile, loop: HeldLoop) -> None:
        self.loop = loop
        self.packets = RosPackets()
        self._context = rclpy.Context()
        rclpy.init(
            args=["--ros-args", "--disable-external-lib-logs"],
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._ros_node = lean_node(file, self._context)

    def transport(self, file: NodeFile) -> _NullTransport:
        return _NullTransport()

    def ros_node(self, file: NodeFile) -> Any:
        return self._ros_node

    def close(self) -> None:
        """Give up ROS."""
        give_up(self._context, [self._ros_node])
