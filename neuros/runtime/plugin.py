"""Loading a plugin: a Python file with marked functions."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from neuros.errors import NeurosError, PluginError
from neuros.hooks import HookSpec, hook_specs_of


def load_plugin(path: Path, node_name: str) -> Sequence[HookSpec]:
    """Import a plugin under a name of its node's own, and return its hooks in order.

    Raises:
        PluginError: if it cannot be imported (with the traceback from the plugin on), or
            declares no hooks.
        HookError: if one of its hooks is declared wrongly.
    """
    name = f"neuros_plugin_{node_name}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise PluginError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except NeurosError:
        raise
    except BaseException as error:
        raise PluginError(
            f"{path}: cannot be imported: {describe(error)}\n{plugin_traceback(error, path)}"
        ) from error
    specs = hook_specs_of(vars(module))
    if not specs:
        raise PluginError(
            f"{path}: declares no hooks: mark functions with @neuros_function or @neuros_tick"
            " from neuros.hooks"
        )
    return specs


def describe(error: BaseException) -> str:
    """An exception in one line."""
    return "".join(traceback.format_exception_only(type(error), error)).strip().splitlines()[-1]


def plugin_traceback(error: BaseException, plugin: Path) -> str:
    """The traceback from the first frame inside the plugin on; all of it if there is none."""
    frames = traceback.extract_tb(error.__traceback__)
    first = next((i for i, frame in enumerate(frames) if frame.filename == str(plugin)), 0)
    lines = traceback.format_list(frames[first:])
    return "Traceback (most recent call last):\n" + "".join(
        lines + traceback.format_exception_only(type(error), error)
    )
