"""Connection of a session with its run: it asks, and waits for the answer.

Where one process holds all nodes, steps go straight to it. The supervisor is a thread of the
program that steps, and takes turns with it: through the supervisor, a step takes several times as
long. It takes no part in such a step; it hears of failures and ends from the nodes.
"""

from __future__ import annotations

import base64
import contextlib
import select
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from neuros.backends.control_sockets import SESSION_SOCKET_NAME, connect_unix
from neuros.control import Deliver, Ended, Message, Settle, Settled, StepAll
from neuros.control.link import ControlLink
from neuros.control.steps import Advance, Advanced, StepLink

_MOST_UNSENT = 64


class SessionLink:
    """Connection of a session with its run.

    Args:
        supervisor: of the run.
        folder: the run folder.
    """

    def __init__(self, supervisor: ControlLink, folder: Path) -> None:
        self._supervisor = supervisor
        self._folder = folder
        self._nodes: StepLink[Advanced] | None = None
        self._arrivals = select.poll()
        self._arrivals.register(supervisor, select.POLLIN)
        self._unsent: list[tuple[str, str, bytes]] = []
        self._number = self._answered = 0

    def send(self, message: Message) -> None:
        """Send to the supervisor, behind all that was sent before."""
        self._catch_up()
        self._supervisor.send(message)

    def deliver(self, node: str, input_name: str, content: bytes) -> None:
        """Send a packet, with the next step at the latest."""
        if self._nodes is None:
            self._supervisor.send(Deliver(node, input_name, base64.b64encode(content).decode()))
            return
        self._unsent.append((node, input_name, content))
        if len(self._unsent) >= _MOST_UNSENT:
            self._catch_up()

    def settle(
        self, known: Mapping[str, int], end_s: float | None = None, *, rounds: int = 0
    ) -> Advanced | None:
        """Go on by rounds, then wait until nothing moves, both by the supervisor.

        What has been said to the supervisor comes before. See :meth:`advance`.
        """
        self._catch_up()
        self._number += 1
        if rounds:
            self._supervisor.send(StepAll(rounds))
        self._supervisor.send(Settle(self._number, known))
        found: list[Settled] = []

        def is_answer(message: Message) -> bool:
            if isinstance(message, Settled) and message.number == self._number:
                found.append(message)
            return bool(found)

        if not self.wait_for(is_answer, end_s):
            return None
        self._answered = self._number
        if self._nodes is None:
            with contextlib.suppress(OSError):  # they are in several processes, or out of reach
                stream = connect_unix(self._folder / SESSION_SOCKET_NAME)
                self._nodes = StepLink(stream, Advanced, "the nodes")
                self._arrivals.register(stream, select.POLLIN)
        packets = {
            name: (newest.number, base64.b64decode(newest.data))
            for name, newest in found[0].packets.items()
        }
        return Advanced(self._number, found[0].sim_times, packets)

    def advance(
        self, rounds: int, known: Mapping[str, int], end_s: float | None
    ) -> Advanced | None:
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
        while self._nodes is not None:
            is_over = False
            for number, _ in self._ready(end_s):
                if number == self._supervisor.fileno():
                    is_over = self._hear_supervisor(lambda _: False) is not None
                    continue
                for answer in self._hear_nodes():
                    if answer.number == self._number:
                        self._answered = answer.number
                        return answer
            if is_over:
                return None
        self.wait_for(lambda _: False, end_s)  # the supervisor says why they have gone
        return None

    def wait_for(self, is_wanted: Callable[[Message], bool], end_s: float | None) -> bool:
        """Until such a message comes from the supervisor; ``False`` once the run has ended.

        Raises:
            TimeoutError: if neither comes until ``end_s`` (monotonic, seconds).
        """
        while True:
            for number, _ in self._ready(end_s):
                if number != self._supervisor.fileno():
                    self._hear_nodes()  # an answer that is no longer waited for
                elif (is_there := self._hear_supervisor(is_wanted)) is not None:
                    return is_there

    def leave_nodes(self) -> None:
        """Send what waits, and hear the nodes no more: none waits for its answer to be read."""
        if self._nodes is not None:
            if self._unsent:
                self._send_to(self._nodes, 0, {})
            self._arrivals.unregister(self._nodes)
            self._nodes.close()
            self._nodes = None

    def close(self) -> None:
        """Hang up."""
        self._supervisor.close()

    def _ready(self, end_s: float | None) -> list[tuple[int, int]]:
        """Descriptors of the connections on which something has come, each with what."""
        left_ms = None if end_s is None else max(0.0, end_s - time.monotonic()) * 1e3
        ready = self._arrivals.poll(left_ms)
        if not ready:
            raise TimeoutError(f"the run has not come to rest in time: {self._folder}")
        return ready

    def _hear_supervisor(self, is_wanted: Callable[[Message], bool]) -> bool | None:
        """Whether such a message has come; ``None`` if not, and the run goes on."""
        messages = self._supervisor.receive()
        is_over = messages is None
        for message in messages or ():
            if is_wanted(message):
                return True
            is_over = is_over or isinstance(message, Ended)
        return False if is_over else None

    def _hear_nodes(self) -> list[Advanced]:
        assert self._nodes is not None
        answers = self._nodes.receive()
        if answers is None:
            self.leave_nodes()
        return answers or []

    def _catch_up(self) -> None:
        """Wait for the nodes: what they are told on two ways comes in any order."""
        if self._nodes is not None and (self._unsent or self._answered != self._number):
            self.advance(0, {}, None)

    def _send_to(self, nodes: StepLink[Advanced], rounds: int, known: Mapping[str, int]) -> None:
        nodes.send(Advance(self._number, rounds, known, tuple(self._unsent)))
        self._unsent.clear()
