"""Projects of one to four nodes that are small enough to visit all of their states."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from neuros.hooks import All, HookSpec, Optional
from tests.engine.engine_bench import function, initialise, tick, wire

from .world import Project


def _hook(make: Callable[..., HookSpec], run: Callable[..., Any], *arguments: Any) -> HookSpec:
    """A hook whose function gets the node, too."""
    spec = make(*arguments)
    run.__name__ = spec.name
    return dataclasses.replace(spec, function=run)


def source(output: str = "o", most: int = 2) -> HookSpec:
    """A main loop: it sends so many packets, and then nothing more."""
    return _hook(function, lambda node: node.packet(output, most), "source", None, Optional(output))


def relay(inputs: Any = "x", output: str = "o", name: str = "relay") -> HookSpec:
    """It sends a packet of its own for each start."""
    return _hook(function, lambda node, *_: node.packet(output), name, inputs, output)


def sink(inputs: Any = "x", name: str = "sink") -> HookSpec:
    """It takes packets."""
    return _hook(function, lambda node, *_: None, name, inputs)


def begin(output: str = "o") -> HookSpec:
    """It sends one packet at the beginning."""
    return _hook(initialise, lambda node: node.packet(output), "begin", None, output)


def clock(output: str = "o") -> HookSpec:
    """It sends a packet at each tick."""
    return _hook(tick, lambda node: node.packet(output), "clock", 1.0, None, output)


def projects() -> Sequence[Project]:
    """All of them."""
    one = wire("a.o -> b.x", 0)
    return [
        Project("one lossless connection", [one], {"a": [source(most=3)], "b": [sink()]}, goal=3),
        Project(
            "a longer queue",
            [wire("a.o -> b.x", 0, queue_size=2)],
            {"a": [source(most=4)], "b": [sink()]},
            goal=4,
        ),
        Project(
            "a chain",
            [one, wire("b.o -> c.x", 0, index=1)],
            {"a": [source()], "b": [relay()], "c": [sink()]},
            goal=2,
        ),
        Project(
            "two takers of one input",
            [one],
            {"a": [source(most=3)], "b": [sink(name="first"), sink(name="second")]},
            goal=3,
        ),
        Project(
            "two takers, of which one waits for more",
            [one, wire("c.o -> b.y", 0, index=1)],
            {"a": [source()], "b": [sink(name="first"), sink(("x", "y"))], "c": [source()]},
            goal=2,
        ),
        Project(
            "a longer queue for a slow taker",
            [wire("a.o -> b.x", 0, queue_size=2), wire("c.o -> b.y", 0, index=1)],
            {"a": [source(most=4)], "b": [sink(("x", "y"))], "c": [source()]},
            goal=2,
        ),
        Project(
            "one taker in a hook that waits for more",
            [one, wire("c.o -> b.y", 0, index=1)],
            {"a": [source()], "b": [sink(("x", "y"))], "c": [source()]},
            goal=2,
        ),
        Project(
            "a fan, of which one may miss one in a row and one any",
            [one, wire("a.o -> c.x", 1, index=1), wire("a.o -> d.x", None, index=2)],
            {"a": [source()], "b": [sink()], "c": [sink()], "d": [sink()]},
            goal=2,
            losses=1,
        ),
        Project(
            "limit 1 with a slow taker",
            [wire("a.o -> b.x", 1), wire("c.o -> b.y", 0, index=1)],
            {"a": [source(most=4)], "b": [sink(("x", "y"))], "c": [source()]},
            goal=2,
        ),
        Project(
            "many to one",
            [wire("a.o -> c.x", 0), wire("b.o -> c.x", 0, index=1)],
            {"a": [source()], "b": [source()], "c": [sink(All("x"))]},
            goal=2,
        ),
        Project(
            "many to one, whichever comes",
            [wire("a.o -> c.x", 0), wire("b.o -> c.x", 0, index=1)],
            {"a": [source()], "b": [source()], "c": [sink()]},
            goal=2,
        ),
        Project(
            "an optional command for a main loop",
            [wire("a.o -> b.x", 0), wire("b.o -> c.x", 0, index=1)],
            {
                "a": [source()],
                "b": [
                    _hook(
                        function,
                        lambda node, _: node.packet("o", 2),
                        "loop",
                        Optional("x"),
                        Optional("o"),
                    )
                ],
                "c": [sink()],
            },
            goal=2,
        ),
        Project(
            "a node that sends to itself",
            [wire("a.o -> a.x", 0), wire("a.p -> b.x", 0, index=1)],
            {"a": [source(most=2), relay("x", "p")], "b": [sink()]},
            goal=2,
        ),
        Project(
            "two hooks of which one never rests",
            [one],
            {"a": [source(most=2)], "b": [sink(), _hook(function, lambda node: None, "spin")]},
            goal=2,
        ),
        Project(
            "a question and its answer",
            [one, wire("b.o -> a.x", 0, index=1)],
            {"a": [begin(), sink()], "b": [relay(name="answer")]},
            goal=1,
        ),
        Project(
            "lockstep, ended",
            [one, wire("b.o -> a.x", 0, index=1)],
            {"a": [begin(), relay(name="step")], "b": [relay(name="answer")]},
            shuts_down=True,
            last_round={"a": [1], "b": [0]},
        ),
        Project(
            "a tick, ended",
            [one, wire("b.o -> c.x", 0, index=1)],
            {"a": [clock()], "b": [relay()], "c": [sink()]},
            ticks=2,
            shuts_down=True,
        ),
        Project(
            "a chain, ended",
            [one, wire("b.o -> c.x", 0, index=1)],
            {"a": [source()], "b": [relay()], "c": [sink()]},
            shuts_down=True,
        ),
        Project(
            "a chain in which a node dies",
            [one, wire("b.o -> c.x", 0, index=1)],
            {"a": [source()], "b": [relay()], "c": [sink()]},
            may_crash=True,
        ),
    ]
