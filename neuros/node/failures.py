"""Errors of a node: reported to the supervisor, and written to the node's log."""

from __future__ import annotations

import functools
import inspect
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any

from neuros.errors import CallbackError, NeurosError, NodeError, PluginError, printable
from neuros.node.plugin import PREFIX, describe, plugin_traceback
from neuros.ports import Logger

# What a plugin calls, and what calls it: a callback is neither.
_NOT_OF_PLUGINS = (str(Path(__file__).resolve().parents[1]), sys.prefix, sys.base_prefix)


class Failures:
    """Reports the errors of one node.

    Args:
        fail: called with the node's name and an error that ends the project.
    """

    def __init__(
        self, name: str, plugin: Path, logger: Logger, fail: Callable[[str, NeurosError], None]
    ) -> None:
        self._name = name
        self._plugin = plugin
        self._logger = logger
        self._fail = fail

    def report(self, error: BaseException) -> None:
        self._fail(self._name, error if isinstance(error, NeurosError) else as_node_error(error))

    def report_callback(self, callback: Any, error: BaseException) -> None:
        """End the project with the error of a callback that the plugin has registered with ROS."""
        self.report(error if isinstance(error, NeurosError) else callback_error(error, callback))

    def guard(self, event: Callable[[], None]) -> None:
        """Handle an event; a ``NeurosError`` ends the project."""
        try:
            event()
        except NeurosError as error:
            self._fail(self._name, error)

    def log(self, error: NeurosError) -> None:
        """Write an error to the node's log, with the plugin's traceback if it is the plugin's."""
        cause = error.__cause__
        is_shown = isinstance(error, PluginError)  # its text has the traceback already
        if isinstance(error, NodeError) and cause is not None and not is_shown:
            text = f"{error}\n{plugin_traceback(cause, self._plugin)}"
        else:
            text = str(error)
        self._logger.error(printable(text))


def as_node_error(error: BaseException, what: str = "") -> NodeError:
    """An error of which this one is the cause; ``what`` stands before its text."""
    wrapped = NodeError(f"{what}{describe(error)}")
    wrapped.__cause__ = error
    return wrapped


def callback_error(error: BaseException, callback: Any = None) -> NodeError:
    """The error of a callback; without ``callback``, it is looked for in the traceback."""
    wrapped: NodeError
    code = _code_of(callback)
    if code is None:  # of the first frame in the traceback that is of the project
        codes = (
            frame.f_code
            for frame, _ in traceback.walk_tb(error.__traceback__)
            if not _is_library(frame.f_code, frame.f_globals.get("__name__", ""))
        )
        code = next(codes, None)
    if code is None:
        wrapped = NodeError(f"failed outside its hooks: {describe(error)}")
    else:
        where = f"{code.co_filename}:{code.co_firstlineno}"
        wrapped = CallbackError(describe(error), callback=code.co_name, where=where)
    wrapped.__cause__ = error
    return wrapped


def _code_of(callback: Any) -> CodeType | None:
    while isinstance(callback, functools.partial):
        callback = callback.func
    if not inspect.isroutine(callback):
        callback = getattr(callback, "__call__", None)  # noqa: B004 (its code, not whether)
    function = inspect.unwrap(callback) if callback else None
    code = getattr(function, "__code__", None)
    if not isinstance(code, CodeType):
        return None
    return None if _is_library(code, getattr(function, "__module__", "")) else code


def _is_library(code: CodeType, module: object) -> bool:
    """Whether code is of none of the plugins, which may be installed as libraries are."""
    if PREFIX in str(module):
        return False
    file = code.co_filename
    return file.startswith(("<", *_NOT_OF_PLUGINS)) or "site-packages" in file
