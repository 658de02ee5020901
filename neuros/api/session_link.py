"""Connection of a session with its run: it asks, and waits for the answer.

Where one process holds all nodes, steps go straight to it. The supervisor is a thread of the
program that steps, and takes turns with it: through the supervisor, a step takes about twice as
long. It takes no part in such a step; it hears of failures and ends from the nodes.
"""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from neuros.backends.control_sockets import SESSION_SOCKET_NAME, connect_unix
from neuros.control import (
    TO_SESSION,
    Advance,
    AtRest,
    Deliver,
    Ended,
    Message,
    Settle,
    Settled,
    StepAll,
)
from neuros.control.link import ControlLink

_MOST_UNSENT = 64
_Answer = TypeVar("_Answer", Settled, AtRest)


class SessionLink:
    """Connection of a session with its run.

    Args:
        supervisor: of the run.
        folder: the run folder.
    """

    def __init__(self, supervisor: ControlLink, folder: Path) -> None:
        self._supervisor = supervisor
        self._folder = folder
        self._nodes: ControlLink | None = None
        self._unsent: list[Deliver] = []
        self._number = self._answered = 0

    def send(self, message: Message) -> None:
        """Send to the supervisor, behind all that was sent before."""
        self._catch_up()
        self._supervisor.send(message)

    def deliver(self, packet: Deliver) -> None:
        """Send a packet, with the next step at the latest."""
        if self._nodes is None:
            self._supervisor.send(packet)
            return
        self._unsent.append(packet)
        if len(self._unsent) >= _MOST_UNSENT:
            self._catch_up()

    def settle(
        self, known: Mapping[str, int], end_s: float | None = None, *, rounds: int = 0
    ) -> Settled | None:
        """Go on by rounds, then wait until nothing moves, both by the supervisor.

        What has been said to the supervisor comes before. See :meth:`advance`.
        """
        self._catch_up()
        self._number += 1
        if rounds:
            self._supervisor.send(StepAll(rounds))
        self._supervisor.send(Settle(self._number, known))
        settled = self._answer(Settled, end_s)
        if settled is not None and self._nodes is None:
            with contextlib.suppress(OSError):  # they are in several processes, or out of reach
                stream = connect_unix(self._folder / SESSION_SOCKET_NAME)
                self._nodes = ControlLink(stream, TO_SESSION, "the nodes")
        return settled

    def advance(
        self, rounds: int, known: Mapping[str, int], end_s: float | None
    ) -> Settled | AtRest | None:
        """Go on by rounds, then wait until nothing moves.

        Args:
            known: outputs to show, and the number of the newest known packet.
            end_s: as for :meth:`wait_for`, whose errors it raises.

        Returns:
            ``None`` if the run has ended.
        """
        if self._nodes is None:
            return self.settle(known, end_s, rounds=rounds)
        self._number += 1
        self._send_to(self._nodes, rounds, known)
        return self._answer(AtRest, end_s)

    def wait_for(self, is_wanted: Callable[[Message], bool], end_s: float | None) -> bool:
        """Until such a message comes; ``False`` once the run has ended.

        Raises:
            TimeoutError: if neither comes until ``end_s`` (monotonic, seconds).
        """
        while True:
            left_s = None if end_s is None else max(0.0, end_s - time.monotonic())
            links = [link for link in (self._supervisor, self._nodes) if link is not None]
            ready = select.select(links, [], [], left_s)[0]
            if not ready:
                raise TimeoutError(f"the run has not come to rest in time: {self._folder}")
            is_over = False
            for link in ready:
                messages = link.receive()
                if messages is None and link is self._nodes:
                    self.leave_nodes()
                    continue  # the supervisor says why they have gone
                is_over = is_over or messages is None
                for message in messages or ():
                    if is_wanted(message):
                        return True
                    is_over = is_over or isinstance(message, Ended)
            if is_over:
                return False

    def leave_nodes(self) -> None:
        """Send what waits, and hear the nodes no more: none waits for its answer to be read."""
        if self._nodes is not None:
            if self._unsent:
                self._send_to(self._nodes, 0, {})
            self._nodes.close()
            self._nodes = None

    def close(self) -> None:
        """Hang up."""
        self._supervisor.close()

    def _answer(self, kind: type[_Answer], end_s: float | None) -> _Answer | None:
        found: list[_Answer] = []

        def is_answer(message: Message) -> bool:
            if isinstance(message, kind) and message.number == self._number:
                found.append(message)
                self._answered = message.number
            return bool(found)

        return found[0] if self.wait_for(is_answer, end_s) else None

    def _catch_up(self) -> None:
        """Wait for the nodes: what they are told on two ways comes in any order."""
        if self._nodes is not None and (self._unsent or self._answered != self._number):
            self.advance(0, {}, None)

    def _send_to(self, nodes: ControlLink, rounds: int, known: Mapping[str, int]) -> None:
        nodes.send(Advance(self._number, rounds, known, tuple(self._unsent)))
        self._unsent.clear()
