"""Plugin files of functions: where nodes run in other processes, these have to come from a file.

The file has the source of each function, and what that source names: imports, further functions
and classes of the same module, and plain values. A function that needs anything else (a variable
around it, an array, an open file) is refused by that name, since the file would do something else
than the function.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import json
import os
import shutil
import symtable
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from neuros.backends.containers import find_container
from neuros.distribution import WORKSPACE
from neuros.errors import UsageError
from neuros.hooks import MARK, hook_specs_of
from neuros.project.in_python import PythonProject, is_installed
from neuros.project.load import PROJECT_FILE
from neuros.project.loops import modules_beside
from neuros.project.model import Project
from neuros.project.parsed import apply_override
from neuros.project.paths import NOT_COPIED, Roots
from neuros.project.plugin_files import read_functions, read_plugin

_PLAIN = (bool, int, float, complex, str, bytes, tuple, frozenset, type(None))
_ADVICE = (
    "functions that run in another process, or stand in JSON, have to come from a file: write them"
    ' to one and give its path, plugin="brain.py"; project.session(backend="local") calls the'
    " functions themselves"
)


class PluginText:
    """The text of a plugin file that consists of functions of this program.

    Attributes:
        text: of the file.
        beside: files and packages of the user's own that it imports.

    Args:
        node: the name of the node.
        functions: its hooks.

    Raises:
        UsageError: with a line for each name that cannot stand in a file.
    """

    def __init__(self, node: str, functions: Sequence[Callable[..., Any]]) -> None:
        self._hooks = {id(function) for function in functions}
        self._values: dict[str, Any] = {}
        self._imports: dict[str, dict[str, None]] = {}  # by module, the names; "" for itself
        self._constants: list[str] = []
        self._definitions: list[str] = []
        self._problems: dict[str, None] = {}
        self.beside: set[Path] = set()
        self._folders = {Path.cwd(), *(plugin.path.parent for plugin in read_functions(functions))}
        for function in functions:
            self._define(function)
        if self._problems:
            lines = "\n".join(f"node '{node}': {text}" for text in self._problems)
            raise UsageError(f"{lines}\n{_ADVICE}")
        head = '"""Plugin that NeuROS has written from functions of a program."""'
        statements = []
        for module, names in sorted(self._imports.items()):
            whole = [name for name in names if name == "" or name.startswith("as ")]
            statements += [f"import {module} {name}".rstrip() for name in whole]
            if listed := sorted(names.keys() - {*whole}):
                statements.append(f"from {module} import {', '.join(listed)}")
        parts = ["\n".join(statements), "\n".join(self._constants), *self._definitions]
        self.text = "\n\n".join([head, *filter(None, parts)]) + "\n"

    def write(self, file: Path) -> None:
        """Write the file, and what it imports beside it.

        Raises:
            OSError: if that is not possible.
        """
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self.text, "utf-8")
        for path in self.beside:
            target = file.parent / path.name
            if _is_same(target, path):
                continue
            if path.is_dir():
                shutil.copytree(path, target, ignore=NOT_COPIED, dirs_exist_ok=True)
            else:
                shutil.copyfile(path, target)

    # ------------------------------------------------------------------ inside

    def _define(self, value: Any) -> None:
        """Add the source of a function or class, behind what it needs."""
        name, bare = getattr(value, "__name__", ""), inspect.unwrap(value)
        if name in self._values:
            if self._values[name] is not value:
                self._refuse(value, f"another '{name}' comes before it in the file")
            return
        self._values[name] = value
        try:
            lines, first = inspect.getsourcelines(value)
            source = textwrap.dedent("".join(lines))
            tree = ast.parse(source)
        except (OSError, TypeError, SyntaxError):
            tree = ast.Module([], [])
        kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
        if len(tree.body) != 1 or not isinstance(tree.body[0], kinds) or tree.body[0].name != name:
            self._refuse(value, "Python has kept no source of it, as of a lambda")
            return
        space = getattr(bare, "__globals__", None) or vars(sys.modules[bare.__module__])
        if around := getattr(getattr(bare, "__code__", None), "co_freevars", ()):
            self._refuse(value, f"it uses {_quoted(around)} of the function around it")
        if isinstance(value, FunctionType) and (kept := vars(value).keys() - {MARK, "__wrapped__"}):
            self._refuse(value, f"it has attributes, {_quoted(sorted(kept))}: keep user data")
        parts = vars(bare).values() if isinstance(bare, type) else [bare]
        codes = (getattr(part, "__code__", None) for part in parts)
        if any(code and code.co_flags & annotations.compiler_flag for code in codes):
            self._imports.setdefault("__future__", {})["annotations"] = None
            # Leave out annotations, which are not evaluated.
            for node in ast.walk(tree):
                if isinstance(node, ast.arg):
                    node.annotation = None
                elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    node.returns = None
                elif isinstance(node, ast.AnnAssign):
                    node.annotation = ast.Constant(None)
        used, changed = globals_of(ast.unparse(tree))
        if set_here := sorted(changed & space.keys()):
            self._refuse(value, f"it sets the global {_quoted(set_here)}: keep it as user data")
        for each in sorted(used - {name} - set(around)):
            if each in space:
                self._provide(value, each, space[each], tree)
            elif not hasattr(builtins, each):
                self._refuse(value, f"it uses '{each}', which its module does not have")
        place = f"{Path(inspect.getsourcefile(bare) or '').name}:{first}"
        self._definitions.append(f"\n# {place}\n{source.rstrip()}")

    def _provide(self, user: Any, name: str, value: Any, tree: ast.Module) -> None:
        """Let the file have a global that a function uses."""
        is_own = getattr(value, "__module__", None) in (user.__module__, "__main__")
        if name in self._values:
            if self._values[name] is not value:
                self._refuse(user, f"it uses another '{name}' than the function before")
        elif isinstance(value, ModuleType):
            self._values[name] = value
            for module in modules_in(name, value, tree):
                self._import(module, "")
            if value.__name__ != name:
                self._import(value, f"as {name}")
        elif name[:2] == "__":
            self._refuse(user, f"it uses '{name}', which is another one in a file")
        elif isinstance(value, FunctionType | type) and is_own and value.__name__ == name:
            if id(value) not in self._hooks and hook_specs_of({"": value}):
                self._refuse(user, f"it calls '{name}', a hook that the node does not have")
            else:
                self._define(value)
        elif (home := home_of(value)) is not None:
            self._values[name] = value
            module, its_name = home
            self._import(module, its_name if its_name == name else f"{its_name} as {name}")
        elif _is_plain(value):
            self._values[name] = value
            self._constants.append(f"{name} = {value!r}")
        else:
            hint = ", which changes" if isinstance(value, list | dict | set) else ""
            kind = f"{type(value).__name__}{hint}"
            self._refuse(user, f"it uses '{name}' ({kind}): make it in an initialise hook")

    def _import(self, module: ModuleType, name: str) -> None:
        """Import a module (``""`` or ``"as np"``), or a name of it."""
        self._imports.setdefault(module.__name__, {})[name] = None
        top = sys.modules[module.__name__.partition(".")[0]]
        file = getattr(top, "__file__", None) or ""
        path = Path(file).parent if file.endswith("__init__.py") else Path(file)
        if path.parent in self._folders and not is_installed(file):
            self._copy(path)

    def _copy(self, path: Path) -> None:
        """Have a file or package of the user's own beside the plugin, and what it imports."""
        if path not in self.beside:
            self.beside.add(path)
            read = None if path.is_dir() else read_plugin(path)
            for each in () if read is None else modules_beside(read):
                self._copy(each.path)

    def _refuse(self, value: Any, why: str) -> None:
        where = f"{value.__module__}.{getattr(value, '__qualname__', value)}"
        self._problems[f"{where}: {why}"] = None


def write_project(
    source: PythonProject,
    project: Project,
    overrides: Sequence[str],
    folder: Path,
    *,
    overwrite: bool,
) -> Path:
    """Write a project in Python as files; returns the project file.

    Args:
        project: the same, loaded with ``overrides``.

    Raises:
        UsageError: as ``neuros.Project.to_json``.
    """
    parsed = source.parsed(Roots(source.folder, WORKSPACE))
    for text in overrides:
        apply_override(parsed, text)
    contents = {PROJECT_FILE: parsed.root.plain}
    texts: dict[Path, PluginText] = {}
    shared: dict[tuple[Callable[..., Any], ...], str] = {}  # nodes with the same functions
    for node, element, file in zip(project.nodes, parsed.nodes, source.files, strict=True):
        contents[file] = element.plain
        if node.hooks:
            file_name = shared.setdefault(node.hooks, contents[file]["plugin"])
            contents[file]["plugin"] = file_name
            texts[folder / file_name] = PluginText(node.name, node.hooks)
        elif os.path.isabs(contents[file].get("plugin", "")):  # of a module of Python
            contents[file]["plugin"] = os.path.relpath(node.plugin, source.folder)
    if lacking := _lacking(source.folder, project, folder):
        raise UsageError(
            f"to_json: {folder} lacks files that the project names: {', '.join(lacking)}: copy them"
            f" there first, or write to {source.folder}"
        )
    copies = {folder / path.name: path for text in texts.values() for path in text.beside}
    made = [folder / name for name in contents] + [*texts]
    made += [target for target, path in copies.items() if not _is_same(target, path)]
    if not overwrite and (there := [path.name for path in made if path.exists()]):
        raise UsageError(
            f"to_json: {folder} has {', '.join(there)} already: name another folder, or replace"
            " them with overwrite=True"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).write_text(json.dumps(content, indent=2) + "\n", "utf-8")
        for plugin, written in texts.items():
            written.write(plugin)
    except OSError as error:
        raise UsageError(f"to_json: {folder} cannot be written to: {error.strerror}") from error
    return folder / PROJECT_FILE


def _lacking(here: Path, project: Project, there: Path) -> list[str]:
    """The paths in the folder of a project that it names, and another folder does not have."""
    named = {here / "workspace"} if (here / "workspace").is_dir() else set()
    for node in project.nodes:
        container = find_container(node.container, here)
        plugin = None if node.module or node.hooks else node.plugin
        paths = [Path(node.environment[name]) for name in node.environment_paths]
        paths += [path for path in (plugin, node.script, container and container.folder) if path]
        named |= {path for path in paths if path.is_relative_to(here)}
    inside = sorted(str(path.relative_to(here)) for path in named)
    return [path for path in inside if not (there / path).exists()]


def _is_same(target: Path, path: Path) -> bool:
    return target.exists() and target.samefile(path)


def globals_of(source: str) -> tuple[set[str], set[str]]:
    """The names in a source that are not its own, and those of them that it sets."""
    used: set[str] = set()
    changed: set[str] = set()
    waiting = [symtable.symtable(source, "plugin", "exec")]
    while waiting:
        table = waiting.pop()
        is_top = table.get_type() == "module"
        for symbol in table.get_symbols():
            if symbol.is_global() or (is_top and symbol.is_referenced()):
                used.add(symbol.get_name())
            if symbol.is_declared_global() and symbol.is_assigned():
                changed.add(symbol.get_name())
        waiting += table.get_children()
    return used, changed


def modules_in(name: str, module: ModuleType, tree: ast.Module) -> Iterator[ModuleType]:
    """The modules that attributes of a name lead to, as ``matplotlib.pyplot`` does."""
    if module.__name__ == name:
        yield module
    for node in ast.walk(tree):
        names: list[str] = []
        while isinstance(node, ast.Attribute):
            names.insert(0, node.attr)
            node = node.value
        if isinstance(node, ast.Name) and node.id == name:
            found: Any = module
            for each in names:
                found = getattr(found, each, None)
                if not isinstance(found, ModuleType) or found.__name__ not in sys.modules:
                    break
                if found.__name__.startswith(f"{module.__name__}."):
                    yield found


def home_of(value: Any) -> tuple[ModuleType, str] | None:
    """The module that a value can be imported from, the shortest, and its name there."""
    path, name = getattr(value, "__module__", None), getattr(value, "__name__", None)
    found = None
    while isinstance(path, str) and path not in ("", "__main__") and isinstance(name, str):
        module = sys.modules.get(path)
        if module is not None and getattr(module, name, None) is value:
            found = module, name
        path = path.rpartition(".")[0]
    return found


def _is_plain(value: Any) -> bool:
    """Whether a value is a constant that its text stands for."""
    if type(value) in (tuple, frozenset):
        return all(map(_is_plain, value))
    return type(value) in _PLAIN and (not isinstance(value, float) or value - value == 0)


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
