"""What a hook may return: nothing, one packet, or one entry per declared output."""

from __future__ import annotations

import re

import pytest
from engine_bench import Bench, function, wire

from neuros.errors import HookError, WrongValue
from neuros.hooks import Optional

IN, OUT_O, OUT_P = "a.o -> node.x", "node.o -> b.o", "node.p -> b.p"


def run(outputs, returns, types=None, check=lambda packet: packet) -> Bench:
    bench = Bench(
        function("f", "x", outputs, returns=lambda _: returns),
        connections=[wire(IN), wire(OUT_O), wire(OUT_P)],
        packet_types=types,
        check=check,
    )
    bench.packet(IN)
    return bench


def failure_of(outputs, returns, types=None) -> HookError:
    with pytest.raises(HookError) as caught:
        run(outputs, returns, types)
    assert caught.value.hook == "f"
    assert re.fullmatch(r".*engine_bench\.py:\d+", caught.value.where)
    return caught.value


@pytest.mark.parametrize(
    ("outputs", "returns", "sent"),
    [
        (None, None, []),
        ("o", "packet", [(OUT_O, "packet")]),
        ("o", ("packet",), [(OUT_O, "packet")]),
        ("o", ["packet"], [(OUT_O, "packet")]),
        (["o", "p"], ("first", "second"), [(OUT_O, "first"), (OUT_P, "second")]),
        (["p", "o"], ["first", "second"], [(OUT_P, "first"), (OUT_O, "second")]),
        (Optional("o"), None, []),
        (Optional("o"), (None,), []),
        ([Optional("o"), Optional("p")], None, []),
        ([Optional("o"), "p"], (None, "second"), [(OUT_P, "second")]),
    ],
)
def test_what_is_allowed(outputs, returns, sent):
    assert run(outputs, returns).sent == sent


@pytest.mark.parametrize(
    ("outputs", "returns", "text"),
    [
        (None, "packet", "returned str, but declares no outputs"),
        ("o", None, "returned no packet for output 'o'"),
        ("o", (None,), "returned no packet for output 'o'"),
        ([Optional("o"), "p"], None, "returned no packet for output 'p'"),
        (["o", Optional("p")], (None, "x"), "returned no packet for output 'o'"),
        ("o", ("x", "y"), "returned 2 packets, but declares 1 output (o)"),
        (["o", "p"], "x", "returned 1 packet, but declares 2 outputs (o, p)"),
        (["o", "p"], (), "returned 0 packets, but declares 2 outputs (o, p)"),
    ],
)
def test_anything_else_is_an_error_that_names_the_output(outputs, returns, text):
    assert text in str(failure_of(outputs, returns))


def test_a_packet_of_a_wrong_type_is_an_error_that_says_what_to_do():
    error = failure_of("o", "text", {"o": int})
    assert "returned str for output 'o', which carries std_msgs/msg/String" in str(error)
    assert 'node.make_packet("o")' in str(error)


def test_a_packet_of_the_right_type_passes():
    assert run("o", 7, {"o": int}).sent == [(OUT_O, 7)]


def test_what_is_sent_is_the_packet_that_its_check_returns():
    assert run("o", 7, {"o": int}, check=lambda packet: packet + 1).sent == [(OUT_O, 8)]


@pytest.mark.parametrize("wrong", ["o", "p"])
def test_nothing_is_sent_if_one_of_the_packets_holds_a_wrong_value(wrong):
    def check(packet):
        if packet == wrong:
            raise WrongValue("data", "300 (int)", "uint8: 0 to 255")
        return packet

    bench = Bench(
        function("f", "x", ["o", "p"], returns=("o", "p")),
        connections=[wire(IN), wire(OUT_O), wire(OUT_P)],
        packet_types={"o": str, "p": str},
        check=check,
    )
    with pytest.raises(HookError) as caught:
        bench.packet(IN)
    assert bench.sent == []
    assert re.fullmatch(
        rf".*engine_bench\.py:\d+: hook 'f': packet for output '{wrong}': field 'data' must be"
        r" uint8: 0 to 255, but is 300 \(int\)",
        str(caught.value),
    )


def test_nothing_is_sent_if_one_of_the_packets_is_wrong():
    bench = Bench(
        function("f", "x", ["o", "p"], returns=("fine", None)),
        connections=[wire(IN), wire(OUT_O), wire(OUT_P)],
    )
    with pytest.raises(HookError):
        bench.packet(IN)
    assert bench.sent == []


def test_a_hook_that_raises_is_counted_and_its_time_is_booked():
    def fail(_):
        raise HookError("broken")

    bench = Bench(function("f", "x", returns=fail), connections=[wire(IN)])
    bench.hook_s = 2.0
    with pytest.raises(HookError):
        bench.packet(IN)
    assert bench.engine.executing is None
    assert bench.hook("f").executions == 1
    assert bench.hook("f").busy_ns == 2_000_000_000
