"""Paths in project files, kept inside project and workspace, and the modules that they name.

A plugin can be a module of an installed package: ``"plugin": "mypackage.module"``.
"""

from __future__ import annotations

import os
import pkgutil
import re
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder
from itertools import accumulate
from pathlib import Path

from neuros.project.message_types import NO_PACKAGES, MessagePackages
from neuros.project.suggest import did_you_mean

_INSTALLED = re.compile(r"@/*install/(?P<package>\w+)/*(?P<path>.*)", re.DOTALL)

NOT_COPIED = shutil.ignore_patterns("__pycache__", ".*", "runs")
"""The files that go into no image; an ``ignore`` of ``shutil.copytree``."""


class PathError(Exception):
    """A path that points to nothing, or to something that a project may not touch."""

    def __init__(self, text: str, hint: str = "") -> None:
        self.text, self.hint = text, hint
        super().__init__(text)


@dataclass(frozen=True)
class Roots:
    """The folders that paths of a project may point into, all resolved.

    ``path`` and ``#path`` are relative to the folder of the file that names them, or else to the
    project's folder; ``@path`` to the project's own workspace, or else to NeuROS's.
    ``@install/PACKAGE/path`` is in the folder of a built message package. Slashes behind ``#`` and
    ``@`` are ignored.
    """

    project: Path
    workspace: Path
    packages: MessagePackages = NO_PACKAGES

    def find(self, text: str, here: Path, *, folder_allowed: bool = False) -> Path:
        """The resolved path; ``here`` is the folder of the file that names it.

        Raises :class:`PathError`.
        """
        if "\0" in text:
            raise PathError("a path cannot contain a NUL character")
        if built := self._built(text):
            return built
        outside: Path | None = None
        for candidate in self._candidates(text, here):
            path = _resolved(candidate)
            if path is None:
                continue
            if not self.is_inside(path):
                outside = outside or path
            elif path.is_dir() and not folder_allowed:
                raise PathError(f"'{text}' is a folder, not a file")
            elif not folder_allowed and not path.is_file():
                raise PathError(f"'{text}' is not an ordinary file: a pipe, socket or device")
            else:
                return path
        if outside is not None:
            raise PathError(
                f"'{text}' leaves the project's folder",
                "paths may point into the folder of the project file, and with '@' into the "
                "workspace",
            )
        hints = (
            did_you_mean(candidate.name, os.listdir(folder))
            for candidate in self._candidates(text, here)
            if (folder := _resolved(candidate.parent)) and folder.is_dir()
            if self.is_inside(folder)
        )
        raise PathError(f"there is no file '{text}'", next(filter(None, hints), ""))

    def finds(self, value: object, here: Path) -> bool:
        """Whether the value of an environment variable is no path, or the path exists."""
        if not isinstance(value, str) or value[:1] not in ("#", "@") or value[:2] in ("##", "@@"):
            return True
        try:
            self.find(value, here, folder_allowed=True)
        except PathError:
            return False
        return True

    def _built(self, text: str) -> Path | None:
        """A path in the folder of a message package, which need not be built yet."""
        match = _INSTALLED.fullmatch(text)
        folder = self.packages.installed(match["package"]) if match else None
        if match is None or folder is None:
            return None
        path = Path(os.path.normpath(folder / match["path"]))
        if folder.exists() and not path.exists():
            raise PathError(f"'{text}' is not in what was built: there is no {path}")
        return path if path.is_relative_to(folder) else None

    def is_inside(self, path: Path) -> bool:
        """Whether a resolved path lies in one of the folders."""
        return path.is_relative_to(self.project) or path.is_relative_to(self.workspace)

    def _candidates(self, text: str, here: Path) -> list[Path]:
        if text.startswith("@"):
            rest = text[1:].lstrip("/")
            return [self.project / "workspace" / rest, self.workspace / rest]
        if text.startswith("#"):
            rest = text[1:].lstrip("/")
            absolute = [Path(text[1:])] if text.startswith("#/") else []
            return [here / rest, self.project / rest, *absolute]
        return [here / text, self.project / text]


def _resolved(path: Path) -> Path | None:
    """The path without symbolic links, ``None`` if it does not exist."""
    try:
        return path.resolve(strict=True)
    except (OSError, RuntimeError, ValueError):
        # RuntimeError: a loop of links, up to Python 3.12. ValueError: a NUL in the path.
        return None


_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_FILES = (".py", ".pyc", ".so")


def is_module_name(text: str) -> bool:
    """Whether the name of a plugin is that of a module, in place of a path."""
    return bool(_NAME.fullmatch(text)) and not text.endswith(_FILES)


def find_module(name: str) -> Path | None:
    """The file of an installed module, which is not imported; ``None`` if there is none."""
    spec = _specs(name)[-1]
    return Path(spec.origin) if spec and spec.has_location and spec.origin else None


def why_no_module(name: str) -> tuple[str, str]:
    """Why a module is not installed, and a hint."""
    *packages, _ = _specs(name)
    there = [spec for spec in packages if spec]
    if not there:
        return (
            f"there is neither a file '{name}' nor an installed module of that name",
            "install its package with pip, or write the path of a file, such as plugin.py",
        )
    package, locations = there[-1].name, there[-1].submodule_search_locations or []
    names = [f"{package}.{each.name}" for each in pkgutil.iter_modules(locations)]
    text = f"the installed package '{package}' has no module '{name}'"
    return text, did_you_mean(name, names)


def is_missing(name: str, folders: Sequence[str]) -> bool:
    """Whether a module is neither installed nor in these folders. Nothing is imported.

    A package that may define modules when it is imported has every module.
    """
    top = name.partition(".")[0]
    if top in sys.stdlib_module_names or name in sys.modules:
        return False
    found = [PathFinder.find_spec(top, folders)]
    for each in [*accumulate(name.split("."), "{}.{}".format)][1:] if found[0] else ():
        path = found[-1].submodule_search_locations if found[-1] else None
        found.append(None if path is None else PathFinder.find_spec(each, path))
    found = found if found[0] else _specs(name)
    there = [spec for spec in found if spec]
    return len(there) < len(found) and not any(map(_may_define_modules, there))


def modules_here() -> list[str]:
    """The names of all modules and packages that this Python can import."""
    return [each.name for each in pkgutil.iter_modules()]


def _may_define_modules(spec: ModuleSpec) -> bool:
    """Whether the import of a module may define further modules, without files."""
    if not spec.origin or not spec.origin.endswith(".py"):
        return spec.origin is not None  # compiled code may do so
    text = Path(spec.origin).read_text("utf-8", "replace")
    return "sys.modules" in text or "__path__" in text


def _specs(name: str) -> list[ModuleSpec | None]:
    """The specs of the packages of a dotted name and of the module itself; ``None`` if missing.

    ``importlib.util.find_spec`` would import the packages.
    """
    found: list[ModuleSpec | None] = []
    for each in accumulate(name.split("."), "{}.{}".format):
        within = found[-1] if found else None
        path = within.submodule_search_locations if within else None
        is_lost = bool(found) and path is None
        specs = (finder.find_spec(each, path) for finder in sys.meta_path)
        found.append(None)
        with suppress(ModuleNotFoundError):  # of an extension of NeuROS that is not installed
            found[-1] = None if is_lost else next(filter(None, specs), None)
    return found
