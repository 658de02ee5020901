"""The one way out of an engine: whatever it does to the world is a call of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from neuros.core.hook import Hook
from neuros.project.model import Connection, Port


class Effects(Protocol):
    """What an engine does to the world."""

    def has_taken_in(self) -> bool:
        """Whether all that had reached the node has become an event, so that a hook may start.

        Where it says no, a loop-back comes after that.
        """

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook of the plugin; raises ``HookError``."""

    def send(self, connections: Sequence[Connection], packet: Any) -> None:
        """Send on these connections, which lead to other nodes."""

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on an external topic."""

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Tell the sender of a connection from another node."""

    def post(self, event: Callable[[], None]) -> None:
        """Have a delivery to the node itself handled after all events that already wait."""

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Have the loop-back handled after all events that already wait, outside ones too."""

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        """What the node gets on a connection to itself: it shares nothing with this packet."""
