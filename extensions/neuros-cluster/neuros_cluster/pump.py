"""Pump: carries messages and control connections between a launcher and an agent.

One thread at each end waits for all of its descriptors at once, and for nothing else: so signs of
life are sent and received whatever the process does. Any data is a sign of life.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from neuros.control import Message
from neuros.control.link import ControlLink, decode, decoder_of, encode, framed, remove_messages
from neuros.errors import ControlError
from neuros.ports import ControlListener, ControlStream
from neuros_cluster.messages import Closed, Opened, Ping, Pong, Said

BEAT_S = 1.0
_CLOSED = "the connection was closed"
_READ_BYTES = 1 << 16
_MOST_UNSENT_BYTES = 1 << 20
"""A control connection is closed when its other end leaves this many bytes unread."""


class Pump(threading.Thread):
    """One end of the connection between a launcher and an agent.

    Args:
        read_from, write_to: descriptors, which the pump closes in the end.
        accepted: the messages that may arrive.
        peer: the other end, for error messages.
        handle: called with each message that is not the pump's own; in its thread.
        lose: called once with the reason when the other end is gone.
        connect: makes this end of a control connection that was opened over there.
        translate: applied to the text of control connections from over there.

    Attributes:
        timeout_s: an end that is silent for longer counts as gone; ``None``: no limit.
        received_s: the last sign of life, on the monotonic clock.
    """

    def __init__(
        self,
        read_from: int,
        write_to: int,
        accepted: Sequence[type[Message]],
        peer: str,
        handle: Callable[[Message], None],
        lose: Callable[[str], None],
        *,
        connect: Callable[[], ControlStream] | None = None,
        translate: Callable[[bytes], bytes] = bytes,
    ) -> None:
        super().__init__(name=f"neuros-{peer}", daemon=True)
        self.timeout_s: float | None = None
        self.received_s = time.monotonic()
        self._read_from, self._write_to = read_from, write_to
        self._decoder = decoder_of(tuple(accepted))
        self._peer, self._handle_other, self._lose = peer, handle, lose
        self._connect, self._translate = connect, translate
        self._lock = threading.Lock()
        self._unsent = bytearray()
        self._received = bytearray()
        self._last: deque[Message] = deque()
        self._links: dict[int, ControlLink] = {}
        self._count = 0
        self._listener: ControlListener | None = None
        self._is_ending = False
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._writes: set[int] = set()
        for descriptor in (read_from, write_to):
            os.set_blocking(descriptor, False)
        self._waker.setblocking(False)
        self._woken.setblocking(False)
        self._selector.register(read_from, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)

    # ------------------------------------------------------------------ called by others

    def send(self, message: Message) -> None:
        """Queue a message to be sent. Callable from any thread."""
        with self._lock:
            self._unsent += encode(message)
        self._wake()

    def send_last(self, message: Message) -> None:
        """Send a message after all present data of control connections. Any thread."""
        self._last.append(message)
        self._wake()

    @property
    def unsent_bytes(self) -> int:
        """Number of bytes that have not been written yet."""
        return len(self._unsent)

    def listen(self, listener: ControlListener) -> None:
        """Accept control connections from now on. Callable from any thread."""
        self._listener = listener
        self._wake()

    def end(self) -> None:
        """Write all queued messages, and end. Callable from any thread."""
        self._is_ending = True
        self._wake()

    # ------------------------------------------------------------------ the thread

    def run(self) -> None:
        """Run until :meth:`end`, or until the other end is gone."""
        reason = ""
        next_s = 0.0
        try:
            while not reason and not (self._is_ending and not (self._unsent or self._last)):
                now_s = time.monotonic()
                if now_s >= next_s:
                    next_s = now_s + BEAT_S
                    self.send(Ping(now_s))
                reason = self._turn(max(0.0, next_s - time.monotonic()))
        except Exception as error:  # nothing else would report that the pump has stopped
            reason = f"{type(error).__name__}: {error}"
        finally:
            if reason and not self._is_ending:
                self._lose(reason)  # before control connections are seen to end
            for link in tuple(self._links):
                self._hang_up(link)
            self._selector.close()
            self._waker.close()
            self._woken.close()
            for descriptor in {self._read_from, self._write_to}:
                with contextlib.suppress(OSError):
                    os.close(descriptor)

    def _turn(self, wait_s: float) -> str:
        """Handle what is ready; returns why the other end is gone, empty while it is there."""
        self._watch()
        ready = {key.fd for key, _ in self._selector.select(wait_s)}
        if self._woken.fileno() in ready:
            with contextlib.suppress(BlockingIOError):
                while self._woken.recv(_READ_BYTES):
                    pass
        if self._read_from in ready and (reason := self._read()):
            return reason
        if self._listener is not None and self._listener.fileno() in ready:
            self._accept()
        for number, link in tuple(self._links.items()):
            if link.fileno() in ready:
                self._relay(number, link)
        self._send_last()
        if self._write_to in ready and (reason := self._write()):
            return reason
        silent_s = time.monotonic() - self.received_s
        # Not ready: all data that arrived while this process could not run has been read.
        if self.timeout_s is not None and not ready and silent_s > self.timeout_s:
            return f"nothing was heard of {self._peer} for {self.timeout_s:g} s"
        return ""

    def _watch(self) -> None:
        """Register what is to be written and accepted."""
        wanted = {self._write_to} if self._unsent else set()
        for descriptor in self._writes - wanted:
            self._selector.unregister(descriptor)
        for descriptor in wanted - self._writes:
            self._selector.register(descriptor, selectors.EVENT_WRITE)
        self._writes = wanted
        if self._listener is not None and self._listener not in self._selector.get_map():
            self._selector.register(self._listener, selectors.EVENT_READ)
        for number, link in tuple(self._links.items()):
            if not link.flush() or len(link.unsent) > _MOST_UNSENT_BYTES:
                self._part(number)

    def _read(self) -> str:
        try:
            data = os.read(self._read_from, _READ_BYTES)
        except BlockingIOError:
            return ""
        except OSError as error:
            return str(error.strerror)
        if not data:
            return _CLOSED
        self.received_s = time.monotonic()
        self._received += data
        try:
            for each in remove_messages(self._received, self._peer):
                self._handle(decode(each, self._decoder, self._peer))
        except ControlError as error:
            return str(error)
        return ""

    def _handle(self, message: Message) -> None:
        match message:
            case Ping(sent_s):
                self.send(Pong(sent_s, time.monotonic(), time.time()))
            case Opened(number):
                if self._connect is not None:
                    self._open(number)
            case Said(number, data):
                if number in self._links:
                    self._links[number].unsent += framed(self._translate(data))
            case Closed(number):
                self._hang_up(number)
            case _:
                for link in self._links.values():
                    link.flush()  # keeps the order of arrival
                self._handle_other(message)

    def _write(self) -> str:
        with self._lock:
            try:
                written = os.write(self._write_to, self._unsent[:_READ_BYTES])
            except BlockingIOError:
                return ""
            except BrokenPipeError:  # the other end is gone; its last data is still to be read
                self._unsent.clear()
                return ""
            except OSError as error:
                return str(error.strerror)
            del self._unsent[:written]
        return ""

    # ------------------------------------------------------------------ control connections

    def _send_last(self) -> None:
        count = len(self._last)
        if not count:
            return
        self._accept()  # waiting connections have data, too
        for number, link in tuple(self._links.items()):
            while number in self._links and self._relay(number, link):
                pass
        for _ in range(count):
            self.send(self._last.popleft())

    def _accept(self) -> None:
        while self._listener is not None and (stream := self._listener.accept()) is not None:
            self._count += 1
            self._add(self._count, stream)
            self.send(Opened(self._count))

    def _open(self, number: int) -> None:
        assert self._connect is not None
        try:
            self._add(number, self._connect())
        except OSError:  # the supervisor does not listen any more
            self.send(Closed(number))

    def _add(self, number: int, stream: ControlStream) -> None:
        stream.setblocking(False)
        self._links[number] = link = ControlLink(stream, (Message,), self._peer)
        self._selector.register(link, selectors.EVENT_READ)

    def _relay(self, number: int, link: ControlLink) -> bool:
        """Send the data of a connection; returns whether there may be more right now."""
        try:
            found = link.read()
        except BlockingIOError:
            return False
        except ControlError:
            found = None
        if found is None:
            self._part(number)
            return False
        for data in found:
            self.send(Said(number, data))
        return True

    def _part(self, number: int) -> None:
        self._hang_up(number)
        self.send(Closed(number))

    def _hang_up(self, number: int) -> None:
        link = self._links.pop(number, None)
        if link is not None:
            link.flush()
            self._selector.unregister(link)
            link.close()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")
