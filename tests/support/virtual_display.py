"""A display without a screen, and a user in front of it: for the tests that open windows.

::

    with virtual_display() as user:
        program = subprocess.Popen(..., env={**os.environ, "DISPLAY": user.display})
        window = user.find("MuJoCo")
        user.press(window, "space")
        user.close(window)
"""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import os
import selectors
import subprocess
import time
from collections.abc import Iterator

from needs import require

DEADLINE_S = 30.0
"""For a window to appear: software OpenGL on a busy machine takes its time."""

_SIZE = "1280x960x24"
_KEY_PRESS, _KEY_RELEASE, _CLIENT_MESSAGE = 2, 3, 33


@contextlib.contextmanager
def virtual_display() -> Iterator[User]:
    """Start Xvfb on a free display, and end it; programs draw on it with OpenGL."""
    require("Xvfb", "OpenGL")
    reader, writer = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writer), "-screen", "0", _SIZE, "-nolisten", "tcp"],
        pass_fds=[writer],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writer)
    try:
        user = User(f":{_read_line(reader)}")
        try:
            yield user
        finally:
            user.leave()
    finally:
        os.close(reader)
        server.terminate()
        try:
            server.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


def _read_line(reader: int) -> str:
    """What a server writes when it is ready: the number of its display."""
    deadline_s, text = time.monotonic() + DEADLINE_S, b""
    with selectors.DefaultSelector() as selector:
        selector.register(reader, selectors.EVENT_READ)
        while not text.endswith(b"\n"):
            assert selector.select(max(0.0, deadline_s - time.monotonic())), "Xvfb does not start"
            more = os.read(reader, 64)
            assert more, "Xvfb has ended"
            text += more
    return text.decode().strip()


class User:
    """Finds windows on a display, presses keys in them and closes them (Xlib, by ctypes)."""

    def __init__(self, display: str) -> None:
        self.display = display
        self._x = ctypes.CDLL(ctypes.util.find_library("X11") or "libX11.so.6")
        for name in ("XOpenDisplay", "XDefaultRootWindow", "XInternAtom", "XStringToKeysym"):
            getattr(self._x, name).restype = ctypes.c_ulong
        self._connection = ctypes.c_void_p(self._x.XOpenDisplay(display.encode()))
        assert self._connection.value, f"cannot open display {display}"
        self._clock_ms = 0

    def leave(self) -> None:
        """Give up the connection to the display."""
        self._x.XCloseDisplay(self._connection)

    def find(self, title: str, deadline_s: float = DEADLINE_S) -> int:
        """The window with ``title`` in its title, as soon as it is there."""
        end_s = time.monotonic() + deadline_s
        with selectors.DefaultSelector() as selector:  # nothing registered: a pause
            while True:
                for window in self._windows(self._root):
                    if title in self._title(window):
                        return window
                assert time.monotonic() < end_s, f"no window '{title}' after {deadline_s:g} s"
                selector.select(0.05)

    def press(self, window: int, key: str) -> None:
        """Press and release a key, by its name in X: ``"space"``."""
        symbol = ctypes.c_ulong(self._x.XStringToKeysym(key.encode()))
        code = self._x.XKeysymToKeycode(self._connection, symbol) & 0xFF
        for type_, mask in ((_KEY_PRESS, 1 << 0), (_KEY_RELEASE, 1 << 1)):
            self._clock_ms += 1000  # events that are not later than the last one count as echoes
            event = _Event()
            event.key = _KeyEvent(
                type=type_,
                display=self._connection,
                window=window,
                root=self._root,
                time=self._clock_ms,
                keycode=code,
                same_screen=1,
            )
            self._send(window, mask, event)

    def close(self, window: int) -> None:
        """Click the cross of its frame, as far as the program in it can tell."""
        event = _Event()
        event.message = _ClientMessage(
            type=_CLIENT_MESSAGE,
            display=self._connection,
            window=window,
            message_type=self._atom("WM_PROTOCOLS"),
            format=32,
        )
        event.message.data[0] = self._atom("WM_DELETE_WINDOW")
        self._send(window, 0, event)

    @property
    def _root(self) -> int:
        return int(self._x.XDefaultRootWindow(self._connection))

    def _atom(self, name: str) -> int:
        return int(self._x.XInternAtom(self._connection, name.encode(), 0))

    def _send(self, window: int, mask: int, event: _Event) -> None:
        send = self._x.XSendEvent
        send(self._connection, ctypes.c_ulong(window), 0, ctypes.c_long(mask), ctypes.byref(event))
        self._x.XFlush(self._connection)

    def _windows(self, parent: int) -> list[int]:
        """All windows below ``parent`` (a toolkit may wrap its own around a named one)."""
        root, above, count = ctypes.c_ulong(), ctypes.c_ulong(), ctypes.c_uint()
        children = ctypes.POINTER(ctypes.c_ulong)()
        references = map(ctypes.byref, (root, above, children, count))
        if not self._x.XQueryTree(self._connection, ctypes.c_ulong(parent), *references):
            return []
        found = [int(children[index]) for index in range(count.value)]
        if found:
            self._x.XFree(children)
        return [*found, *(below for child in found for below in self._windows(child))]

    def _title(self, window: int) -> str:
        name = ctypes.c_char_p()
        self._x.XFetchName(self._connection, ctypes.c_ulong(window), ctypes.byref(name))
        return (name.value or b"").decode(errors="replace")


class _KeyEvent(ctypes.Structure):
    """``XKeyEvent`` of Xlib.h."""

    _fields_ = (
        ("type", ctypes.c_int),
        ("serial", ctypes.c_ulong),
        ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("window", ctypes.c_ulong),
        ("root", ctypes.c_ulong),
        ("subwindow", ctypes.c_ulong),
        ("time", ctypes.c_ulong),
        ("x", ctypes.c_int),
        ("y", ctypes.c_int),
        ("x_root", ctypes.c_int),
        ("y_root", ctypes.c_int),
        ("state", ctypes.c_uint),
        ("keycode", ctypes.c_uint),
        ("same_screen", ctypes.c_int),
    )


class _ClientMessage(ctypes.Structure):
    """``XClientMessageEvent`` of Xlib.h."""

    _fields_ = (
        ("type", ctypes.c_int),
        ("serial", ctypes.c_ulong),
        ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("window", ctypes.c_ulong),
        ("message_type", ctypes.c_ulong),
        ("format", ctypes.c_int),
        ("data", ctypes.c_long * 5),
    )


class _Event(ctypes.Union):
    """``XEvent`` of Xlib.h, as long as the longest of its kinds."""

    _fields_ = (("key", _KeyEvent), ("message", _ClientMessage), ("pad", ctypes.c_long * 24))
