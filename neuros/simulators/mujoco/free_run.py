"""Stepping in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from neuros.ports import NodeContext, Packet
from neuros.simulators.mujoco.gate import Gate
from neuros.simulators.mujoco.pacing import Pacer

_JOIN_S = 5.0
_LOOK_S = 0.1


class FreeRun:
    """Repeats: a bout of steps, wait for the wall clock, hand over the packets that are due.

    Handing over waits while a reliable connection is blocked, and stepping with it; model and data
    are free for visitors of the gate meanwhile. An error ends the node.

    Args:
        advance: runs one bout and returns the packets that are due after it, by output.
        sim_time: simulated seconds.
        finish: called in the thread at its end.
        look: called now and then while stepping is paused, ``None`` for nothing.
        clock: wall seconds; ``wait`` sleeps that many, by default until :meth:`stop` at the latest.
    """

    def __init__(
        self,
        node: NodeContext,
        gate: Gate,
        advance: Callable[[], Mapping[str, Packet]],
        sim_time: Callable[[], float],
        finish: Callable[[], None],
        look: Callable[[], None] | None,
        factor: float | None,
        clock: Callable[[], float],
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self._node, self._gate = node, gate
        self._advance, self._sim_time, self._finish = advance, sim_time, finish
        self._look = look
        self._stopped = threading.Event()
        self.pacer = Pacer(factor, clock, wait or self._stopped.wait)
        self._thread = threading.Thread(
            target=self._run, name=f"{node.name}: simulation", daemon=True
        )

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive() and not self._stopped.is_set()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread; returns when it has ended. Harmless when it has, or from inside it."""
        self._stopped.set()
        self._gate.wake()
        if self._thread is not threading.current_thread():
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            self.pacer.start(self._sim_time())
            while self._bout():
                pass
        except BaseException as error:
            if not self._stopped.is_set():
                self._node.fail(error)
        finally:
            self._stopped.set()
            self._finish()

    def _bout(self) -> bool:
        cancelled = self._stopped.is_set
        while not self._gate.enter(cancelled, None if self._look is None else _LOOK_S):
            if cancelled():
                return False
            if self._look is not None:
                self._look()
        try:
            packets = self._advance()
        finally:
            self._gate.leave()
        self.pacer.hold(self._sim_time())
        return not packets or self._node.submit(packets, cancelled)
