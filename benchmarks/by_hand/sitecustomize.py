"""Lets WhiskEye, strict and in one process, go on without NeuROS now and then, and times both.

The Python of the nodes imports this, since its folder is on the path. A run is cut into slices of a
few cycles; a cycle is 20 ms simulated time. In random order, a slice is driven

``neuros``
    as always;
``by hand``
    by calls of the very hooks of the nodes, one after the other, with the messages that they
    return: no engine, no transport, no change of context;
``by hand, apart``
    the same, but each hook in the context of its node (environment, modules, output);
``one loop``
    by ``floor.py`` of the example, with the network and the figure of the run, and a copy of the
    state of its physics: no messages either.

So all have the same libraries, memory, caches and neighbours on the machine. For each slice
the process writes a line: the name of the mode, and nanoseconds of processor time per cycle, of the
thread. Slices in which the figure was redrawn (by the wall clock) are left out.

Environment: ``NEUROS_CYCLES`` (the file).
"""

from __future__ import annotations

import os
import random
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from neuros.hooks import HookKind, HookSpec
from neuros.node import node
from neuros.node.context import Context, ContextSwitch

CYCLES = 12
SETTLING_CYCLES = 100
MODES = ("neuros", "by hand", "by hand, apart", "one loop")


class Cycles:
    """The slices of the process, written to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._hooks: dict[str, Callable[..., Any]] = {}
        self._handles: dict[str, Any] = {}
        self._enter: dict[str, Callable[[], None]] = {}
        self._random = random.Random(1)
        self._modes: list[str] = []
        self._loop: Any = None
        self._left = SETTLING_CYCLES
        self._begun_ns = self._redraws = 0

    def add_context(self, node: str, enter: Callable[[], None]) -> None:
        """Take note of how to enter the context of a node."""
        self._enter[node] = enter

    def add(self, node: str, specs: Sequence[HookSpec]) -> list[HookSpec]:
        """Take note of the hooks of a node; the robot's own counts the cycles from now on."""
        return [self._noted(node, spec) for spec in specs]

    def _noted(self, node: str, spec: HookSpec) -> HookSpec:
        function = self._hooks[spec.name] = spec.function
        if spec.kind is HookKind.INITIALISE:

            def start(handle: Any) -> Any:
                self._handles[node] = handle
                return function(handle)

            return replace(spec, function=start)
        if spec.name == "simulate":

            def simulate(handle: Any) -> Any:
                self._count()
                return function(handle)

            return replace(spec, function=simulate)
        return spec

    def _count(self) -> None:
        if self._left == 0:
            self._end_slice("neuros")
            ways = {
                "by hand": self._by_hand,
                "by hand, apart": self._by_hand_apart,
                "one loop": self._one_cycle,
            }
            while (mode := self._next_mode()) != "neuros":
                self._begin_slice()
                one_cycle = ways[mode]
                for _ in range(CYCLES):
                    one_cycle()
                self._end_slice(mode)
                self._enter["robot"]()
            self._left = CYCLES
            self._begin_slice()
        self._left -= 1

    def _next_mode(self) -> str:
        if self._loop is None:
            self._loop = self._one_loop()
        if not self._modes:
            self._modes = random_order(self._random)
        return self._modes.pop()

    def _begin_slice(self) -> None:
        self._redraws = self._plot.redraws
        self._begun_ns = time.thread_time_ns()

    def _end_slice(self, mode: str) -> None:
        took_ns = time.thread_time_ns() - self._begun_ns
        if self._begun_ns and self._plot.redraws == self._redraws:
            with self._path.open("a") as file:
                file.write(f"{took_ns // CYCLES} {mode}\n")

    @property
    def _plot(self) -> Any:
        return self._handles["visualiser"].get_user_data().plot

    def _by_hand(self) -> None:
        hooks, visualiser = self._hooks, self._handles["visualiser"]
        imu, pose = hooks["simulate"](self._handles["robot"])
        hooks["keep_truth"](visualiser, pose)
        hooks["keep_estimate"](visualiser, hooks["integrate"](self._handles["snn"], imu))

    def _by_hand_apart(self) -> None:
        hooks, enter, visualiser = self._hooks, self._enter, self._handles["visualiser"]
        enter["robot"]()
        imu, pose = hooks["simulate"](self._handles["robot"])
        enter["visualiser"]()
        hooks["keep_truth"](visualiser, pose)
        enter["snn"]()
        estimate = hooks["integrate"](self._handles["snn"], imu)
        enter["visualiser"]()
        hooks["keep_estimate"](visualiser, estimate)

    def _one_cycle(self) -> None:
        self._loop.cycle()

    def _one_loop(self) -> Any:
        import mujoco
        from floor import OneLoop  # of the example: its folder is on the path in this hook

        simulator = self._handles["robot"].get_user_data().sim
        network = self._handles["snn"].get_user_data().network
        state = mujoco.MjData(simulator.model)
        mujoco.mj_copyData(state, simulator.model, simulator.data)
        return OneLoop(simulator.model, state, network, self._plot)


def random_order(numbers: random.Random) -> list[str]:
    """The modes, shuffled."""
    return numbers.sample(MODES, len(MODES))


def install() -> None:
    """Have the contexts and hooks of every node of this process noted."""
    cycles = Cycles(Path(os.environ["NEUROS_CYCLES"]))
    load, make_context = node.load_plugin, ContextSwitch.make_context

    def noting_hooks(plugin: Path, name: str, *rest: Any) -> Sequence[HookSpec]:
        return cycles.add(name, load(plugin, name, *rest))

    def noting_context(
        self: ContextSwitch, environment: Mapping[str, str], *rest: Any, **named: Any
    ) -> Context:
        context = make_context(self, environment, *rest, **named)
        name = Path(environment["NEUROS_RUN_DIR"]).name
        cycles.add_context(name, partial(self.enter, context))
        return context

    node.load_plugin = noting_hooks
    ContextSwitch.make_context = noting_context  # type: ignore[method-assign]


if "NEUROS_CYCLES" in os.environ and "neuros.cli.main" not in sys.modules:
    install()
