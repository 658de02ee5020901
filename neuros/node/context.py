"""The context of each node of a process: environment variables, modules of the project, output.

One context is in place at a time. Before a hook of another node runs, the process gets that node's
environment variables, import path, modules and log file. A process with one node switches once; a
process with many switches before each hook, so this is kept to a microsecond or two: whole
dictionaries are exchanged rather than filled.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

# Below a project's folder there may be a virtual environment, or NeuROS itself: all share those.
_SHARED = (str(Path(sys.prefix)) + os.sep, str(Path(__file__).resolve().parents[1]) + os.sep)
# Libraries whose state belongs to the whole process, so that one node at most can use them.
_FOR_ONE_NODE = {"nest": "NEST has one kernel per process"}


class Context:
    """Environment variables, modules and output of one node, or of the process itself.

    Made by :meth:`ContextSwitch.make_context`.

    Attributes:
        variables: environment variables of this node, on top of those of the process.
        environ: all its environment variables, encoded as ``os.environ`` keeps them.
        path: where ``import`` looks.
        project: modules from below this folder are private to the node; empty: none are.
        log_fd: where its standard output and error go, ``None`` to leave them.
    """

    def __init__(
        self,
        variables: Mapping[str, str],
        environ: dict[Any, Any],
        path: list[str],
        project: str = "",
        log_fd: int | None = None,
    ) -> None:
        self.variables = dict(variables)
        self.environ = environ
        self.path = path
        self.project = project
        self.modules: dict[str, ModuleType] = {}
        self.log_fd = log_fd

    def close(self) -> None:
        if self.log_fd is not None:
            os.close(self.log_fd)

    def hides(self, module: ModuleType) -> bool:
        """Whether a module is private to this node."""
        if not self.project:
            return False
        file = str(getattr(module, "__file__", None) or "")
        return file.startswith(self.project) and not file.startswith(_SHARED)


class _Imported:
    """Gives a node a module that the process has imported already."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        """It has run."""


class ContextSwitch:
    """Puts the context of one node at a time in place.

    On ``sys.meta_path`` it refuses to import a library that another node has for itself.

    Attributes:
        current: the context that is in place.
    """

    def __init__(self) -> None:
        self._process = Context({}, os.environ._data, sys.path)  # type: ignore[attr-defined]
        self.current = self._process
        self._known_modules = len(sys.modules)
        # A library that the program has imported itself belongs to none of the nodes yet.
        self._process.modules |= {n: sys.modules[n] for n in _FOR_ONE_NODE if n in sys.modules}
        self._owners: dict[str, Context] = {}
        sys.meta_path.insert(0, self)
        # By the contexts before and after a switch, the variables in which nodes differ.
        self._differing: dict[tuple[Context, Context], list[Any]] = {}

    def make_context(
        self,
        environment: Mapping[str, str],
        plugin: Path | None,
        project: Path,
        log_file: Path | None = None,
        *,
        shares_modules: bool = False,
    ) -> Context:
        """The context for a node.

        Args:
            environment: variables of this node, on top of those of the process.
            plugin: its file; the folder of that is searched first by ``import``. ``None`` for one
                of an installed package, which is found as it is.
            project: modules from below this folder are private to the node.
            log_file: where its standard output and error go, ``None`` to leave them.
            shares_modules: whether the plugin is functions of the program: no module of that is
                hidden from them.
        """
        log_fd = None
        if log_file is not None:
            log_file.parent.mkdir(parents=True, exist_ok=True)
            log_fd = os.open(log_file, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        context = Context(
            environment,
            self._environ_with(environment),
            [*([str(plugin.parent)] if plugin else []), *self._process.path],
            str(project) + os.sep,
            log_fd,
        )
        if shares_modules:
            context.modules = self._process.modules
        return context

    def enter(self, context: Context) -> None:
        current = self.current
        if current is context:
            return
        modules = sys.modules
        if len(modules) != self._known_modules:
            self._find_modules(current)
        for name in current.modules:
            modules.pop(name, None)
        self.current = context
        keys = self._differing.get((current, context))
        if keys is None:
            keys = self._differing[current, context] = _differing(current, context)
        for key in keys:  # C libraries see them, too (getenv)
            value = context.environ.get(key)
            if value is None:
                os.unsetenv(key)
            else:
                os.putenv(key, value)
        # Within os.environ itself, so that other references to it show these, too.
        own, os.environ._data = os.environ._data, context.environ  # type: ignore[attr-defined]
        current.environ, current.path, sys.path = own, sys.path, context.path
        modules.update(context.modules)
        self._known_modules = len(modules)
        if context.log_fd is not None:
            os.dup2(context.log_fd, 1)
            os.dup2(context.log_fd, 2)

    def leave(self) -> None:
        """Give the process its own context back (but for its output, if a node has a log)."""
        self.enter(self._process)

    def close(self) -> None:
        """Leave the import system as it was before."""
        self.leave()
        if self in sys.meta_path:
            sys.meta_path.remove(self)

    def why_bound(self, context: Context) -> str:
        """Which library holds state of this node outside of its modules; empty if none does."""
        names = [name for name, owner in self._owners.items() if owner is context]
        if not names:
            return ""
        return f"a plugin has imported {names[0]}, which keeps its state for the whole process"

    def renew(
        self, context: Context, environment: Mapping[str, str], *, forgets_modules: bool
    ) -> None:
        """Give a context these variables, as :meth:`make_context` does, and what it began with.

        It is not in place afterwards. ``forgets_modules``: those of the node are imported anew.
        """
        self.leave()
        self._differing.clear()
        context.variables = dict(environment)
        context.environ = self._environ_with(environment)
        if forgets_modules:
            context.modules.clear()

    def change(self, context: Context, variables: Mapping[str, str]) -> None:
        """Give the context that is in place other values of these variables."""
        self._differing.clear()
        context.variables |= variables
        os.environ.update(variables)

    def hide_from_nodes(self, project: Path) -> None:
        """Let nodes load modules below this folder anew, even if the process has them already."""
        self._process.project = str(project) + os.sep
        self._known_modules = -1

    def _environ_with(self, environment: Mapping[str, str]) -> dict[Any, Any]:
        environ = dict(self._process.environ)
        for key, value in environment.items():
            environ[os.environ.encodekey(key)] = os.environ.encodevalue(value)
        return environ

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        """Part of the import system: refuse a library that another node has for itself."""
        if name not in _FOR_ONE_NODE or self.current is self._process:
            return None
        if self._owners.setdefault(name, self.current) is not self.current:
            raise ImportError(
                f"{_FOR_ONE_NODE[name]}, and another node of this process uses it: run the project"
                " with --backend process"
            )
        module = self._process.modules.get(name)
        return None if module is None else ModuleSpec(name, _Imported(module))  # type: ignore[arg-type]

    def _find_modules(self, context: Context) -> None:
        """Note which modules of the process are private to a node."""
        for name, module in tuple(sys.modules.items()):
            if context.hides(module):
                context.modules[name] = module
        for name, owner in self._owners.items():
            if name in sys.modules and context is owner:
                context.modules[name] = self._process.modules[name] = sys.modules[name]


def _differing(old: Context, new: Context) -> list[Any]:
    """The names of the variables that differ, encoded as ``os.environ`` keeps them."""
    return [
        os.environ.encodekey(name)
        for name in {**old.variables, **new.variables}
        if old.variables.get(name) != new.variables.get(name)
    ]
