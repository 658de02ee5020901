"""What whole projects may rely on, however long packets, acknowledgements and hooks take."""

from __future__ import annotations

from typing import Any

import pytest
from engine_bench import function, initialise, tick, wire
from engine_network import Network
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.engine.snapshot import explain
from neuros.hooks import All, HookKind, HookSpec, Optional
from neuros.project.model import Connection

delays = st.lists(st.integers(0, 50), min_size=1, max_size=40)
slow_and_fast = st.lists(st.sampled_from([0, 1, 1000]), min_size=1, max_size=40)


# ------------------------------------------------------------------ random projects


def sending(name: str, outputs: list[Any], gap: int) -> Any:
    """A hook's body: numbered packets, with a gap now and then where that is allowed."""
    count = 0

    def body(*inputs: Any) -> Any:
        nonlocal count
        count += 1
        packets = [
            None
            if isinstance(port, Optional) and gap and (count + place) % gap == 0
            else (name, port.port if isinstance(port, Optional) else port, count)
            for place, port in enumerate(outputs)
        ]
        return packets or None

    return body


@st.composite
def projects(
    draw: st.DrawFn, gaps: tuple[int, ...] = (0, 2, 3)
) -> tuple[list[Connection], dict[str, list[HookSpec]]]:
    names = [f"n{number}" for number in range(draw(st.integers(1, 3)))]
    ends = [(a, o, b, i) for a in names for o in ("o", "p") for b in names for i in ("x", "y")]
    chosen = draw(st.lists(st.sampled_from(ends), unique=True, min_size=1, max_size=8))
    connections = [
        Connection(
            *end,
            discard_limit=draw(st.sampled_from([None, 0, 0, 1, 2])),
            queue_size=draw(st.integers(1, 3)),
            index=index,
        )
        for index, end in enumerate(chosen)
    ]
    plugins = {name: draw(hooks_of(name, connections, gaps)) for name in names}
    return connections, plugins


@st.composite
def hooks_of(
    draw: st.DrawFn, node: str, connections: list[Connection], gaps: tuple[int, ...]
) -> list[HookSpec]:
    connected = sorted({c.destination_input for c in connections if c.destination_node == node})
    specs = []
    for number in range(draw(st.integers(1, 3))):
        inputs = [
            draw(st.sampled_from([name, name, All(name), Optional(name), Optional(All(name))]))
            for name in draw(st.lists(st.sampled_from(connected), unique=True) if connected
                             else st.just([]))
        ]  # fmt: skip
        outputs = [
            draw(st.sampled_from([name, Optional(name)]))
            for name in draw(st.lists(st.sampled_from(["o", "p"]), unique=True))
        ]
        kind = draw(st.sampled_from(["function"] * 5 + ["initialise", "tick"]))
        name = f"{node}_{kind}{number}"
        body = sending(name, outputs, draw(st.sampled_from(gaps)))
        if kind == "function":
            specs.append(function(name, inputs, outputs, body))
        elif kind == "initialise":
            specs.append(initialise(name, inputs, outputs, body))
        else:
            specs.append(tick(name, 20e-9, inputs, outputs, body))
    return specs


def check_connections(network: Network) -> None:
    """What holds on every connection after every event."""
    for c in network.connections:
        window, subscription = network.sender(c), network.receiver(c)
        assert window.sent >= subscription.received >= 0
        unread = {position for queue in subscription.queues for _, position, _ in queue.packets}
        assert subscription.unread == len(unread)
        assert (
            subscription.received
            == subscription.consumed + subscription.discarded + subscription.unread
        )
        assert all(len(queue.packets) <= c.queue_size for queue in subscription.queues)
        if c.is_reliable:
            assert window.outstanding <= c.window
            assert window.acknowledged <= subscription.acknowledged <= subscription.received
            assert subscription.longest_discard <= c.discard_limit
        else:
            assert not window.is_blocked


def check_phases(network: Network) -> None:
    """No hook has run before registration, and none but initialise hooks before these have."""
    for node in network.nodes.values():
        engine = node.engine
        if not engine.is_started or any(not o.is_registered for o in engine.send_windows.values()):
            assert node.runs == []
        names = [hook.name for hook in engine.all_hooks if hook.spec.kind is HookKind.INITIALISE]
        ran = [name for name, _ in node.runs]
        first = ran[: len(names)]
        assert set(first) <= set(names)
        assert not set(ran[len(names) :]) & set(names)


def taken_positions(network: Network, c: Connection) -> dict[str, list[int]]:
    """By hook: the packets of a connection, numbered from 1, that it started on."""
    node = network.nodes[c.destination_node]
    position = {packet: n for n, packet in enumerate(network.sequences[c], 1)}
    result = {}
    for hook in node.engine.all_hooks:
        places = [i for i, p in enumerate(hook.spec.inputs) if p.name == c.destination_input]
        if places:
            arguments = [inputs[places[0]] for inputs in network.runs(node.name, hook.name)]
            flat = [each for a in arguments for each in (a if isinstance(a, list) else [a])]
            result[hook.name] = [position[each] for each in flat if each in position]
    return result


@settings(max_examples=120, deadline=None)
@given(project=projects(), delays_ns=delays | slow_and_fast)
def test_on_every_connection_of_every_project(project, delays_ns):
    """Windows hold, counters add up, nothing runs too early, no hook misses too many in a row."""

    def check(network: Network) -> None:
        check_connections(network)
        check_phases(network)

    network = Network(*project, delays_ns, check)
    network.run(250)
    for c in network.connections:
        if not c.is_reliable or c.source_node == c.destination_node:
            continue
        for positions in taken_positions(network, c).values():
            gaps = [b - a - 1 for a, b in zip([0, *positions], positions, strict=False)]
            assert all(0 <= gap <= c.discard_limit for gap in gaps)


@settings(max_examples=60, deadline=None)
@given(project=projects(), delays_ns=delays)
def test_the_whole_time_of_every_node_is_booked_and_nothing_is_negative(project, delays_ns):
    network = Network(*project, delays_ns)
    network.run(150)
    for node in network.nodes.values():
        engine = node.engine
        spent = engine.spent_ns
        assert all(duration_ns >= 0 for duration_ns in spent.values())
        busy_ns = sum(hook.busy_ns for hook in engine.all_hooks)
        assert spent.total() + busy_ns == engine.since_ns - engine.created_ns


@settings(max_examples=40, deadline=None)
@given(project=projects(), delays_ns=delays)
def test_a_project_at_rest_has_nothing_startable_and_every_node_can_say_why(project, delays_ns):
    network = Network(*project, delays_ns)
    if network.run(250):
        assert not network.has_something_under_way
        assert not network.is_wakeable
        for node in network.nodes.values():
            assert not node.engine.has_ready_hook
            assert explain(node.engine, node.clock())


# ------------------------------------------------------------------ acyclic, lossless


@st.composite
def acyclic(draw: st.DrawFn) -> tuple[list[Connection], int]:
    """Lossless connections that only lead from earlier to later nodes."""
    size = draw(st.integers(2, 5))
    pairs = [(i, j) for i in range(size) for j in range(i + 1, size)]
    chosen = draw(st.lists(st.sampled_from(pairs), unique=True, min_size=1))
    connections = [
        Connection(f"n{i}", "o", f"n{j}", f"from_n{i}", 0, draw(st.integers(1, 3)), index)
        for index, (i, j) in enumerate(chosen)
    ]
    return connections, size


@settings(max_examples=50, deadline=None)
@given(graph=acyclic(), delays_ns=delays | slow_and_fast, packets=st.integers(1, 8))
def test_acyclic_lossless_projects_do_not_deadlock_and_lose_nothing(graph, delays_ns, packets):
    connections, size = graph
    plugins = {f"n{i}": [relay(f"n{i}", connections, packets)] for i in range(size)}
    network = Network(connections, plugins, delays_ns, check_connections)
    network.run(100 * packets * size)
    for name, node in network.nodes.items():
        if plugins[name][0].inputs:
            assert len(node.runs) == packets
    for c in connections:
        subscription = network.receiver(c)
        assert (subscription.received, subscription.consumed, subscription.discarded) == (
            packets,
            packets,
            0,
        )
        assert taken_positions(network, c)["work"] == [*range(1, packets + 1)]
        assert network.sender(c).outstanding == 0


@settings(max_examples=60, deadline=None)
@given(graph=acyclic(), delays_ns=delays, before=st.integers(0, 300))
def test_draining_ends_with_nothing_under_way_and_nothing_that_a_hook_could_start_on(
    graph, delays_ns, before
):
    connections, size = graph
    plugins = {f"n{i}": [relay(f"n{i}", connections, 10**9)] for i in range(size)}
    network = Network(connections, plugins, delays_ns, check_connections)
    network.run(before)
    for node in network.nodes.values():
        node.engine.drain()
    assert network.run(2000)
    for node in network.nodes.values():
        assert not node.engine.has_startable_packet
    for c in connections:
        subscription = network.receiver(c)
        assert network.sender(c).sent == subscription.received
        receiver = network.nodes[c.destination_node].engine
        is_blocked = any(window.is_blocked for window in receiver.send_windows.values())
        if len(receiver.subscriptions) == 1 and not is_blocked:
            assert subscription.consumed == subscription.received  # it waits for nothing else


def relay(name: str, connections: list[Connection], packets: int) -> HookSpec:
    """Joins all inputs of a node and sends what it got; a node without inputs sends so many."""
    inputs = [c.destination_input for c in connections if c.destination_node == name]
    count = 0

    def body(*arguments: Any) -> Any:
        nonlocal count
        count += 1
        return f"{name}#{count}" if inputs or count <= packets else None

    return function("work", inputs, "o" if inputs else Optional("o"), body)


# ------------------------------------------------------------------ reproducibility


@st.composite
def strict_projects(draw: st.DrawFn) -> tuple[list[Connection], dict[str, list[Any]]]:
    """Lossless, every input of one source and required; rings, too, some of which stall."""
    size = draw(st.integers(2, 4))
    names = [f"n{i}" for i in range(size)]
    ends = [(a, b) for a in names for b in names]
    chosen = draw(st.lists(st.sampled_from(ends), unique=True, min_size=1, max_size=7))
    connections = [
        Connection(a, f"to_{b}", b, f"from_{a}", 0, draw(st.integers(1, 3)), index)
        for index, (a, b) in enumerate(chosen)
    ]
    plan = {}
    for name in names:
        inputs = [c.destination_input for c in connections if c.destination_node == name]
        outputs = [c.source_output for c in connections if c.source_node == name]
        has_first = draw(st.booleans())
        split = draw(st.integers(0, len(inputs)))
        plan[name] = [inputs, outputs, has_first, split]
    return connections, plan


def strict_plugin(inputs, outputs, has_first, split) -> list[HookSpec]:
    """Hooks without common outputs or state: one joins some inputs, the other the rest."""

    def body(*arguments: Any) -> Any:
        nonlocal state
        state = hash((state, arguments))
        return tuple((port, state) for port in outputs) or None

    state = 0
    specs = [function("main", inputs[:split], outputs, body)]
    if inputs[split:]:
        specs.append(function("rest", inputs[split:]))
    if has_first:
        specs.append(
            initialise("first", outputs=outputs, returns=tuple("first" for _ in outputs) or None)
        )
    return specs


@settings(max_examples=60, deadline=None)
@given(project=strict_projects(), delays_a=delays, delays_b=slow_and_fast)
def test_strict_projects_give_the_same_packets_however_long_things_take(
    project, delays_a, delays_b
):
    connections, plan = project
    sequences, inputs = [], []
    for delays_ns in ([0], delays_a, delays_b):
        plugins = {name: strict_plugin(*each) for name, each in plan.items()}
        network = Network(connections, plugins, delays_ns, check_connections)
        network.run(400)
        sequences.append(network.sequences)
        inputs.append({(n, h): network.runs(n, h) for n in plan for h in ("main", "rest", "first")})
    for c in connections:
        assert_prefixes([each[c] for each in sequences])
    for hook in inputs[0]:
        assert_prefixes([each[hook] for each in inputs])


def assert_prefixes(sequences: list[list[Any]]) -> None:
    """Cut off at some moment, they agree as far as the shortest goes."""
    length = min(map(len, sequences))
    assert all(each[:length] == sequences[0][:length] for each in sequences)


@settings(max_examples=40, deadline=None)
@given(delays_ns=delays | slow_and_fast)
def test_a_state_that_a_hook_sends_to_itself_is_reproducible(delays_ns):
    """``Optional``, since it comes from the node itself; lossless, and one at a time."""
    states = []

    def step(state: int | None) -> tuple[Any, Any]:
        states.append(state)
        return (state or 0) + 1, state

    connections = [wire("n.state -> n.state", 0), wire("n.o -> sink.x", 0)]
    network = Network(
        connections,
        {"n": [function("step", Optional("state"), ["state", Optional("o")], step)],
         "sink": [function("take", "x")]},
        delays_ns,
    )  # fmt: skip
    network.run(200)
    assert len(states) > 3
    assert states == [None, *range(1, len(states))]


# ------------------------------------------------------------------ loops


COMMAND, SENSORS = "control.command -> step.command", "step.sensors -> control.sensors"


def ring(step: list[HookSpec], *, sensors: int | None = 0, command: int | None = 0) -> Network:
    control = [function("control", "sensors", "command", returns="command")]
    connections = [wire(COMMAND, command), wire(SENSORS, sensors)]
    return Network(connections, {"step": step, "control": control}, [1, 2, 3], check_connections)


def test_step_and_control_lossless_both_ways_stall_by_themselves_and_it_can_be_told():
    network = ring([function("step", Optional("command"), "sensors", returns="sensors")])
    assert network.run(1000)
    assert not network.is_wakeable
    assert not network.has_something_under_way
    why = {name: explain(node.engine, node.clock())[0] for name, node in network.nodes.items()}
    assert why["step"].startswith(f"is blocked on `{SENSORS}` (1 outstanding")
    assert why["control"].startswith(f"is blocked on `{COMMAND}` (1 outstanding")


CURES = {
    "the returning input in a hook of its own": lambda: ring(
        [function("step", outputs="sensors", returns="s"), function("take", "command")]
    ),
    "required, with one packet from an initialise hook": lambda: ring(
        [
            initialise("first", outputs="sensors", returns="s"),
            function("step", "command", "sensors", returns="s"),
        ]
    ),
    "no discard_limit on the command": lambda: ring(
        [function("step", Optional("command"), "sensors", returns="s")], command=None
    ),
    "no discard_limit on the sensors": lambda: ring(
        [function("step", Optional("command"), "sensors", returns="s")], sensors=None
    ),
}


@pytest.mark.parametrize("cure", CURES)
def test_each_of_the_cures_keeps_it_going(cure):
    network = CURES[cure]()
    assert not network.run(2000)
    assert len(network.nodes["control"].runs) > 20
    assert len(network.nodes["step"].runs) > 20


@pytest.mark.parametrize(("queue_size", "discard_limit"), [(1, 0), (3, 0), (2, 2)])
def test_lossless_pipelining_sends_ahead_as_far_as_the_window_goes(queue_size, discard_limit):
    connection = wire("a.o -> b.x", discard_limit, queue_size)
    network = Network(
        [connection, wire("b.o -> c.x", 0), wire("c.o -> b.go", 0)],
        {
            "a": [function("f", outputs="o", returns=1)],
            "b": [function("f", ["x", "go"], "o", returns=1)],
            "c": [function("f", "x", "o", returns=1)],  # waits for b, and b for it
        },
    )
    assert network.run(100)
    assert network.sender(connection).sent == queue_size + discard_limit
