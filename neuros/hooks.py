"""Decorators that mark the hooks of a plugin, and wrappers of their ports.

A decorator marks and does not wrap: it attaches a :class:`HookSpec` to the function and returns
the function itself, which therefore stays callable in a unit test. The node collects the marks of
its own plugin; nothing is registered globally.

Example::

    from neuros.hooks import neuros_function, Optional

    @neuros_function(inputs="ball_in", outputs=Optional("ball_out"))
    def hit(node, ball):
        return ball
"""

from __future__ import annotations

import atexit
import inspect
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from types import MappingProxyType
from typing import Any, TypeAlias, TypeVar

from neuros.errors import HookError

__all__ = [
    "All",
    "HookKind",
    "HookSpec",
    "InputSpec",
    "Optional",
    "OutputSpec",
    "hook_specs_of",
    "neuros_finalise",
    "neuros_function",
    "neuros_initialise",
    "neuros_reset",
    "neuros_tick",
]

_MARK = "__neuros_hooks__"
_RUNNERS = {"neuros.api.project", "neuros.node.node", "neuros.testing.harness"}
"""What runs hooks: a program that has loaded one of these is no plugin alone."""


@dataclass(frozen=True)
class All:
    """An input that takes one packet of every connection: the hook receives a list."""

    name: str


@dataclass(frozen=True)
class Optional:
    """A port that may stay empty: the hook receives, or may return, ``None`` for it."""

    port: str | All


Port: TypeAlias = "str | All | Optional"
Ports: TypeAlias = "Port | Iterable[Port] | None"
_Function = TypeVar("_Function", bound=Callable[..., Any])


class HookKind(Enum):
    """When a hook runs: at the start, at every tick, on its inputs, at a reset, or at the end."""

    INITIALISE = "initialise"
    TICK = "tick"
    FUNCTION = "function"
    RESET = "reset"
    FINALISE = "finalise"


@dataclass(frozen=True)
class InputSpec:
    """One declared input of a hook."""

    name: str
    is_all: bool = False
    is_optional: bool = False


@dataclass(frozen=True)
class OutputSpec:
    """One declared output of a hook."""

    name: str
    is_optional: bool = False


@dataclass(frozen=True)
class HookSpec:
    """What a decorator says about one function.

    ``period_s`` is set for ticks by the wall clock only, ``sim_period_s`` for those by simulated
    time; a node runs the latter as functions of its clock.
    """

    kind: HookKind
    function: Callable[..., Any]
    inputs: tuple[InputSpec, ...] = ()
    outputs: tuple[OutputSpec, ...] = ()
    period_s: float | None = None
    sim_period_s: float | None = None

    @property
    def name(self) -> str:
        """The function's name."""
        return getattr(self.function, "__name__", repr(self.function))

    @property
    def where(self) -> str:
        """``file:line`` of the function."""
        return _where(self.function)

    @property
    def is_scheduled(self) -> bool:
        """Whether the engine of a node runs it."""
        return self.kind not in (HookKind.RESET, HookKind.FINALISE)

    @property
    def sends_unasked(self) -> bool:
        """Whether it can send without having received: a tick, or no required input."""
        if self.kind is HookKind.TICK:
            return self.sim_period_s is None
        return bool(self.outputs) and all(port.is_optional for port in self.inputs)


def neuros_initialise(
    inputs: Ports = None, outputs: Ports = None
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs once, when every receiver of the node's outputs is there."""
    return _marker(HookKind.INITIALISE, inputs, outputs)


def neuros_reset(inputs: Ports = None, outputs: Ports = None) -> Callable[[_Function], _Function]:
    """Mark a hook that runs in the place of the initialise hooks when a session resets the node.

    A plugin that has one stays loaded, with its user data.
    """
    return _marker(HookKind.RESET, inputs, outputs)


def neuros_tick(
    seconds: float | None = None,
    inputs: Ports = None,
    outputs: Ports = None,
    sim_seconds: float | None = None,
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs every ``seconds`` of wall time from the end of initialisation on.

    With ``sim_seconds`` in its place: at every whole number of so many seconds of simulated time,
    by the packets of the node's clock, an input of type ``rosgraph_msgs/msg/Clock``.
    """
    return _marker(HookKind.TICK, inputs, outputs, {"seconds": seconds, "sim_seconds": sim_seconds})


def neuros_function(
    inputs: Ports = None, outputs: Ports = None
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs whenever its required inputs have a packet and its outputs are free."""
    return _marker(HookKind.FUNCTION, inputs, outputs)


def neuros_finalise() -> Callable[[_Function], _Function]:
    """Mark a hook that runs once at the end; it has neither inputs nor outputs."""
    return _marker(HookKind.FINALISE, None, None)


def hook_specs_of(namespace: dict[str, Any]) -> tuple[HookSpec, ...]:
    """The marks of all functions in a module's namespace, in the order of their declaration."""
    functions = {id(value): value for value in namespace.values() if _marks(value)}
    return tuple(
        spec if spec.function is value else replace(spec, function=value)
        for value in functions.values()
        for spec in _marks(value)
    )


def _marks(value: object) -> tuple[HookSpec, ...]:
    # Not getattr: lazy modules and mocks, which plugins have in their namespace too, answer to any
    # name. A decorator above ours that uses functools.wraps copies the marks to its own function.
    marks: tuple[HookSpec, ...] = getattr(value, "__dict__", {}).get(_MARK, ())
    return marks


def _marker(
    kind: HookKind,
    inputs: Ports,
    outputs: Ports,
    periods: Mapping[str, float | None] = MappingProxyType({}),
) -> Callable[[_Function], _Function]:
    bare = next((given for given in (inputs, *periods.values()) if callable(given)), None)
    if bare is not None:
        raise HookError(
            f"@neuros_{kind.value} needs parentheses",
            hook=getattr(bare, "__name__", repr(bare)),
            where=_where(bare),
        )

    def mark(function: _Function) -> _Function:
        def fail(text: str) -> HookError:
            name = getattr(function, "__name__", repr(function))
            return HookError(text, hook=name, where=_where(function))

        if not callable(function):
            raise fail(f"@neuros_{kind.value} needs parentheses and a function below it")
        given = {name: period for name, period in periods.items() if period is not None}
        if periods and len(given) != 1:
            raise fail("@neuros_tick needs seconds or sim_seconds, and not both")
        period = {name: _period(name, value, fail) for name, value in given.items()}
        spec = HookSpec(
            kind=kind,
            function=function,
            inputs=tuple(_input(port, fail) for port in _listed(inputs, fail)),
            outputs=tuple(_output(port, fail) for port in _listed(outputs, fail)),
            period_s=period.get("seconds"),
            sim_period_s=period.get("sim_seconds"),
        )
        for side, names in (
            ("input", [port.name for port in spec.inputs]),
            ("output", [port.name for port in spec.outputs]),
        ):
            for name in sorted({name for name in names if names.count(name) > 1}):
                raise fail(f"{side} '{name}' is named twice")
        if function.__module__ == "__main__":
            _note_program(getattr(sys.modules["__main__"], "__file__", None))
        # A function may carry several marks; the uppermost decorator is applied last.
        setattr(function, _MARK, (spec, *_marks(function)))
        return function

    return mark


@cache
def _note_program(file: str | None) -> None:
    """A plugin is run as a program: at its end it says that this only defines functions."""
    if file is not None:
        atexit.register(_say_how_to_run, file)


def _say_how_to_run(file: str) -> None:
    if not _RUNNERS & sys.modules.keys():
        print(
            f"{file} is a plugin: by itself it only defines hooks, and none has run. Run the"
            f" project that names it: neuros launch {os.path.dirname(file) or '.'}",
            file=sys.stderr,
        )


def _listed(ports: Ports, fail: Callable[[str], HookError]) -> list[Port]:
    if ports is None:
        return []
    if isinstance(ports, str | All | Optional):
        return [ports]
    if not isinstance(ports, Iterable):
        raise fail(f"{ports!r} is not a port: give a name, or a list of names")
    return list(ports)


def _input(port: object, fail: Callable[[str], HookError]) -> InputSpec:
    inner = port.port if isinstance(port, Optional) else port
    name = inner.name if isinstance(inner, All) else inner
    if not isinstance(name, str):
        raise fail(
            f"{port!r} is not an input: give a name, Optional(name), All(name) or"
            " Optional(All(name))"
        )
    return InputSpec(name, isinstance(inner, All), isinstance(port, Optional))


def _output(port: object, fail: Callable[[str], HookError]) -> OutputSpec:
    inner = port.port if isinstance(port, Optional) else port
    if isinstance(inner, All):
        raise fail(f"output '{inner.name}' is wrapped in All, which is for inputs only")
    if not isinstance(inner, str):
        raise fail(f"{port!r} is not an output: give a name or Optional(name)")
    return OutputSpec(inner, isinstance(port, Optional))


def _period(name: str, seconds: float, fail: Callable[[str], HookError]) -> float:
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        raise fail(f"{name}={seconds!r} is not a number")
    if not (math.isfinite(seconds) and seconds > 0):
        raise fail(f"{name}={seconds!r} is not a positive time")
    return float(seconds)


def _where(function: object) -> str:
    code = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    return f"{code.co_filename}:{code.co_firstlineno}" if code else "?"
