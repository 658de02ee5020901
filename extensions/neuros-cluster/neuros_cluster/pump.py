"""Pump: carries messages and control connections between a launcher and an agent.

At each end one thread reads all descriptors, and another one writes and beats, and they do nothing
else: so signs of life are sent and received whatever the process does. Any data is one.
"""

from __future__ import annotations

import os
import selectors
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
_TURN_S = 0.1  # after which what other threads have asked for is done
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
        self._unsent = bytearray()
        self._more = threading.Condition()
        self._received = bytearray()
        self._last: deque[Message] = deque()
        self._links: dict[int, ControlLink] = {}
        self._count = 0
        self._listener: ControlListener | None = None
        self._is_ending = False
        self._writer = threading.Thread(target=self._write, name=f"{self.name}-write", daemon=True)
        self._selector = selectors.DefaultSelector()
        self._selector.register(read_from, selectors.EVENT_READ)

    # ------------------------------------------------------------------ called by others

    def send(self, message: Message) -> None:
        """Queue a message to be sent. Callable from any thread."""
        with self._more:
            self._unsent += encode(message)
            self._more.notify()

    def send_last(self, message: Message) -> None:
        """Send a message after all present data of control connections. Any thread."""
        self._last.append(message)

    @property
    def unsent_bytes(self) -> int:
        """Number of bytes that have not been written yet."""
        return len(self._unsent)

    def listen(self, listener: ControlListener) -> None:
        """Accept control connections from now on. Callable from any thread."""
        self._listener = listener
        self._selector.register(listener, selectors.EVENT_READ)

    def end(self) -> None:
        """Write all queued messages, and end. Callable from any thread."""
        with self._more:
            self._is_ending = True
            self._more.notify()

    # ------------------------------------------------------------------ the threads

    def run(self) -> None:
        """Run until :meth:`end`, or until the other end is gone."""
        reason = ""
        self._writer.start()
        try:
            while not reason and (not self._is_ending or self._writer.is_alive()):
                reason = self._turn()
        except Exception as error:  # nothing else would report that the pump has stopped
            reason = f"{type(error).__name__}: {error}"
        finally:
            if reason and not self._is_ending:
                self._lose(reason)  # before control connections are seen to end
            for link in tuple(self._links):
                self._hang_up(link)
            self.end()
            self._selector.close()
            os.close(self._read_from)

    def _write(self) -> None:
        next_s = 0.0
        try:
            while True:
                with self._more:
                    if not self._unsent and (self._last or not self._is_ending):
                        self._more.wait(max(0.0, next_s - time.monotonic()))
                    if (now_s := time.monotonic()) >= next_s:
                        next_s = now_s + BEAT_S
                        self._unsent += encode(Ping(now_s))
                    data = bytes(self._unsent[:_READ_BYTES])
                    if self._is_ending and not (data or self._last):
                        return
                written = os.write(self._write_to, data)
                with self._more:
                    del self._unsent[:written]
        except OSError:  # the other end is gone; its last data is still to be read
            self._unsent.clear()
        finally:
            os.close(self._write_to)

    def _turn(self) -> str:
        """Handle what is ready; returns why the other end is gone, empty while it is there."""
        for number, link in tuple(self._links.items()):
            if not link.flush() or len(link.unsent) > _MOST_UNSENT_BYTES:
                self._part(number)
        ready = {key.fd for key, _ in self._selector.select(_TURN_S)}
        if self._read_from in ready and (reason := self._read()):
            return reason
        if self._listener is not None and self._listener.fileno() in ready:
            self._accept()
        for number, link in tuple(self._links.items()):
            if link.fileno() in ready:
                self._relay(number, link)
        self._send_last()
        silent_s = time.monotonic() - self.received_s
        # Not ready: all data that arrived while this process could not run has been read.
        if self.timeout_s is not None and not ready and silent_s > self.timeout_s:
            return f"nothing was heard of {self._peer} for {self.timeout_s:g} s"
        return ""

    def _read(self) -> str:
        try:
            data = os.read(self._read_from, _READ_BYTES)
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
