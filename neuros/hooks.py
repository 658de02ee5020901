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

from neuros.errors import HookError, UsageError

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

MARK = "__neuros_hooks__"
_RUNNERS = {"neuros.api.project", "neuros.node.node", "neuros.testing.harness"}
"""The modules that run hooks: a program that has imported one is more than a plugin."""


@dataclass(frozen=True)
class All:
    """An input that takes one packet of every connection: the hook receives a list."""

    name: str

    def __repr__(self) -> str:
        return f"All({self.name!r})"


@dataclass(frozen=True)
class Optional:
    """A port that may stay empty: the hook receives, or may return, ``None`` for it."""

    port: str | All

    def __repr__(self) -> str:
        return f"Optional({self.port!r})"


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
    """A hook as its decorator declares it.

    Attributes:
        period_s: of a tick by the wall clock, in seconds.
        sim_period_s: of a tick by simulated time; a node runs it as a function of its clock.
        is_batch: whether its arrays hold those of all copies of the node, along a leading axis.
    """

    kind: HookKind
    function: Callable[..., Any]
    inputs: tuple[InputSpec, ...] = ()
    outputs: tuple[OutputSpec, ...] = ()
    period_s: float | None = None
    sim_period_s: float | None = None
    is_batch: bool = False

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
        """Whether the engine runs the hook; the node itself runs reset and finalise hooks."""
        return self.kind not in (HookKind.RESET, HookKind.FINALISE)

    @property
    def sends_unasked(self) -> bool:
        """Whether the hook can send without a received packet: a tick, or no required input."""
        if self.kind is HookKind.TICK:
            return self.sim_period_s is None
        return bool(self.outputs) and all(port.is_optional for port in self.inputs)


def neuros_initialise(
    inputs: Ports = None, outputs: Ports = None, *, batch: bool = False
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs once, when every receiver of the node's outputs is there."""
    return _marker(HookKind.INITIALISE, inputs, outputs, batch=batch)


def neuros_reset(
    inputs: Ports = None, outputs: Ports = None, *, batch: bool = False
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs in the place of the initialise hooks when a session resets the node.

    A plugin that has one stays loaded, with its user data.
    """
    return _marker(HookKind.RESET, inputs, outputs, batch=batch)


def neuros_tick(
    seconds: float | None = None,
    inputs: Ports = None,
    outputs: Ports = None,
    sim_seconds: float | None = None,
    *,
    batch: bool = False,
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs every ``seconds`` of wall time from the end of initialisation on.

    With ``sim_seconds`` in its place: at every whole number of so many seconds of simulated time,
    by the packets of the node's clock, an input of type ``rosgraph_msgs/msg/Clock``.
    """
    periods = {"seconds": seconds, "sim_seconds": sim_seconds}
    return _marker(HookKind.TICK, inputs, outputs, periods, batch=batch)


def neuros_function(
    inputs: Ports = None, outputs: Ports = None, *, batch: bool = False
) -> Callable[[_Function], _Function]:
    """Mark a hook that runs whenever its required inputs have a packet and its outputs are free.

    Args:
        inputs, outputs: names of ports, also in ``Optional`` and ``All``.
        batch: the hook, as each other one with ports, is of a node with ``"copies"``: its arrays
            are those of all copies, along a leading axis, ``(64, 18)``.
    """
    return _marker(HookKind.FUNCTION, inputs, outputs, batch=batch)


def neuros_finalise() -> Callable[[_Function], _Function]:
    """Mark a hook that runs once at the end; it has neither inputs nor outputs."""
    return _marker(HookKind.FINALISE, None, None)


def hook_specs_of(namespace: Mapping[Any, Any]) -> tuple[HookSpec, ...]:
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
    marks: tuple[HookSpec, ...] = getattr(value, "__dict__", {}).get(MARK, ())
    return marks


def _marker(
    kind: HookKind,
    inputs: Ports,
    outputs: Ports,
    periods: Mapping[str, float | None] = MappingProxyType({}),
    *,
    batch: bool = False,
) -> Callable[[_Function], _Function]:
    bare = next((given for given in (inputs, *periods.values()) if callable(given)), None)
    if bare is not None:
        raise HookError(
            f"@neuros_{kind.value} needs parentheses",
            hook=getattr(bare, "__name__", repr(bare)),
            where=_where(bare),
        )

    def mark(function: _Function) -> _Function:
        try:
            if not callable(function):
                raise ValueError(f"@neuros_{kind.value} needs parentheses and a function below it")
            name, period_s = period_of(periods) if periods else ("", None)
            spec = HookSpec(
                kind,
                function,
                tuple(map(input_of, _listed(inputs))),
                tuple(map(output_of, _listed(outputs))),
                period_s=period_s if name == "seconds" else None,
                sim_period_s=period_s if name == "sim_seconds" else None,
                is_batch=batch_of(batch),
            )
            for side, ports in (("input", spec.inputs), ("output", spec.outputs)):
                names = [port.name for port in ports]
                if twice := [each for each in names if names.count(each) > 1]:
                    raise ValueError(f"{side} '{twice[0]}' is named twice")
        except (ValueError, UsageError) as error:
            hook = getattr(function, "__name__", repr(function))
            raise HookError(str(error), hook=hook, where=_where(function)) from None
        if function.__module__ == "__main__":
            _explain_at_exit(getattr(sys.modules["__main__"], "__file__", None))
        # A function may carry several marks; the uppermost decorator is applied last.
        setattr(function, MARK, (spec, *_marks(function)))
        return function

    return mark


@cache
def _explain_at_exit(file: str | None) -> None:
    """Tell at the exit of a plugin that was run as a program that it has only defined hooks."""

    def explain() -> None:
        if not _RUNNERS & sys.modules.keys():
            print(
                f"{file} is a plugin: by itself it only defines hooks, and none has run. Run the"
                f" project that names it: neuros launch {os.path.dirname(str(file)) or '.'}",
                file=sys.stderr,
            )

    if file is not None:
        atexit.register(explain)


def _listed(ports: Ports) -> list[Port]:
    if ports is None:
        return []
    if isinstance(ports, str | All | Optional):
        return [ports]
    if not isinstance(ports, Iterable):
        raise ValueError(f"{ports!r} is not a port: give a name, or a list of names")
    return list(ports)


def input_of(port: object) -> InputSpec:
    """The input that one entry of ``inputs`` declares. Raises ``ValueError``."""
    inner = port.port if isinstance(port, Optional) else port
    name = inner.name if isinstance(inner, All) else inner
    if not isinstance(name, str):
        allowed = "a name, Optional(name), All(name) or Optional(All(name))"
        raise ValueError(f"{port!r} is not an input: give {allowed}")
    return InputSpec(name, isinstance(inner, All), isinstance(port, Optional))


def output_of(port: object) -> OutputSpec:
    """The output that one entry of ``outputs`` declares. Raises ``ValueError``."""
    inner = port.port if isinstance(port, Optional) else port
    if isinstance(inner, All):
        raise ValueError(f"output '{inner.name}' is wrapped in All, which is for inputs only")
    if not isinstance(inner, str):
        raise ValueError(f"{port!r} is not an output: give a name or Optional(name)")
    return OutputSpec(inner, isinstance(port, Optional))


def period_of(periods: Mapping[str, Any]) -> tuple[str, float]:
    """The argument that sets the period of a tick, and the period in seconds.

    ``periods`` has the values of ``seconds`` and ``sim_seconds``. Raises ``ValueError``.
    """
    given = [(name, value) for name, value in periods.items() if value is not None]
    if len(given) != 1:
        raise ValueError("@neuros_tick needs seconds or sim_seconds, and not both: seconds=0.02")
    ((name, seconds),) = given
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        raise ValueError(f"{name}={seconds!r} is not a number")
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"{name}={seconds!r} is not a positive time")
    return name, float(seconds)


def batch_of(written: object) -> bool:
    """The argument ``batch`` of a decorator. Raises ``UsageError`` if it is no truth value."""
    if not isinstance(written, bool):
        raise UsageError(f"batch={written!r}: write batch=True, or leave it out")
    return written


def _where(function: object) -> str:
    code = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    return f"{code.co_filename}:{code.co_firstlineno}" if code else "?"
