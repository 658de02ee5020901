"""NumPy, imported only when something of it is used.

Generated messages import it for their arrays. A node without arrays, whose plugin does without it,
takes 250 ms of a processor instead of 300 for its start and end, and 27 MB instead of 33.

:class:`importlib.util.LazyLoader` would import it at once: it does so when any attribute is asked
for, and each further ``import numpy`` asks for ``__spec__``.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

_NAME = "numpy"


@contextlib.contextmanager
def numpy_when_used() -> Iterator[None]:
    """Modules that are imported in the block get NumPy when they use it; all others at once."""
    if _NAME in sys.modules:
        yield
        return
    stand_in = sys.modules[_NAME] = _WhenUsed(_NAME)
    try:
        yield
    finally:
        _end(stand_in)


def _end(stand_in: ModuleType) -> None:
    """Whoever imports NumPy from now on gets the real one."""
    if sys.modules.get(_NAME) is stand_in:
        del sys.modules[_NAME]


class _WhenUsed(ModuleType):
    def __getattr__(self, name: str) -> Any:
        _end(self)
        real = importlib.import_module(_NAME)
        self.__dict__.update(vars(real))
        return getattr(real, name)
