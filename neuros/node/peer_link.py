"""Link between a launcher and its peers, in a project that is started in parts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import neuros.control as control
from neuros.control import Message
from neuros.ports import Middleware, Voice

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
        self._voice: Voice | None = None
        self._last_state = ""
        self._may_leave = threading.Event()

    def open(self, middleware: Middleware) -> None:
        """Publish and receive states from now on."""
        if not self._elsewhere:
            return
        voice = middleware.join_peers(self._names, self._elsewhere, self._receive)
        with self._lock:
            self._voice = voice
            if self._last_state:
                voice.say(self._last_state)

    def publish(self, text: str) -> None:
        """Publish a state of the launcher, as soon as that is possible. Any thread."""
        with self._lock:
            self._last_state = text
            if self._voice is not None:
                self._voice.say(text)

    def leave(self) -> None:
        """The launcher has published and received all states. Any thread."""
        self._may_leave.set()

    def close(self) -> None:
        """Wait until :meth:`leave`, but not for ever, and publish nothing more."""
        if self._voice is None:
            return
        self._may_leave.wait(_LEAVE_S)
        with self._lock:
            voice, self._voice = self._voice, None
        voice.close()

    def _receive(self, name: str, text: str | None) -> None:
        self._tell(control.StateOfPeer(name, text))
