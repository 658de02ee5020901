"""Hooks and ports that a plugin declares, read from its syntax tree without running it.

Only literals are read, and judged as the decorators of :mod:`neuros.hooks` judge their arguments. A
computed name, a hook inside of an ``if``, a decorator of another library are unknown: neither this
module nor :mod:`neuros.project.checks` reports a problem with them.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import neuros.hooks
from neuros.errors import Problem, UsageError
from neuros.hooks import (
    HookSpec,
    InputSpec,
    batch_of,
    hook_specs_of,
    input_of,
    output_of,
    period_of,
)
from neuros.project.model import Node
from neuros.project.scanner import display_name, read_bytes
from neuros.project.suggest import did_you_mean

_MOST_BYTES = 4 << 20
_HOOKS = "neuros.hooks"
_ARGUMENTS = {
    name: tuple(inspect.signature(getattr(neuros.hooks, name)).parameters)
    for name in neuros.hooks.__all__
    if name.startswith("neuros_")
}
_WRAPPERS = {"All": neuros.hooks.All, "Optional": neuros.hooks.Optional}

# Packages whose functions are no hooks; a function of any other package may be one.
_WITHOUT_HOOKS = {"matplotlib", "mujoco", "nest", "neuros", "numpy", "rclpy", "scipy"}
# With these names, a plugin may make hooks that its syntax tree does not show.
_DYNAMIC = {"__import__", "eval", "exec", "globals", "import_module", "locals", "setattr", "vars"}
# Methods of the node and of simulators that send packets from a thread.
_SENDERS = {"run_asynchronous", "submit"}
# Syntax of later versions of Python, on which the node may run.
_NEWER = (
    ((3, 11), re.compile(r"\s*except\s*\*")),
    ((3, 12), re.compile(r"\s*(type\s+\w+|((async\s+)?def|class)\s+\w+\s*\[)")),
    ((3, 14), re.compile(r"\s*except\s[^(]*,|.*\b[tT][rR]?['\"]")),
)
_MUJOCO = {
    "neuros.simulators.mujoco.MuJoCo",
    "neuros.simulators.mujoco.MuJoCoWorlds",
    "neuros.simulators.mujoco.simulator.MuJoCo",
}
_Function: TypeAlias = "ast.FunctionDef | ast.AsyncFunctionDef"
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Remark:
    """Something about a line of a plugin; line and column count from 1."""

    line: int
    column: int
    text: str
    hint: str = ""

    def in_file(self, path: Path) -> Problem:
        return Problem(display_name(path), self.line, self.column, "", self.text, self.hint)


@dataclass(frozen=True)
class PluginPort:
    """A port as a hook names it; ``name`` is ``None`` where it is computed."""

    name: str | None
    line: int
    column: int
    is_all: bool = False
    is_optional: bool = False


@dataclass(frozen=True)
class PluginHook:
    """A hook that the plugin has in any case.

    Attributes:
        inputs, outputs: ``None`` where their number is computed.
        sim_tick: line and column of the period, for a tick by simulated time.
        kind: the name of the decorator, as ``neuros_tick``.
        is_batch: whether it takes batches; ``None`` where that is computed.
        place: line and column of the decorator.
    """

    name: str
    inputs: tuple[PluginPort, ...] | None
    outputs: tuple[PluginPort, ...] | None
    sim_tick: tuple[int, int] | None = None
    kind: str = ""
    is_batch: bool | None = False
    place: tuple[int, int] = (1, 1)


@dataclass(frozen=True)
class NeededModule:
    """A module that is imported in any case; ``name`` begins with dots if relative."""

    name: str
    line: int
    column: int


@dataclass
class PluginFile:
    """The content of a plugin, as far as its syntax tree tells.

    Attributes:
        hooks: the known hooks.
        mistakes: keep a node from starting, whatever ports it has.
        doubts: possible mistakes.
        imports: names of all imported modules.
        texts: all text constants.
        model_arguments: the expressions given to ``MuJoCo`` or ``MuJoCoWorlds`` as the model.
        sets_timestep: whether the plugin may change the timestep of a model.
        needs: the modules without which the plugin cannot be imported.
        is_whole: whether ``hooks`` has every hook, but for hooks of modules in ``functions_of``.
        functions_of: the modules from which the plugin imports functions.
        sends_by_itself: whether packets may come from a thread, as from a simulation.
    """

    path: Path
    hooks: list[PluginHook] = field(default_factory=list)
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


def plugins_of(node: Node) -> list[PluginFile]:
    """The declarations of a node's plugin; of its functions, one for each file they are in.

    Empty if the plugin cannot be read.
    """
    if node.hooks:
        return read_functions(node.hooks)
    plugin = None if node.plugin == Path() else read_plugin(node.plugin)
    return [] if plugin is None else [plugin]


def file_of(functions: Sequence[Callable[..., Any]]) -> Path:
    """The file of the first of the functions, which need not exist: they may be of a notebook."""
    return next((plugin.path for plugin in read_functions(functions)), Path())


def read_functions(functions: Sequence[Callable[..., Any]]) -> list[PluginFile]:
    found: dict[str, PluginFile] = {}
    for spec in hook_specs_of(dict(enumerate(functions))):
        file, _, line = spec.where.rpartition(":")
        plugin = found.setdefault(file, PluginFile(Path(file), is_whole=True))
        place = int(line) if file else 1, 1
        plugin.hooks.append(
            PluginHook(
                spec.name,
                tuple(PluginPort(p.name, *place, p.is_all, p.is_optional) for p in spec.inputs),
                tuple(PluginPort(p.name, *place, False, p.is_optional) for p in spec.outputs),
                None if spec.sim_period_s is None else place,
                f"neuros_{spec.kind.value}",
                spec.is_batch,
                place,
            )
        )
        _Reader.check_source(plugin, spec)
    return [*found.values()]


def read_plugin(path: Path) -> PluginFile | None:
    """The declarations of a plugin; ``None`` if the file cannot be read, or is compiled."""
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
    except (RecursionError, MemoryError):  # Python raises either for code nested too deeply
        pass
    return plugin


def _may_be_newer(error: SyntaxError, source: bytes) -> bool:
    """Whether the source may be right in a later version of Python."""
    lines = source.decode("utf-8", "replace").splitlines()
    line = lines[error.lineno - 1] if error.lineno and error.lineno <= len(lines) else ""
    if sys.version_info < (3, 12) and (error.msg or "").startswith("f-string"):
        return True
    return any(sys.version_info < version and form.match(line) for version, form in _NEWER)


class _Reader:
    """Reads one plugin.

    A name has a known meaning if all its bindings, in all scopes, are equal.
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
        lines: dict[str, int] = {}  # of the last hook of each name
        for statement in self._tree.body:  # functions in an ``if`` are not read
            if isinstance(statement, (*_FUNCTIONS, ast.ClassDef)):
                name, line = statement.name, statement.lineno
                if name in lines:
                    text = f"hook '{name}' never runs: line {line} defines another '{name}'"
                    plugin.doubts.append(Remark(lines.pop(name), 1, text))
                if isinstance(statement, _FUNCTIONS) and self._read_hooks(statement):
                    lines[name] = line
            elif isinstance(statement, ast.ImportFrom) and _module(statement) == _HOOKS:
                for alias in statement.names:
                    if alias.name not in ("*", *neuros.hooks.__all__):
                        hint = did_you_mean(alias.name, neuros.hooks.__all__)
                        self._mistake(statement, f"neuros.hooks has no '{alias.name}'", hint)
        attributes = [each for each in nodes if isinstance(each, ast.Attribute)]
        names = [each for each in nodes if isinstance(each, ast.Name)]
        words = {*(each.attr for each in attributes), *(each.id for each in names)}
        plugin.functions_of = frozenset(
            _module(each)
            for each in nodes
            if isinstance(each, ast.ImportFrom) and not _brings_no_functions(each)
        )
        has_other_hooks = (
            any(module != _HOOKS for module in self._stars)
            or words & (_DYNAMIC | {*_ARGUMENTS})
            or plugin.functions_of
        )
        if not plugin.hooks and not plugin.mistakes and not has_other_hooks:
            hint = "mark functions with @neuros_function or @neuros_tick from neuros.hooks"
            plugin.mistakes.append(Remark(1, 1, "declares no hooks", hint))
        constants = (node.value for node in nodes if isinstance(node, ast.Constant))
        plugin.texts = frozenset(value for value in constants if isinstance(value, str))
        plugin.model_arguments = tuple(
            self._assigned(given[0]) if given else ast.Constant(None)
            for node in nodes
            if isinstance(node, ast.Call) and self._meaning(node.func) in _MUJOCO
            for given in [[k.value for k in node.keywords if k.arg == "model"] or node.args[1:2]]
        )
        meanings = [self._meaning(each) for each in (*names, *attributes)]
        marks = [each for each in meanings if each.rpartition(".")[2] in _ARGUMENTS]
        marks = [each for each in marks if each.startswith(f"{_HOOKS}.")]
        plugin.is_whole = not words & _DYNAMIC and len(marks) == len(plugin.hooks)
        plugin.needs = () if "sys.path" in meanings else tuple(_needed_in(self._tree.body))
        plugin.sends_by_itself = any(each.attr in _SENDERS for each in attributes)
        plugin.sets_timestep = any(
            each.attr in ("opt", "option")
            or (each.attr == "timestep" and isinstance(each.ctx, ast.Store))
            for each in attributes
        )

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
            module = _module(node)
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

    def _meaning(self, expression: ast.expr) -> str:
        """The dotted name behind an expression, empty if it is not known."""
        if isinstance(expression, ast.Attribute):
            base = self._meaning(expression.value)
            return f"{base}.{expression.attr}" if base else ""
        if not isinstance(expression, ast.Name):
            return ""
        origins = self._origins.get(expression.id, set())
        if not origins and self._stars == [_HOOKS] and expression.id in neuros.hooks.__all__:
            return f"{_HOOKS}.{expression.id}"
        return next(iter(origins)) if len(origins) == 1 else ""

    def _of_hooks(self, expression: ast.expr) -> str:
        """The name that something has in ``neuros.hooks``, empty if it is not from there."""
        module, _, name = self._meaning(expression).rpartition(".")
        if module == _HOOKS:
            return name
        if not isinstance(expression, ast.Name) or self._stars:
            return ""
        if expression.id not in neuros.hooks.__all__ or expression.id in self._origins:
            return ""
        import_ = f"from neuros.hooks import {expression.id}"
        self._mistake(expression, f"'{expression.id}' is not imported", import_)
        return expression.id

    def _assigned(self, expression: ast.expr) -> ast.expr:
        """The value of a name that is bound once; any other expression unchanged."""
        if isinstance(expression, ast.Name):
            name = expression.id
            values = [
                each.value
                for each in self._nodes
                if isinstance(each, ast.Assign)
                and any(isinstance(to, ast.Name) and to.id == name for to in each.targets)
            ]
            stores = [n for n in self._nodes if isinstance(n, ast.Name) and n.id == name]
            if sum(not isinstance(n.ctx, ast.Load) for n in stores) == len(values) == 1:
                return values[0]
        return expression

    def _literal(self, expression: ast.expr) -> Any:
        """The value of a literal, in ``All`` and ``Optional`` too. Raises ``ValueError`` else."""
        if not isinstance(expression, ast.Call):
            return ast.literal_eval(expression)
        arguments = [*expression.args, *(keyword.value for keyword in expression.keywords)]
        wrapper = _WRAPPERS.get(self._of_hooks(expression.func))
        if wrapper is None or len(arguments) != 1:
            raise ValueError("computed")
        return wrapper(self._literal(arguments[0]))

    # ------------------------------------------------------------------ hooks

    def _read_hooks(self, function: _Function) -> bool:
        """Read the decorators of a function; returns whether one of them marks a hook."""
        kinds = [
            self._of_hooks(each.func if isinstance(each, ast.Call) else each)
            for each in function.decorator_list
        ]
        is_plain = all(kind in _ARGUMENTS for kind in kinds)
        for decorator, kind in zip(function.decorator_list, kinds, strict=True):
            if kind not in _ARGUMENTS:
                continue
            hook = self._hook(function, decorator, kind)
            self._plugin.hooks.append(hook)
            if is_plain and hook.inputs is not None:
                self._check_signature(function, hook.inputs)
        if is_plain and kinds:
            self._check_kind(function)
        return any(kind in _ARGUMENTS for kind in kinds)

    def _check_kind(self, function: _Function) -> None:
        """Whether a call of the function runs it."""
        who = f"hook '{function.name}'"
        if isinstance(function, ast.AsyncFunctionDef):
            hint = "only callbacks of ROS may be coroutines"
            self._mistake(function, f"{who} is a coroutine, and would never run", hint)
        elif any(isinstance(node, ast.Yield | ast.YieldFrom) for node in _own_nodes(function)):
            text = f"{who} has 'yield', and would never run"
            self._mistake(function, text, "a hook returns its packets")

    @classmethod
    def check_source(cls, plugin: PluginFile, spec: HookSpec) -> None:
        """Check the source of a function of this program, if Python has kept it."""
        try:
            lines, first = inspect.getsourcelines(spec.function)
            with _PARSING:
                tree = ast.parse(textwrap.dedent("".join(lines)))
        except (OSError, TypeError, SyntaxError):  # of a shell, or in the middle of an expression
            plugin.is_whole = False  # it may send from a thread
            return
        ast.increment_lineno(tree, first - 1)
        reader, (function, *_) = cls(plugin, tree), tree.body
        if isinstance(function, _FUNCTIONS) and not hasattr(spec.function, "__wrapped__"):
            reader._check_signature(function, plugin.hooks[-1].inputs or ())
            reader._check_kind(function)
        attributes = (each for each in reader._nodes if isinstance(each, ast.Attribute))
        plugin.sends_by_itself |= any(each.attr in _SENDERS for each in attributes)

    def _hook(self, function: _Function, decorator: ast.expr, kind: str) -> PluginHook:
        unknown = PluginHook(function.name, None, None, kind=kind, is_batch=None)
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
        is_batch, batch = None, given.get("batch")
        try:
            is_batch = batch_of(False if batch is None else ast.literal_eval(batch))
        except UsageError as error:
            self._fail(function, batch or function, str(error))
        except (TypeError, ValueError):  # it is computed
            pass
        return PluginHook(
            function.name,
            self._ports(function, given.get("inputs"), "input"),
            self._ports(function, given.get("outputs"), "output"),
            self._sim_tick(function, decorator, given) if kind == "neuros_tick" else None,
            kind,
            is_batch,
            (decorator.lineno, decorator.col_offset + 1),
        )

    def _sim_tick(
        self, function: _Function, decorator: ast.expr, given: Mapping[str, ast.expr]
    ) -> tuple[int, int] | None:
        """Line and column of the period, if a tick is right, and by simulated time."""
        written, values = dict[str, ast.expr](), dict[str, Any]()
        for name in ("seconds", "sim_seconds"):
            if name in given and ast.unparse(given[name]) != "None":
                written[name] = given[name]
                try:
                    values[name] = self._literal(given[name])
                except (TypeError, ValueError):
                    values[name] = 1.0  # it is computed, and may be right
        try:
            name, _ = period_of(values)
        except ValueError as error:
            place = decorator if len(written) != 1 else next(iter(written.values()))
            self._fail(function, place, str(error))
            return None
        period = written[name]
        return (period.lineno, period.col_offset + 1) if name == "sim_seconds" else None

    def _ports(
        self, function: _Function, written: ast.expr | None, side: str
    ) -> tuple[PluginPort, ...] | None:
        """The ports of one side; ``None`` where even their number is computed."""
        if written is None or (isinstance(written, ast.Constant) and written.value is None):
            return ()
        is_list = isinstance(written, ast.List | ast.Tuple | ast.Set)
        entries = written.elts if isinstance(written, ast.List | ast.Tuple | ast.Set) else [written]
        if any(isinstance(entry, ast.Starred | ast.Dict) for entry in entries):
            return None  # the keys of a dict are ports
        found: list[PluginPort] = []
        for entry in entries:
            place = entry.lineno, entry.col_offset + 1
            try:
                value = self._literal(entry)
            except (TypeError, ValueError):
                if not is_list:
                    return None  # it may be a list of ports
                found.append(PluginPort(None, *place))
                continue
            try:
                spec = input_of(value) if side == "input" else output_of(value)
                if any(port.name == spec.name for port in found):
                    raise ValueError(f"{side} '{spec.name}' is named twice")
            except ValueError as error:
                self._fail(function, entry, str(error))
                return None
            is_all = isinstance(spec, InputSpec) and spec.is_all
            found.append(PluginPort(spec.name, *place, is_all, spec.is_optional))
        return tuple(found)

    def _check_signature(self, function: _Function, inputs: Sequence[PluginPort]) -> None:
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

    def _fail(self, function: _Function, node: ast.AST, text: str, hint: str = "") -> None:
        self._mistake(node, f"hook '{function.name}': {text}", hint)

    def _mistake(self, node: ast.AST, text: str, hint: str = "") -> None:
        remark = _remark(node, text, hint)
        if remark not in self._plugin.mistakes:
            self._plugin.mistakes.append(remark)


def _remark(node: ast.AST, text: str, hint: str = "") -> Remark:
    return Remark(getattr(node, "lineno", 1), getattr(node, "col_offset", 0) + 1, text, hint)


def _needed_in(statements: Sequence[ast.stmt]) -> Iterator[NeededModule]:
    """The modules of import statements that are executed in any case."""
    for each in statements:
        place = each.lineno, each.col_offset + 1
        if isinstance(each, ast.Import):
            yield from (NeededModule(alias.name, *place) for alias in each.names)
        elif isinstance(each, ast.ImportFrom):
            yield NeededModule(_module(each), *place)
        elif isinstance(each, ast.ClassDef):
            yield from _needed_in(each.body)


def _module(node: ast.ImportFrom) -> str:
    return "." * node.level + (node.module or "")


def _own_nodes(function: _Function) -> Iterator[ast.AST]:
    """The nodes of a function without those of functions and classes inside of it."""
    waiting: list[ast.AST] = [*function.body]
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (*_FUNCTIONS, ast.Lambda, ast.ClassDef)):
            waiting += ast.iter_child_nodes(node)


def _brings_no_functions(node: ast.ImportFrom) -> bool:
    """Whether no imported name can be a hook: functions of libraries, and classes, are none."""
    top = (node.module or "").partition(".")[0]
    if node.level == 0 and (top in sys.stdlib_module_names or top in _WITHOUT_HOOKS):
        return True
    return all(alias.name[:1].isupper() for alias in node.names)
