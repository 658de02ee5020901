"""What an event costs does not depend on hooks and connections that it does not touch.

Counted in bytecode instructions, which no other load on the machine changes.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest
from engine_bench import Bench, function, wire


def instructions(act: Callable[[], Any]) -> int:
    """Bytecode instructions that an action takes.

    The garbage collector rests: Hypothesis, for one, has it call a function, which would count
    wherever it happens to begin.
    """
    count = 0

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before, collects = sys.gettrace(), gc.isenabled()
    gc.disable()
    sys.settrace(trace)
    try:
        act()
    finally:
        sys.settrace(before)
        if collects:
            gc.enable()
    return count


def relay_beside(idle: int) -> Bench:
    """A node that relays losslessly, with so many more hooks and connections that have nothing."""
    connections = [
        wire("before.out -> node.in", 0),
        wire("node.out -> after.in", 0, index=1),
        *(wire(f"source{i}.out -> node.idle{i}", 0, index=2 + i) for i in range(idle)),
        *(wire(f"node.said{i} -> sink{i}.in", 0, index=2 + idle + i) for i in range(idle)),
    ]
    specs = [function("relay", "in", "out", lambda packet: packet)]
    specs += [function(f"idle{i}", f"idle{i}", f"said{i}", "said") for i in range(idle)]
    return Bench(*specs, connections=connections)


def cost_of_a_packet(bench: Bench) -> int:
    """Of its arrival, the hook's execution, and the acknowledgement of what that sent."""
    arriving, leaving = (
        bench.by_name[name] for name in ("before.out -> node.in", "node.out -> after.in")
    )
    counts = []
    for position in range(1, 6):  # the first ones warm up
        counts.append(
            instructions(lambda: bench.engine.on_packet(arriving, "packet"))
            + instructions(lambda p=position: bench.engine.on_acknowledgement(leaving, p))  # type: ignore[misc]
        )
    assert len(bench.calls) == 5
    return counts[-1]


@pytest.mark.parametrize("idle", [20, 200])
def test_a_packet_costs_the_same_however_many_hooks_and_connections_rest(idle: int) -> None:
    assert cost_of_a_packet(relay_beside(idle)) == cost_of_a_packet(relay_beside(2))
