"""NumPy and PyYAML, imported only when something of them is used.

Generated messages import NumPy for their arrays. A node without arrays, whose plugin does without
it, takes 250 ms of a processor instead of 300 for its start and end, and 27 MB instead of 33.
``rclpy`` imports PyYAML for files of parameters.

:class:`importlib.util.LazyLoader` would import them at once: it does so when any attribute is asked
for, and each further ``import numpy`` asks for ``__spec__``.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

_NAMES = ("numpy", "yaml")


@contextlib.contextmanager
def imports_when_used() -> Iterator[None]:
    """Modules that are imported in the block get both when they use them; all others at once."""
    stand_ins = [_WhenUsed(name) for name in _NAMES if name not in sys.modules]
    for each in stand_ins:
        sys.modules[each.__name__] = each
    try:
        yield
    finally:
        for each in stand_ins:
            _end(each)


def _end(stand_in: ModuleType) -> None:
    """Whoever imports it from now on gets the real one."""
    if sys.modules.get(stand_in.__name__) is stand_in:
        del sys.modules[stand_in.__name__]


class _WhenUsed(ModuleType):
    def __getattr__(self, name: str) -> Any:
        _end(self)
        real = importlib.import_module(self.__name__)
        self.__dict__.update(vars(real))
        return getattr(real, name)
