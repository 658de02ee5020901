"""Link between a launcher and its peers, in a project that is started in parts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import neuros.control as control
from neuros.control import Message
from neuros.ports import Middleware, StatePublisher

_LEAVE_S = 4.0


class PeerLink:
    """Link between a launcher and its peers, through the nodes of this process.

    The launcher knows no ROS. So each of its nodes publishes the launcher's state, and tells it
    what nodes elsewhere publish; only in a project that is started in parts.

    Args:
        names: the nodes of this process.
        elsewhere: content of the environment variable.
        tell: sends to the supervisor.
    """

    def __init__(
        self, names: Sequence[str], elsewhere: str, tell: Callable[[Message], None]
    ) -> None:
        self._names = names
        self._elsewhere = [name for name in elsewhere.split(",") if name]
        self._tell = tell
        self._lock = threading.Lock()
        self._publisher: StatePublisher | None = None
        self._last_state = ""
        self._may_leave = threading.Event()

    def open(self, middleware: Middleware) -> None:
        """Publish and receive states from now on."""
        if not self._elsewhere:
            return
        publisher = middleware.join_peers(self._names, self._elsewhere, self._receive)
        with self._lock:
            self._publisher = publisher
            if self._last_state:
                publisher.publish(self._last_state)

    def publish(self, text: str) -> None:
        """Publish a state of the launcher, as soon as that is possible. Any thread."""
        with self._lock:
            self._last_state = text
            if self._publisher is not None:
                self._publisher.publish(text)

    def leave(self) -> None:
        """The launcher has published and received all states. Any thread."""
        self._may_leave.set()

    def close(self) -> None:
        """Wait until :meth:`leave`, but not for ever, and publish nothing more."""
        if self._publisher is None:
            return
        self._may_leave.wait(_LEAVE_S)
        with self._lock:
            publisher, self._publisher = self._publisher, None
        publisher.close()

    def _receive(self, name: str, text: str | None) -> None:
        self._tell(control.StateOfPeer(name, text))
