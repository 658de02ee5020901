"""For the plugins of examples: their modules, as their nodes import them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from types import ModuleType

import pytest


@pytest.fixture
def load(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], ModuleType]]:
    """Import a module of the example as its node does, and forget all of them afterwards.

    The example is the folder ``EXAMPLE`` of the test's module. No windows are opened.
    """
    example = str(request.module.EXAMPLE)
    monkeypatch.syspath_prepend(example)
    monkeypatch.setenv("NEUROS_GUI", "0")
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(example):
            del sys.modules[name]
