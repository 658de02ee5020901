"""What is measured: one module per subject, each with ``subject(is_quick) -> Subject``."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence

from benchmarks.measure import Subject
from neuros.errors import EnvironmentFault, UsageError


def names() -> list[str]:
    """Of all subjects, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def load(chosen: Sequence[str], is_quick: bool) -> dict[str, Subject]:
    """The subjects of these names, all where there is none; nothing is measured yet.

    Raises:
        UsageError: if one does not exist.
        EnvironmentFault: if a package is missing.
    """
    known = names()
    if unknown := [name for name in chosen if name not in known]:
        raise UsageError(f"no such subject: {', '.join(unknown)} (there are {', '.join(known)})")
    try:
        modules = {name: importlib.import_module(f"{__name__}.{name}") for name in chosen or known}
    except ModuleNotFoundError as error:
        raise EnvironmentFault(f"{error}: ./install.py --extras benchmark") from error
    return {name: module.subject(is_quick) for name, module in modules.items()}
