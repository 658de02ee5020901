"""What nodes of one process must not share: environment, modules of the project, output.

The process is a *stage* on which one node plays at a time. When another one enters, the process
gets that node's environment variables, import path, modules and log file. A process with one node
switches once; a process with many switches before each hook, so this is kept to a microsecond or
two: whole dictionaries are exchanged rather than filled.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any


class Scope:
    """The surroundings of one node.

    Args:
        environment: variables of this node, on top of those of the process.
        plugin: its file; the folder of that is searched first by ``import``.
        project: modules from below this folder are private to the node.
        log_file: where its standard output and error go, ``None`` to leave them.
    """

    def __init__(
        self,
        environment: Mapping[str, str],
        plugin: Path,
        project: Path,
        log_file: Path | None = None,
    ) -> None:
        self.variables = dict(environment)
        self.environ: dict[Any, Any] = {**_environ_data()}
        for key, value in environment.items():
            self.environ[os.environ.encodekey(key)] = os.environ.encodevalue(value)
        self.path = [str(plugin.parent), *sys.path]
        self.project = str(project) + os.sep
        self.modules: dict[str, ModuleType] = {}
        self.log_fd = None if log_file is None else _open_log(log_file)

    def close(self) -> None:
        """Close the log file."""
        if self.log_fd is not None:
            os.close(self.log_fd)


class Stage:
    """The process, and the node that plays on it now."""

    def __init__(self) -> None:
        self._current: Scope | None = None
        self._known_modules = len(sys.modules)

    def enter(self, scope: Scope) -> None:
        """Make the surroundings those of ``scope``."""
        current = self._current
        if current is scope:
            return
        if current is not None:
            self._leave(current)
        self._current = scope
        _set_variables(current.variables if current else {}, scope.variables)
        _exchange_environ(scope.environ)
        sys.path = scope.path
        if scope.modules:
            sys.modules.update(scope.modules)
        self._known_modules = len(sys.modules)
        if scope.log_fd is not None:
            os.dup2(scope.log_fd, 1)
            os.dup2(scope.log_fd, 2)

    def _leave(self, scope: Scope) -> None:
        if len(sys.modules) != self._known_modules:
            for name, module in tuple(sys.modules.items()):
                if str(getattr(module, "__file__", None) or "").startswith(scope.project):
                    scope.modules[name] = module
        for name in scope.modules:
            sys.modules.pop(name, None)
        scope.path = sys.path


def _open_log(path: Path) -> int:
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)


def _environ_data() -> dict[Any, Any]:
    return os.environ._data  # type: ignore[attr-defined,no-any-return]


def _exchange_environ(data: dict[Any, Any]) -> None:
    """Let ``os.environ`` itself show these variables, for those who hold a reference to it, too."""
    os.environ._data = data  # type: ignore[attr-defined]


def _set_variables(old: Mapping[str, str], new: Mapping[str, str]) -> None:
    """Let C libraries see the variables that differ (``getenv``)."""
    for name in old:
        if name not in new:
            os.unsetenv(name)
    for name, value in new.items():
        if old.get(name) != value:
            os.putenv(name, value)
