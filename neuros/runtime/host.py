"""What stands behind ``node``: what a plugin asks for, in its hooks and from threads of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from neuros.core.engine import Engine
from neuros.ports import EventLoop, Transport
from neuros.runtime.failures import Failures, as_node_error
from neuros.runtime.simulated_time import SimulatedTime


class NodeHost:
    """The :class:`~neuros.runtime.handle.Host` of one running node.

    Args:
        ask_for_end: called with ``reason`` and ``drain_s``, the seconds for draining.

    Attributes:
        engine: the node's, ``None`` until its plugin is loaded.
        is_ending: whether no further hook starts.
        make_packet: a new message with default values, for a type in ROS notation.
        waiting_threads: those that wait until packets that they have offered are sent.
    """

    def __init__(
        self,
        transport: Transport,
        loop: EventLoop,
        time: SimulatedTime,
        failures: Failures,
        ask_for_end: Callable[..., object],
    ) -> None:
        self.engine: Engine | None = None
        self.is_ending = False
        self.waiting_threads: set[threading.Thread] = set()
        self.make_packet = transport.make_packet
        self._loop = loop
        self._time = time
        self._failures = failures
        self._ask_for_end = ask_for_end
        self._closers: list[Callable[[], None]] = []

    def stop(self) -> None:
        """Start no further hook. Any thread."""
        self.is_ending = True
        if self.engine is not None:
            self.engine.stop_hooks()

    def shutdown(self, reason: str, drain_s: float) -> None:
        """Ask the supervisor for a drained end; this node starts no further hook."""
        if self.engine is not None:
            self.engine.stop_hooks()
        self._ask_for_end(reason=reason, drain_s=drain_s)

    def expect_end(self, sim_s: float) -> None:
        """It will end at this simulated time."""
        self._time.expected_end_s = sim_s

    def own_simulated_time(self, read_s: Callable[[], float]) -> None:
        """Take simulated time from a simulator, rather than from a clock that it publishes."""
        self._time.own(read_s)

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call back when the node ends."""
        self._closers.append(callback)

    def close(self) -> None:
        """Give up what the plugin holds, last opened first."""
        for close in reversed(self._closers):
            try:
                close()
            except BaseException as error:  # the others must be closed all the same
                self._failures.report(as_node_error(error, "failed while it was closed: "))

    def fail_from_thread(self, error: BaseException) -> None:
        """End the project with an error that happened outside the hooks."""
        self._loop.post_from_thread(lambda: self._failures.report(error))

    def offer_from_thread(
        self, packets: Mapping[str, Any], accepted: Callable[[], None]
    ) -> Callable[[Callable[[], None]], None]:
        """Offer packets from another thread; returns a function that withdraws them."""
        withdrawals: list[Callable[[], None]] = []
        thread = threading.current_thread()

        def accept() -> None:
            self.waiting_threads.discard(thread)
            accepted()

        def offer() -> None:
            assert self.engine is not None
            self.waiting_threads.add(thread)
            withdrawals.append(self.engine.offer(packets, accept))
            if self._time.is_watched:
                self._time.look()

        def withdraw(done: Callable[[], None]) -> None:
            def event() -> None:
                self.waiting_threads.discard(thread)
                for each in withdrawals:
                    each()
                done()

            self._loop.post_from_thread(event)

        self._loop.post_from_thread(lambda: self._failures.guard(offer))
        return withdraw
