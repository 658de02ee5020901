"""Hooks and ports that a plugin declares, read without running it.

Only what is written as a literal is looked at. A name that is computed, a hook inside of an ``if``,
a decorator of another library: of those nothing is said, here or in
:mod:`neuros.project.checks`.
"""

from __future__ import annotations

import ast
import math
import re
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from neuros.project.scanner import read_bytes
from neuros.project.suggest import did_you_mean

_MOST_BYTES = 4 << 20
_HOOKS = "neuros.hooks"
_ARGUMENTS = {
    "neuros_initialise": ("inputs", "outputs"),
    "neuros_tick": ("seconds", "inputs", "outputs", "sim_seconds"),
    "neuros_function": ("inputs", "outputs"),
    "neuros_reset": ("inputs", "outputs"),
    "neuros_finalise": (),
}
_FOR_TOOLS = ("HookKind", "HookSpec", "InputSpec", "OutputSpec", "hook_specs_of")
PUBLIC_NAMES = ("All", "Optional", *_ARGUMENTS, *_FOR_TOOLS)
"""What there is in ``neuros.hooks``."""

# Packages whose functions are no hooks; those of any other one may be.
_WITHOUT_HOOKS = {"matplotlib", "mujoco", "nest", "numpy", "rclpy", "scipy"}
# With these, a plugin may make hooks in ways that are not to be seen.
_DYNAMIC = {"__import__", "eval", "exec", "globals", "import_module", "locals", "setattr", "vars"}
# What sends packets from a thread of the plugin.
_SENDERS = {"run_asynchronous", "submit"}
# What later versions of Python know: the node may run on one of those.
_NEWER = (
    ((3, 11), re.compile(r"\s*except\s*\*")),
    ((3, 12), re.compile(r"\s*(type\s+\w+|((async\s+)?def|class)\s+\w+\s*\[)")),
    ((3, 14), re.compile(r"\s*except\s[^(]*,|.*\b[tT][rR]?['\"]")),
)
_Function: TypeAlias = "ast.FunctionDef | ast.AsyncFunctionDef"
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Remark:
    """Something about a line of a plugin; line and column count from 1."""

    line: int
    column: int
    text: str
    hint: str = ""


@dataclass(frozen=True)
class DeclaredPort:
    """A port as a hook names it; ``name`` is ``None`` where it is computed."""

    name: str | None
    line: int
    column: int
    is_all: bool = False
    is_optional: bool = False


@dataclass(frozen=True)
class DeclaredHook:
    """A hook that the plugin has in any case; its ports are ``None`` where they are computed.

    ``sim_tick``: line and column of the period, if it ticks by simulated time; ``kind`` is that of
    its decorator, as ``neuros_tick``.
    """

    name: str
    inputs: tuple[DeclaredPort, ...] | None
    outputs: tuple[DeclaredPort, ...] | None
    sim_tick: tuple[int, int] | None = None
    kind: str = ""


@dataclass(frozen=True)
class NeededModule:
    """A module that is imported in any case; ``name`` begins with dots where that is relative."""

    name: str
    line: int
    column: int


@dataclass
class PluginFile:
    """A plugin, read.

    Attributes:
        hooks: those that are known.
        mistakes: what would keep a node with any ports from starting.
        doubts: what may be a mistake.
        imports: the modules that it imports.
        texts: all text constants.
        model_arguments: what is given to ``MuJoCo`` as its model.
        sets_timestep: whether it may change the timestep of a model.
        needs: the modules without which it cannot be imported.
        is_whole: whether ``hooks`` are all that it has, but for those that ``functions_of`` bring.
        functions_of: the modules that it imports functions from.
        sends_by_itself: whether packets may come from a thread, as from a simulation.
    """

    path: Path
    hooks: list[DeclaredHook] = field(default_factory=list)
    mistakes: list[Remark] = field(default_factory=list)
    doubts: list[Remark] = field(default_factory=list)
    imports: frozenset[str] = frozenset()
    texts: frozenset[str] = frozenset()
    model_arguments: tuple[ast.expr, ...] = ()
    sets_timestep: bool = False
    needs: tuple[NeededModule, ...] = ()
    is_whole: bool = False
    functions_of: frozenset[str] = frozenset()
    sends_by_itself: bool = False


def read_plugin(path: Path) -> PluginFile | None:
    """What a plugin declares; ``None`` if the file cannot be read, or is a compiled one."""
    if path.suffix != ".py":
        return None
    try:
        status = path.stat()
        return _read(path, status.st_mtime_ns, status.st_size)
    except OSError:
        return None


# Filters of warnings belong to the whole process, and up to Python 3.12 two threads that build
# syntax trees at once make each other fail (https://github.com/python/cpython/issues/106905).
_PARSING = threading.Lock()


@lru_cache(maxsize=256)
def _read(path: Path, *_: int) -> PluginFile:
    plugin, source = PluginFile(path), read_bytes(path, _MOST_BYTES)
    try:
        try:
            with _PARSING, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of syntax: Python shows them when it runs
                tree = ast.parse(source, str(path))
                compile(tree, str(path), "exec", dont_inherit=True)
        except SyntaxError as error:
            remark = Remark(error.lineno or 1, error.offset or 1, f"syntax error: {error.msg}")
            (plugin.doubts if _may_be_newer(error, source) else plugin.mistakes).append(remark)
        except ValueError as error:  # a NUL character, up to Python 3.11
            plugin.mistakes.append(Remark(1, 1, f"syntax error: {error}"))
        else:
            _Reader(plugin, tree).read()
    except (RecursionError, MemoryError):  # so deeply nested that Python gives up, in either way
        pass
    return plugin


def _may_be_newer(error: SyntaxError, source: bytes) -> bool:
    """Whether it may be right in a later version of Python."""
    lines = source.decode("utf-8", "replace").splitlines()
    line = lines[error.lineno - 1] if error.lineno and error.lineno <= len(lines) else ""
    if sys.version_info < (3, 12) and (error.msg or "").startswith("f-string"):
        return True
    return any(sys.version_info < version and form.match(line) for version, form in _NEWER)


class _Reader:
    """Reads one plugin.

    A name has a meaning where all its bindings, in all scopes, are equal.
    """

    def __init__(self, plugin: PluginFile, tree: ast.Module) -> None:
        self._plugin = plugin
        self._tree = tree
        self._nodes = [*ast.walk(tree)]
        self._origins: dict[str, set[str]] = {}
        self._stars: list[str] = []
        for node in self._nodes:
            self._bind(node)

    def read(self) -> None:
        plugin, nodes = self._plugin, self._nodes
        self._read_statements()
        if not plugin.hooks and not plugin.mistakes and not self._may_have_hooks():
            hint = "mark functions with @neuros_function or @neuros_tick from neuros.hooks"
            plugin.mistakes.append(Remark(1, 1, "declares no hooks", hint))
        constants = (node.value for node in nodes if isinstance(node, ast.Constant))
        plugin.texts = frozenset(value for value in constants if isinstance(value, str))
        plugin.model_arguments = tuple(self._model_arguments())
        marks = {f"{_HOOKS}.{name}" for name in _ARGUMENTS}
        expressions = [each for each in nodes if isinstance(each, ast.Name | ast.Attribute)]
        found = [each for each in expressions if self._meaning(each) in marks]
        is_computed = any(_names_in(each) & _DYNAMIC for each in nodes)
        plugin.is_whole = not is_computed and len(found) == len(plugin.hooks)
        brought = [each for each in nodes if isinstance(each, ast.ImportFrom)]
        plugin.functions_of = frozenset(
            "." * each.level + (each.module or "")
            for each in brought
            if not _brings_no_functions(each)
        )
        is_path_changed = any(
            isinstance(each, ast.Attribute) and self._meaning(each) == "sys.path" for each in nodes
        )
        plugin.needs = () if is_path_changed else tuple(_needed_in(self._tree.body))
        plugin.sends_by_itself = any(
            isinstance(each, ast.Attribute) and each.attr in _SENDERS for each in nodes
        )
        plugin.sets_timestep = any(
            node.attr in ("opt", "option")
            or (node.attr == "timestep" and isinstance(node.ctx, ast.Store))
            for node in nodes
            if isinstance(node, ast.Attribute)
        )

    def _read_statements(self) -> None:
        """What is executed in any case when the plugin is imported."""
        lines: dict[str, int] = {}  # of the last hook of each name
        for statement in self._tree.body:
            if isinstance(statement, ast.ImportFrom):
                self._check_import(statement)
            if not isinstance(statement, (*_FUNCTIONS, ast.ClassDef)):
                continue
            name, line = statement.name, statement.lineno
            if name in lines:
                text = f"hook '{name}' never runs: line {line} defines another '{name}'"
                self._plugin.doubts.append(Remark(lines.pop(name), 1, text))
            if isinstance(statement, _FUNCTIONS) and self._read_function(statement):
                lines[name] = line

    # ------------------------------------------------------------------ what names mean

    def _bind(self, node: ast.AST) -> None:
        def bind(name: str, origin: str) -> None:
            self._origins.setdefault(name, set()).add(origin)

        if isinstance(node, ast.Import):
            self._plugin.imports |= {alias.name for alias in node.names}
            for alias in node.names:
                top = alias.name.partition(".")[0]
                bind(alias.asname or top, alias.name if alias.asname else top)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            self._plugin.imports |= {module}
            for alias in node.names:
                if alias.name == "*":
                    self._stars.append(module)
                else:
                    bind(alias.asname or alias.name, f"{module}.{alias.name}")
        elif isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            bind(node.id, "")
        elif isinstance(node, (*_FUNCTIONS, ast.ClassDef)):
            bind(node.name, "")

    def _check_import(self, node: ast.ImportFrom) -> None:
        for alias in node.names if node.module == _HOOKS and not node.level else ():
            if alias.name not in ("*", *PUBLIC_NAMES):
                hint = did_you_mean(alias.name, PUBLIC_NAMES)
                self._mistake(node, f"neuros.hooks has no '{alias.name}'", hint)

    def _meaning(self, expression: ast.expr) -> str:
        """The dotted name behind an expression, empty if it is not known."""
        if isinstance(expression, ast.Attribute):
            base = self._meaning(expression.value)
            return f"{base}.{expression.attr}" if base else ""
        if not isinstance(expression, ast.Name):
            return ""
        origins = self._origins.get(expression.id, set())
        if not origins and self._stars == [_HOOKS] and expression.id in PUBLIC_NAMES:
            return f"{_HOOKS}.{expression.id}"
        return next(iter(origins)) if len(origins) == 1 else ""

    def _of_hooks(self, expression: ast.expr) -> str:
        """The name that something has in ``neuros.hooks``, empty if it is not from there."""
        module, _, name = self._meaning(expression).rpartition(".")
        if module == _HOOKS:
            return name
        if not isinstance(expression, ast.Name) or self._stars:
            return ""
        if expression.id not in PUBLIC_NAMES or expression.id in self._origins:
            return ""
        import_ = f"from neuros.hooks import {expression.id}"
        self._mistake(expression, f"'{expression.id}' is not imported", import_)
        return expression.id

    def _may_have_hooks(self) -> bool:
        """Whether hooks may come from somewhere else."""
        if any(module != _HOOKS for module in self._stars):
            return True
        for node in self._nodes:
            if _names_in(node) & (_DYNAMIC | {*_ARGUMENTS}):
                return True
            if isinstance(node, ast.ImportFrom) and not _brings_no_functions(node):
                return True
        return False

    def _model_arguments(self) -> Iterator[ast.expr]:
        for node in self._nodes:
            if isinstance(node, ast.Call) and self._meaning(node.func) in (
                "neuros.simulators.mujoco.MuJoCo",
                "neuros.simulators.mujoco.simulator.MuJoCo",
            ):
                given = [k.value for k in node.keywords if k.arg == "model"] or node.args[1:2]
                yield self._value(given[0]) if given else ast.Constant(None)

    def _value(self, expression: ast.expr) -> ast.expr:
        """The value of a name that is bound once; any other expression unchanged."""
        if isinstance(expression, ast.Name):
            name = expression.id
            made = [each for each in self._nodes if getattr(each, "targets", None)]
            values = [a.value for a in made if isinstance(a, ast.Assign) and _binds(a, name)]
            stores = [n for n in self._nodes if isinstance(n, ast.Name) and n.id == name]
            if sum(not isinstance(n.ctx, ast.Load) for n in stores) == len(values) == 1:
                return values[0]
        return expression

    # ------------------------------------------------------------------ hooks

    def _read_function(self, function: _Function) -> bool:
        """Read the hooks that a function is; returns whether it is any."""
        marks = [(each, self._kind(each)) for each in function.decorator_list]
        is_plain = all(kind for _, kind in marks)
        for decorator, kind in marks:
            if not kind:
                continue
            hook = self._hook(function, decorator, kind)
            self._plugin.hooks.append(hook)
            if is_plain and hook.inputs is not None:
                self._check_signature(function, hook.inputs)
        if is_plain and marks:
            self._check_kind_of_function(function)
        return any(kind for _, kind in marks)

    def _kind(self, decorator: ast.expr) -> str:
        called = decorator.func if isinstance(decorator, ast.Call) else decorator
        name = self._of_hooks(called)
        return name if name in _ARGUMENTS else ""

    def _hook(self, function: _Function, decorator: ast.expr, kind: str) -> DeclaredHook:
        unknown = DeclaredHook(function.name, None, None, kind=kind)
        if not isinstance(decorator, ast.Call):
            self._fail(function, decorator, f"@{kind} needs parentheses")
            return unknown
        names, given = _ARGUMENTS[kind], dict[str, ast.expr]()
        is_known = not any(isinstance(each, ast.Starred) for each in decorator.args)
        if is_known:
            given |= zip(names, decorator.args, strict=False)
            if len(decorator.args) > len(names):
                takes = ", ".join(names) or "no arguments"
                text = f"@{kind} takes {takes}, but is given {len(decorator.args)}"
                self._fail(function, decorator, text)
        for keyword in decorator.keywords:
            if keyword.arg is None:
                is_known = False
            elif keyword.arg not in names:
                text = f"@{kind} has no argument '{keyword.arg}'"
                self._fail(function, keyword.value, text, did_you_mean(keyword.arg, names))
            else:
                given[keyword.arg] = keyword.value
        if not is_known:
            return unknown
        is_right = kind == "neuros_tick" and self._check_period(function, decorator, given)
        period = given.get("sim_seconds") if is_right else None
        return DeclaredHook(
            function.name,
            self._ports(function, given.get("inputs"), "input"),
            self._ports(function, given.get("outputs"), "output"),
            None if period is None else (period.lineno, period.col_offset + 1),
            kind,
        )

    def _check_period(
        self, function: _Function, decorator: ast.expr, given: Mapping[str, ast.expr]
    ) -> bool:
        """Report what is wrong with the period of a tick; returns whether nothing is."""
        nothing = (name for name, each in given.items() if ast.unparse(each) == "None")
        periods = sorted({"seconds", "sim_seconds"} & (given.keys() - {*nothing}))
        if len(periods) != 1:
            text = "@neuros_tick needs seconds or sim_seconds, and not both"
            self._fail(function, decorator, text, "seconds=0.02")
            return False
        (name,) = periods
        seconds = given[name]
        try:
            value = ast.literal_eval(seconds)
        except (TypeError, ValueError):
            return True
        if isinstance(value, bool) or not isinstance(value, int | float):
            self._fail(function, seconds, f"{name}={value!r} is not a number")
        elif not (math.isfinite(value) and value > 0):
            self._fail(function, seconds, f"{name}={value!r} is not a positive time")
        else:
            return True
        return False

    def _ports(
        self, function: _Function, written: ast.expr | None, side: str
    ) -> tuple[DeclaredPort, ...] | None:
        if written is None or (isinstance(written, ast.Constant) and written.value is None):
            return ()
        if isinstance(written, ast.Dict):
            return None  # its keys are the ports
        is_list = isinstance(written, ast.List | ast.Tuple | ast.Set)
        entries = written.elts if isinstance(written, ast.List | ast.Tuple | ast.Set) else [written]
        ports = [self._port(function, entry, side) for entry in entries]
        found = tuple(port for port in ports if port)
        if len(found) < len(ports):
            return None
        if not is_list and found[0].name is None:
            return None  # it may be a list of ports
        names = [port.name for port in found]
        for index, (entry, name) in enumerate(zip(entries, names, strict=True)):
            if name is not None and names.index(name) < index:
                self._fail(function, entry, f"{side} '{name}' is named twice")
        return found

    def _port(self, function: _Function, entry: ast.expr, side: str) -> DeclaredPort | None:
        """One port; ``None`` where even their number is not known."""
        if isinstance(entry, ast.Starred):
            return None
        inner, wrappers = entry, list[str]()
        while isinstance(inner, ast.Call) and (
            (name := self._of_hooks(inner.func)) in ("All", "Optional")
        ):
            arguments = [*inner.args, *(keyword.value for keyword in inner.keywords)]
            if len(arguments) != 1:
                break
            wrappers.append(name)
            inner = arguments[0]
        value = inner.value if isinstance(inner, ast.Constant) else None
        if not isinstance(value, str):
            if isinstance(inner, ast.Constant | ast.Dict | ast.List | ast.Tuple | ast.Set):
                self._not_a_port(function, entry, side)
            return DeclaredPort(None, entry.lineno, entry.col_offset + 1)
        if side == "output" and "All" in wrappers:
            text = f"output '{value}' is wrapped in All, which is for inputs only"
            self._fail(function, entry, text)
        elif wrappers not in ([], ["Optional"], ["All"], ["Optional", "All"]):
            self._not_a_port(function, entry, side)
        return DeclaredPort(
            value, entry.lineno, entry.col_offset + 1, "All" in wrappers, "Optional" in wrappers
        )

    def _not_a_port(self, function: _Function, entry: ast.expr, side: str) -> None:
        more = ", Optional(name), All(name) or Optional(All(name))"
        allowed = f"a name{more}" if side == "input" else "a name or Optional(name)"
        self._fail(function, entry, f"{ast.unparse(entry)} is not an {side}", f"give {allowed}")

    def _check_signature(self, function: _Function, inputs: Sequence[DeclaredPort]) -> None:
        """Whether it can be called with the node and its inputs."""
        takes = function.args
        plain = [each.arg for each in (*takes.posonlyargs, *takes.args)]
        needed = len(plain) - len(takes.defaults)
        given = 1 + len(inputs)
        is_too_much = given > len(plain) and takes.vararg is None
        lacks = [
            each.arg
            for each, default in zip(takes.kwonlyargs, takes.kw_defaults, strict=True)
            if default is None
        ]
        names = [port.name or "..." for port in inputs]
        gets = f"gets ({', '.join(['node', *names])})"
        shown = [*plain, *([f"*{takes.vararg.arg}"] if takes.vararg else []), *lacks]
        if is_too_much or given < needed or lacks:
            self._mistake(
                function, f"hook '{function.name}' {gets}, but takes ({', '.join(shown)})"
            )
        elif plain[1:] != names and sorted(plain[1:]) == sorted(names) and len(set(names)) > 1:
            text = f"hook '{function.name}' {gets}, and takes ({', '.join(shown)})"
            hint = "packets come in the order of the declaration"
            self._plugin.doubts.append(_remark(function, text, hint))

    def _check_kind_of_function(self, function: _Function) -> None:
        who = f"hook '{function.name}'"
        if isinstance(function, ast.AsyncFunctionDef):
            hint = "only callbacks of ROS may be coroutines"
            self._mistake(function, f"{who} is a coroutine, and would never run", hint)
        elif any(isinstance(node, ast.Yield | ast.YieldFrom) for node in _own_nodes(function)):
            text = f"{who} has 'yield', and would never run"
            self._mistake(function, text, "a hook returns its packets")

    def _fail(self, function: _Function, node: ast.AST, text: str, hint: str = "") -> None:
        self._mistake(node, f"hook '{function.name}': {text}", hint)

    def _mistake(self, node: ast.AST, text: str, hint: str = "") -> None:
        remark = _remark(node, text, hint)
        if remark not in self._plugin.mistakes:
            self._plugin.mistakes.append(remark)


def _remark(node: ast.AST, text: str, hint: str = "") -> Remark:
    return Remark(getattr(node, "lineno", 1), getattr(node, "col_offset", 0) + 1, text, hint)


def _needed_in(statements: Sequence[ast.stmt]) -> Iterator[NeededModule]:
    """What is imported in any case, and not only if it is there."""
    for each in statements:
        place = each.lineno, each.col_offset + 1
        if isinstance(each, ast.Import):
            yield from (NeededModule(alias.name, *place) for alias in each.names)
        elif isinstance(each, ast.ImportFrom):
            yield NeededModule("." * each.level + (each.module or ""), *place)
        elif isinstance(each, ast.ClassDef):
            yield from _needed_in(each.body)


def _names_in(node: ast.AST) -> set[Any]:
    return {getattr(node, "id", None), getattr(node, "attr", None)}


def _binds(assignment: ast.Assign, name: str) -> bool:
    return any(isinstance(each, ast.Name) and each.id == name for each in assignment.targets)


def _own_nodes(function: _Function) -> Iterator[ast.AST]:
    """What is in a function, but not in those that it defines itself."""
    waiting: list[ast.AST] = [*function.body]
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (*_FUNCTIONS, ast.Lambda, ast.ClassDef)):
            waiting += ast.iter_child_nodes(node)


def _brings_no_functions(node: ast.ImportFrom) -> bool:
    """Whether what is imported cannot be a hook: a function of Python's own library, or a class."""
    top = (node.module or "").partition(".")[0]
    if node.level == 0 and (top in sys.stdlib_module_names or top in _WITHOUT_HOOKS):
        return True
    if node.level == 0 and top == "neuros":
        return True
    return all(alias.name[:1].isupper() for alias in node.names)
