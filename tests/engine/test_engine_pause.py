"""Pause, resume and step: what stands still, and what goes on by how much."""

from __future__ import annotations

from engine_bench import SECOND, Bench, function, initialise, tick, wire

from neuros.engine.metrics import PAUSED
from neuros.engine.snapshot import explain, snapshot
from neuros.hooks import Optional

IN, OUT = "a.o -> node.x", "node.o -> b.x"


def main_loop() -> Bench:
    """A simulation, as most are: it steps whenever its output may be sent."""
    return Bench(function("step", outputs="o", returns="reading"), connections=[wire(OUT, 0)])


def test_a_paused_node_starts_no_hook_and_forgets_no_packet():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0, queue_size=2)])
    bench.engine.pause()
    assert bench.packet(IN) == []
    assert bench.packet(IN) == []
    assert bench.acknowledged == []
    bench.engine.resume()
    bench.settle()
    assert bench.ran == ["f", "f"]


def test_it_notes_when_it_stood_still_and_not_while_hooks_of_steps_ran():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0, queue_size=2)])
    bench.hook_s = 1.0
    start_ns = bench.clock.now_ns
    bench.engine.pause()
    bench.packet(IN)
    bench.pass_time(3.0)
    bench.engine.step(1, is_driven=False)
    bench.pass_time(4.0)
    bench.engine.pause()
    bench.pass_time(1.0)
    bench.engine.resume()
    bench.packet(IN)
    still_s = [(each - start_ns) / SECOND for each in bench.engine.pauses.still_ns]
    assert still_s == [0.0, 3.0, 4.0, 9.0]


def test_a_paused_node_asks_for_no_further_pass():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.packet(IN)
    assert bench.waiting == []


def test_initialisation_goes_on_while_paused():
    bench = Bench(initialise("begin"), function("loop"), is_started=False)
    bench.engine.pause()
    bench.engine.start()
    bench.settle()
    assert bench.ran == ["begin"]


def test_one_step_is_one_start_of_the_main_loop():
    bench = main_loop()
    bench.engine.pause()
    bench.acknowledge_to_node(OUT, 1)
    assert bench.ran == ["step"]
    bench.engine.step(1, is_driven=True)
    bench.acknowledge_to_node(OUT, 2)
    assert bench.ran == ["step"] * 2


def test_steps_add_up_where_a_receiver_holds_them_up():
    bench = main_loop()
    bench.engine.pause()
    for _ in range(2):
        bench.engine.step(1, is_driven=True)
    for position in range(1, 6):
        bench.acknowledge_to_node(OUT, position) if bench.hook("step").blocked else None
        bench.settle()
    assert bench.ran == ["step"] * 3


def test_in_a_step_hooks_answer_all_that_they_receive():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.engine.step(1, is_driven=True)
    assert [bench.packet(IN) for _ in range(3)] == [["f"]] * 3


def test_what_comes_from_outside_after_a_step_has_begun_waits_for_the_next_one():
    bench = Bench(function("f", "x"), external_inputs=["x"])
    bench.engine.pause()
    for _ in range(2):
        assert bench.packet("x") == []
    bench.engine.step(1, is_driven=True)
    bench.settle()
    assert bench.ran == ["f", "f"]
    for _ in range(2):
        assert bench.packet("x") == []
    bench.engine.step(1, is_driven=True)
    bench.settle()
    assert bench.ran == ["f"] * 4


def test_of_several_steps_each_begins_with_a_start_of_a_hook_that_drives():
    bench = Bench(
        function("step", outputs="o", returns="reading"),
        function("f", "x"),
        connections=[wire(OUT, 0)],
        external_inputs=["x"],
    )
    bench.engine.pause()
    bench.engine.step(2, is_driven=True)  # its receiver is behind
    assert bench.packet("x") == []
    bench.acknowledge_to_node(OUT, 1)
    bench.settle()
    assert bench.ran == ["step", "step", "f"]
    assert bench.packet("x") == []


def test_where_nothing_drives_the_project_each_hook_starts_once_per_step():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0, queue_size=3)])
    bench.engine.pause()
    for _ in range(3):
        bench.packet(IN)
    bench.engine.step(2, is_driven=False)
    bench.settle()
    assert bench.ran == ["f", "f"]


def test_a_step_outside_a_pause_does_nothing():
    bench = main_loop()
    bench.engine.step(5, is_driven=True)
    bench.engine.pause()
    bench.acknowledge_to_node(OUT, 1)
    assert bench.ran == ["step"]


def test_a_second_pause_takes_back_what_is_left_of_steps():
    bench = Bench(
        function("step", outputs="o", returns="reading"),
        function("answer", "x"),
        connections=[wire(OUT, 0), wire(IN, 0)],
    )
    bench.engine.pause()
    bench.engine.step(3, is_driven=True)  # its receiver is behind
    bench.engine.pause()
    bench.acknowledge_to_node(OUT, 1)
    assert bench.packet(IN) == []
    assert bench.ran == ["step"]
    bench.engine.step(1, is_driven=True)
    bench.settle()
    bench.acknowledge_to_node(OUT, 2)
    assert sorted(bench.ran) == ["answer", "step", "step"]


def test_a_hook_that_has_had_its_step_holds_up_no_other():
    bench = Bench(function("drive"), function("answer", "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.engine.step(1, is_driven=True)
    bench.settle()
    bench.packet(IN)
    assert bench.ran[-2:] == ["drive", "answer"]  # `drive` comes first again, and may not start
    assert bench.packet(IN) == ["answer"]


def test_in_a_pause_no_time_passes_for_a_tick_that_awaits_a_packet_either():
    bench = Bench(tick("t", 1.0, "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.engine.step(1, is_driven=True)
    assert bench.packet(IN) == ["t"]
    bench.clock.advance(5.0)
    assert bench.packet(IN) == []


def test_a_step_starts_a_tick_hook_though_no_time_passes():
    bench = Bench(tick("t", 1.0))
    bench.engine.pause()
    bench.engine.step(2, is_driven=True)
    bench.settle()
    assert bench.ran == ["t", "t"]


def test_a_step_that_comes_before_the_node_has_initialised_starts_its_ticks_then():
    late = Bench(tick("t", 1.0), connections=[wire(OUT)], is_registered=False)
    late.engine.pause()
    late.engine.step(1, is_driven=True)
    assert late.register(OUT) == ["t"]

    bench = Bench(initialise("begin", "x"), tick("t", 1.0), connections=[wire(IN)])
    bench.engine.pause()
    bench.engine.step(1, is_driven=True)
    assert bench.packet(IN) + bench.settle() == ["begin", "t"]


def test_a_pause_is_no_time_for_ticks():
    bench = Bench(tick("t", 1.0))
    bench.pass_time(1.0)
    bench.clock.advance(0.25)
    bench.engine.pause()
    assert bench.engine.next_due_ns is None
    bench.clock.advance(100.0)
    bench.engine.resume()
    assert bench.ran == ["t"]
    assert bench.engine.next_due_ns == bench.clock.now_ns + 0.75 * SECOND
    bench.pass_time(0.75)
    figures = snapshot(bench.engine, bench.clock.now_ns)["hooks"]["t"]
    assert figures["missed_ticks"] == 0
    assert figures["ticks"]["max_ms"] == 1000.0


def test_a_tick_that_a_step_could_not_start_waits_for_its_own_time():
    bench = Bench(tick("t", 1.0, outputs="o", returns="reading"), connections=[wire(OUT, 0)])
    bench.pass_time(1.0)
    bench.engine.pause()
    bench.engine.step(1, is_driven=True)  # its receiver is behind
    bench.clock.advance(0.5)
    bench.engine.resume()
    bench.acknowledge_to_node(OUT, 1)
    assert bench.ran == ["t"]
    bench.pass_time(1.0)
    assert bench.ran == ["t", "t"]
    assert bench.hook("t").missed_ticks == 0


def test_a_tick_that_was_due_when_the_pause_began_is_due_when_it_ends():
    bench = Bench(tick("t", 1.0, outputs="o", returns="reading"), connections=[wire(OUT, 0)])
    bench.pass_time(1.0)
    bench.pass_time(1.0)
    assert bench.ran == ["t"]
    bench.engine.pause()
    bench.clock.advance(10.0)
    bench.acknowledge_to_node(OUT, 1)
    bench.engine.resume()
    bench.settle()
    assert bench.ran == ["t", "t"]
    assert bench.hook("t").missed_ticks == 0


def test_hooks_start_with_the_event_after_the_end_of_a_pause():
    """One that started at once would hold the pause of the other nodes in the thread."""
    bench = Bench(function("f", "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.packet(IN)
    bench.engine.resume()
    assert bench.ran == []
    bench.settle()
    assert bench.ran == ["f"]


def test_paused_time_has_an_account_of_its_own():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0)])
    bench.clock.advance(1.0)
    bench.engine.pause()
    bench.clock.advance(5.0)
    assert bench.engine.rest() == PAUSED
    assert explain(bench.engine, bench.clock.now_ns) == ["is paused"]
    bench.engine.resume()
    bench.clock.advance(2.0)
    spent = snapshot(bench.engine, bench.clock.now_ns)["accounting"]
    assert (spent["waiting"], spent["paused"]) == ({"x": 3.0}, 5.0)


def test_a_node_that_is_stopped_while_paused_was_paused_until_then():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.clock.advance(5.0)
    bench.engine.stop_hooks()
    spent = snapshot(bench.engine, bench.clock.now_ns)["accounting"]
    assert (spent["idle"], spent["paused"]) == (0.0, 5.0)


def test_draining_ends_a_pause():
    bench = Bench(function("f", "x"), tick("t", 1.0), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.packet(IN)
    bench.engine.drain()
    assert bench.ran == ["f"]
    bench.engine.pause()
    assert not bench.engine.is_paused


def test_stopping_while_paused_starts_nothing():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0)])
    bench.engine.pause()
    bench.packet(IN)
    bench.engine.stop_hooks()
    bench.engine.resume()
    assert bench.ran == []


def test_who_drives_a_project():
    driven = Bench(function("f", "x"), connections=[wire(IN, 0)])
    polite = Bench(function("f", Optional("x")), connections=[wire(IN, 0)])
    assert not driven.engine.is_driving
    assert polite.engine.is_driving
    assert Bench(tick("t", 1.0)).engine.is_driving
    assert main_loop().engine.is_driving
