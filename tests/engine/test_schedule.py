"""The log of a node's first executions."""

from __future__ import annotations

from engine_bench import Bench, function, initialise, wire

from neuros.engine.schedule import ExecutionLog


def relay() -> Bench:
    """A node that passes on, losslessly, what it gets."""
    connections = [
        wire("before.out -> node.in", 0),
        wire("node.out -> after.in", 0, index=7),
    ]
    specs = [initialise("wake"), function("relay", "in", "out", lambda packet: packet)]
    return Bench(*specs, connections=connections)


def test_executions_have_their_hook_and_times_and_acknowledgements_theirs() -> None:
    bench = relay()
    bench.packet("before.out -> node.in", 1)
    start_ns = bench.clock.now_ns
    bench.clock.advance(0.5)
    leaving = bench.by_name["node.out -> after.in"]
    bench.engine.on_acknowledgement(leaving, 1)
    log = bench.engine.execution_log
    assert log.hooks == [("wake", "initialise"), ("relay", "function")]
    assert log.executions.tolist()[3:] == [1, start_ns, start_ns]
    assert log.credits.tolist() == [7, 1, start_ns + 500_000_000]


def test_what_comes_after_the_first_ones_is_not_noted() -> None:
    bench = relay()
    bench.engine.execution_log = log = ExecutionLog(most=2)
    leaving = bench.by_name["node.out -> after.in"]
    for position in (1, 2, 3):
        bench.packet("before.out -> node.in", position)
        bench.engine.on_acknowledgement(leaving, position)
    assert log.is_full
    assert len(log.executions) == 3 * 2
    assert [*log.credits[1::3]] == [1]


def test_a_log_of_nothing_is_full_and_one_of_one_execution_is_not() -> None:
    assert ExecutionLog(most=0).is_full
    bench = relay()
    bench.engine.execution_log = log = ExecutionLog(most=1)
    assert not log.is_full
    bench.packet("before.out -> node.in", 1)
    assert log.is_full
    assert len(log.executions) == 3
