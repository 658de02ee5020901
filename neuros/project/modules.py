"""Plugins that are modules of installed packages: ``"plugin": "mypackage.module"``."""

from __future__ import annotations

import pkgutil
import re
import sys
from importlib.machinery import ModuleSpec
from itertools import accumulate
from pathlib import Path

from neuros.project.suggest import did_you_mean

_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_FILES = (".py", ".pyc", ".so")


def is_module_name(text: str) -> bool:
    """Whether a plugin is named as Python imports it, and not by the path of its file."""
    return bool(_NAME.fullmatch(text)) and not text.endswith(_FILES)


def find_module(name: str) -> Path | None:
    """The file of a module that this Python has; nothing is imported.

    ``None`` if it has none of that name, or one without a file.
    """
    spec = _specs(name)[-1]
    return Path(spec.origin) if spec and spec.has_location and spec.origin else None


def why_not(name: str) -> tuple[str, str]:
    """Why there is no such module, and a hint."""
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


def _specs(name: str) -> list[ModuleSpec | None]:
    """Of each package that the name goes through, and of the module itself, as far as it leads.

    Finders are asked as ``import`` does, which would run the packages to get at what is in them.
    """
    found: list[ModuleSpec | None] = []
    for each in accumulate(name.split("."), "{}.{}".format):
        within = found[-1] if found else None
        path = within.submodule_search_locations if within else None
        is_lost = bool(found) and path is None
        specs = (finder.find_spec(each, path) for finder in sys.meta_path)
        found.append(None if is_lost else next(filter(None, specs), None))
    return found
