"""What goes wrong in a node: who is told, and what its log says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from neuros.errors import NeurosError, NodeError, PluginError, printable
from neuros.ports import Logger
from neuros.runtime.callbacks import callback_error
from neuros.runtime.plugin import describe, plugin_traceback


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
        """End the project with an error."""
        self._fail(self._name, error if isinstance(error, NeurosError) else as_node_error(error))

    def report_callback(self, callback: Any, error: BaseException) -> None:
        """End the project with the error of a callback that the plugin has registered with ROS."""
        self.report(error if isinstance(error, NeurosError) else callback_error(error, callback))

    def guard(self, event: Callable[[], None]) -> None:
        """Handle an event; what NeuROS says of it ends the project."""
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
