"""A failed callback of ROS, by its name and place."""

from __future__ import annotations

import functools
import inspect
import sys
from pathlib import Path
from types import CodeType
from typing import Any

from neuros.errors import CallbackError, NodeError
from neuros.runtime.plugin import describe

# What a plugin calls, and what calls it: a callback is neither.
_NOT_OF_PLUGINS = (str(Path(__file__).resolve().parents[1]), sys.prefix, sys.base_prefix)


def callback_error(error: BaseException, callback: Any = None) -> NodeError:
    """What has failed; where the callback is not at hand, it is looked for in the traceback."""
    wrapped: NodeError
    code = _code_of(callback) or _outermost_code(error)
    if code is None:
        wrapped = NodeError(f"failed outside its hooks: {describe(error)}")
    else:
        where = f"{code.co_filename}:{code.co_firstlineno}"
        wrapped = CallbackError(describe(error), callback=code.co_name, where=where)
    wrapped.__cause__ = error
    return wrapped


def _code_of(callback: Any) -> CodeType | None:
    while isinstance(callback, functools.partial):
        callback = callback.func
    if not inspect.isroutine(callback):
        callback = getattr(callback, "__call__", None)  # noqa: B004 (its code, not whether)
    code = getattr(inspect.unwrap(callback), "__code__", None) if callback else None
    return code if isinstance(code, CodeType) and not _is_library(code.co_filename) else None


def _outermost_code(error: BaseException) -> CodeType | None:
    """Of the first frame in the traceback that is of the project."""
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if not _is_library(code.co_filename):
            return code
        trace = trace.tb_next
    return None


def _is_library(file: str) -> bool:
    return file.startswith(("<", *_NOT_OF_PLUGINS)) or "site-packages" in file
