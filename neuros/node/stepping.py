"""Steps of a session, in the process that holds all nodes of its run.

The stream of steps has one reader at a time. While nothing goes on, the control thread waits for a
step, since the loop waits for ROS. The loop does the step, answers, and waits a moment for the next
one itself: a program that steps again and again pays for no other thread. ROS has its turn before
each step.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
from collections.abc import Callable

from neuros.control import FROM_SESSION, AtRest, Message
from neuros.control.link import Arrivals, ControlLink
from neuros.ports import ControlListener

_LINGER_MS = 2
"""So long the loop waits for the next step, and ROS for the loop."""


class SessionSteps:
    """Takes the steps of a session, and answers them.

    Args:
        listener: where the session connects; there is one session per run.
        advance: does a step, in the loop; then it calls :meth:`answer`, and has the loop
            :meth:`take` the next one.
        post: has an event handled by the loop; any thread.
    """

    def __init__(
        self,
        listener: ControlListener,
        advance: Callable[[Message], None],
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        self._listener = listener
        self._advance = advance
        self._post = post
        self._link: ControlLink | None = None
        self._waker = os.eventfd(0, os.EFD_NONBLOCK)
        self._is_waiting = False
        self._arrivals = Arrivals()
        self._arrivals.register(self._waker)

    def listen(self, selector: selectors.BaseSelector) -> None:
        """Have the control thread wait for the session by its selector, and later for steps."""
        self._selector = selector
        selector.register(self._listener, selectors.EVENT_READ, self._join)

    def _join(self) -> bool:
        stream = self._listener.accept()
        if stream is not None:
            self._selector.unregister(self._listener)
            self._link = ControlLink(stream, FROM_SESSION, "the session")
            self._arrivals.register(stream)
            self.watch()
        return True

    def watch(self) -> None:
        """Let the control thread wait, which may be in ``epoll_wait`` meanwhile: that is allowed.

        Once that thread has ended, its selector is closed, and the run at its end.
        """
        assert self._link is not None
        with contextlib.suppress(ValueError):
            self._selector.register(self._link, selectors.EVENT_READ, self._hand_over)

    def _hand_over(self) -> bool:
        assert self._link is not None
        self._selector.unregister(self._link)
        self._post(self.take)
        return True

    def take(self) -> None:
        """Do the next step if it comes within a moment. Loop thread only.

        Raises:
            ControlError: if it cannot be understood.
        """
        assert self._link is not None
        self._is_waiting = True
        arrived = self._arrivals.wait(_LINGER_MS)
        self._is_waiting = False
        if self._waker in arrived or not arrived:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._waker)
            self.watch()
            return
        steps = self._link.receive()
        if steps is None:
            return  # the session has hung up
        if not steps:
            self._post(self.take)  # the rest of a step is on its way
        for step in steps:
            self._advance(step)

    def answer(self, answer: AtRest) -> None:
        """Tell the session that nothing moves any more. Loop thread only."""
        assert self._link is not None
        self._link.send(answer)

    def wake(self) -> None:
        """Let the loop wait for no step, for there is something else to do. Any thread."""
        if self._is_waiting:
            os.eventfd_write(self._waker, 1)

    def shut(self) -> None:
        """Have an answer end that waits for a session which does not read, in another thread."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                end = socket.fromfd(self._link.fileno(), socket.AF_UNIX, socket.SOCK_STREAM)
                with end:
                    end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Hang up."""
        self._listener.close()
        os.close(self._waker)
        if self._link is not None:
            self._link.close()
