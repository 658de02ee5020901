"""MuJoCo's native viewer, passive: it shows what the simulation does, and can pause it."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

from neuros.ports import NodeContext

_PERIOD_S = 1 / 60
_SPACE = 32
_CLOSE_S = 4.0  # less than a node has to end; software OpenGL takes its time


class Viewer:
    """An open window. The space bar pauses and resumes; closing the window resumes for good.

    ``launch`` is ``mujoco.viewer.launch_passive`` or something that looks like it.
    """

    def __init__(
        self,
        launch: Callable[..., Any],
        model: Any,
        data: Any,
        *,
        toggle: Callable[[], None],
        closed: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._launch, self._toggle, self._closed, self._clock = launch, toggle, closed, clock
        self._next = 0.0
        self._handle: Any = None
        self._threads: set[threading.Thread] = set()
        self.show(model, data)

    @property
    def is_open(self) -> bool:
        return self._handle is not None and bool(self._handle.is_running())

    def show(self, model: Any, data: Any) -> None:
        """Open the window for another model."""
        self.close()
        others = set(threading.enumerate())
        self._handle = self._launch(model, data, key_callback=self._on_key)
        self._threads = {thread for thread in threading.enumerate() if _draws(thread)} - others

    def sync(self) -> None:
        """Show the present data, at most 60 times per wall second; not during a step."""
        if self._handle is None or self._clock() < self._next:
            return
        self._next = self._clock() + _PERIOD_S
        if self._handle.is_running():
            self._handle.sync()
        else:
            self._handle = None
            self._closed()

    def close(self) -> None:
        """Close the window; returns when it is gone.

        GLFW is given up at the end of the process, and must not be while a window is still drawn.
        """
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.close()
        for thread in self._threads:
            thread.join(_CLOSE_S)
        self._threads = set()

    def _on_key(self, key: int) -> None:
        if key == _SPACE:
            self._toggle()


def _draws(thread: threading.Thread) -> bool:
    """Whether it is the one that ``launch_passive`` has started: its name has the function's."""
    return "_launch_internal" in thread.name


def open_viewer(
    node: NodeContext,
    model: Any,
    data: Any,
    *,
    toggle: Callable[[], None],
    closed: Callable[[], None],
) -> Viewer | None:
    """A window if ``NEUROS_GUI`` asks for one and there is a display."""
    launch = find_launcher(node) if is_wanted(node) else None
    return Viewer(launch, model, data, toggle=toggle, closed=closed) if launch else None


def is_wanted(node: NodeContext) -> bool:
    """Whether ``NEUROS_GUI`` asks for windows."""
    value = node.description.environment.get("NEUROS_GUI", os.environ.get("NEUROS_GUI", ""))
    return value not in ("", "0")


def find_launcher(node: NodeContext) -> Callable[..., Any] | None:
    """The function that opens the window; ``None``, after one warning, where none can open."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw warns of what is reported below
            # launch_passive would wait for ever where GLFW finds no display.
            reason = "" if _has_display() and _glfw_starts() else "there is no display"
            if not reason:
                import mujoco.viewer

                launch: Callable[..., Any] = mujoco.viewer.launch_passive
                return launch
    except ImportError as error:
        reason = str(error)
    node.get_logger().warning(f"NEUROS_GUI is set, but no viewer opens: {reason}")
    return None


def _has_display() -> bool:
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _glfw_starts() -> bool:
    import glfw

    return bool(glfw.init())
