"""Random small projects: hypothesis strategies, half of them free, half of them known shapes.

The shapes are those of the examples and of what was once seen to fail: a join with limits, a vote,
a ring, a tick that re-arms itself through its own node, a simulator as main loop, an input that
outruns its hook beside one that must not wait.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from .description import Connection, Hook, Node, Port, Project, Sent, Taken, tidied

LIMITS = st.sampled_from([None, None, 0, 0, 0, 1, 2, 5])
QUEUES = st.sampled_from([1, 1, 1, 2, 3, 8])
SLEEPS_MS = st.sampled_from([0, 0, 0, 1, 2, 5, 15, 40, 120])
PERIODS_S = st.sampled_from([0.004, 0.01, 0.02, 0.05, 0.15])
SIZES = st.sampled_from([0, 0, 100, 4_000, 70_000, 1_000_000])
KINDS = st.sampled_from(["int", "int", "text", "bytes", "image"])
FREE_SLEEP_MS, LARGE_SLEEP_MS = 2.0, 5.0

Draw = Callable[[st.SearchStrategy[Any]], Any]


def drawn(count: int, number: int) -> list[Project]:
    """So many projects, always the same ones for a number and a version of hypothesis."""
    return [_drawn(number * 1_000_003 + place) for place in range(count)]


def _drawn(number: int) -> Project:
    """One: those that hypothesis tries after each other are alike, so each has its own seed."""
    found: list[Project] = []

    @seed(number)
    @settings(
        max_examples=3,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(projects())
    def collect(project: Project) -> None:
        found.append(project)

    collect()
    return found[-1]


def projects() -> st.SearchStrategy[Project]:
    """All of them."""
    shapes = st.one_of(
        overloads(), main_loops(), joins(), votes(), rings(), self_arming(), pipelines()
    )
    return st.one_of(graphs(), graphs(), shapes)


# ------------------------------------------------------------------ parts


def ports(*, is_alone: bool = False) -> st.SearchStrategy[Port]:
    """A message type with a size, ``is_alone`` if one output only has it."""
    sized = st.builds(lambda kind, size: Port(kind, size if kind != "int" else 0), KINDS, SIZES)
    return st.one_of(sized, st.just(Port("byte"))) if is_alone else sized


def wrapped(draw: Draw, port: str, *, is_fed: bool) -> Taken:
    """An input as a hook may declare it."""
    is_optional = not is_fed or draw(st.sampled_from([False, False, True]))
    return Taken(port, draw(st.sampled_from([False, False, True])), is_optional)


def sendings(draw: Draw, port: str) -> Sent:
    """An output as a hook may use it."""
    if draw(st.sampled_from([True, True, False])):
        return Sent(port)
    return Sent(
        port,
        is_optional=True,
        every=draw(st.sampled_from([1, 1, 2, 5])),
        at_most=draw(st.sampled_from([0, 0, 1, 10])),
        is_answer=draw(st.booleans()),
    )


def paced(node: Node) -> Node:
    """The node with hooks that leave something of the machine to others."""

    def pause_ms(hook: Hook) -> float:
        sizes = [node.outputs[sent.port].size for sent in hook.outputs]
        least = LARGE_SLEEP_MS if max(sizes, default=0) > 50_000 else 0.0
        if hook.kind == "function" and all(each.is_optional for each in hook.inputs):
            least = max(least, FREE_SLEEP_MS)
        return max(hook.sleep_ms, least)

    hooks = (
        hook if hook.kind == "finalise" else replace(hook, sleep_ms=pause_ms(hook))
        for hook in node.hooks
    )
    return replace(node, hooks=tuple(hooks))


def finished(draw: Draw, nodes: Sequence[Node], connections: Sequence[Connection]) -> Project:
    """A project of these, with what makes it end."""
    made = Project(tuple(map(paced, nodes)), tuple(connections))
    kind = draw(st.sampled_from(["duration", "duration", "duration", "interrupt"]))
    made = tidied(replace(made, seconds=draw(st.sampled_from([0.5, 0.7, 0.9]))))
    return replace(made, end="interrupt" if made.circulates else kind)


def typed(
    draw: Draw, connections: Sequence[Connection]
) -> tuple[dict[str, dict[str, Port]], dict[str, dict[str, Port]]]:
    """Inputs and outputs by node: ports that are joined are of one type."""
    group: dict[tuple[str, str, str], int] = {}
    for number, c in enumerate(connections):
        ends = [
            ("out", c.source_node, c.source_output),
            ("in", c.destination_node, c.destination_input),
        ]
        known = {group[end] for end in ends if end in group}
        for end, value in list(group.items()):
            if value in known:
                group[end] = number
        group.update(dict.fromkeys(ends, number))
    types = {}
    for number in sorted(set(group.values())):
        outputs = sum(end[0] == "out" for end, value in group.items() if value == number)
        types[number] = draw(ports(is_alone=outputs == 1))
    inputs: dict[str, dict[str, Port]] = {}
    outputs_: dict[str, dict[str, Port]] = {}
    for (side, node, port), number in sorted(group.items()):
        (inputs if side == "in" else outputs_).setdefault(node, {})[port] = types[number]
    return inputs, outputs_


# ------------------------------------------------------------------ any graph


@st.composite
def graphs(draw: Draw) -> Project:
    """Any connections between two to six nodes, and any hooks that fit."""
    names = [f"n{i}" for i in range(draw(st.sampled_from([2, 2, 3, 3, 4, 5, 6])))]
    end = st.tuples(
        st.sampled_from(names), st.sampled_from("op"), st.sampled_from(names), st.sampled_from("xy")
    )
    ends = draw(st.lists(end, unique=True, min_size=len(names) - 1, max_size=2 * len(names)))
    connections = [Connection(*each, draw(LIMITS), draw(QUEUES)) for each in ends]
    inputs, outputs = typed(draw, connections)
    topics: list[str] = []
    if draw(st.sampled_from([True, False, False, False])):
        topics = ["conformance_topic"]
        port = replace(draw(ports(is_alone=True)), external=topics[0])
        sender = draw(st.sampled_from(names))
        outputs.setdefault(sender, {})["e"] = port
        for listener in draw(st.lists(st.sampled_from(names), unique=True, min_size=1, max_size=2)):
            inputs.setdefault(listener, {})["e"] = port
    nodes = [
        Node(
            name,
            _hooks(draw, [*inputs.get(name, {})], [*outputs.get(name, {})]),
            inputs.get(name, {}),
            outputs.get(name, {}),
        )
        for name in names
    ]
    if draw(st.sampled_from([True, False, False, False, False, False])):
        nodes[0] = _ending(draw, nodes[0])
    return finished(draw, nodes, connections)


def _hooks(draw: Draw, inputs: list[str], outputs: list[str]) -> tuple[Hook, ...]:
    """Hooks of a node with these ports, all of which they nearly always use."""
    hooks = []
    some = st.lists(st.sampled_from(inputs), unique=True, max_size=2) if inputs else st.just([])
    others = st.lists(st.sampled_from(outputs), unique=True, max_size=2) if outputs else st.just([])
    if draw(st.sampled_from([True, False, False])):
        sent = [Sent(port) for port in draw(others)]
        taken = [wrapped(draw, port, is_fed=True) for port in draw(some)]
        if taken and draw(st.booleans()):
            taken = []
        hooks.append(Hook("i0", "initialise", tuple(taken), tuple(sent), sleep_ms=draw(SLEEPS_MS)))
    if draw(st.sampled_from([True, False, False, False])) and len(hooks):
        hooks.append(Hook("i1", "initialise", sleep_ms=draw(SLEEPS_MS)))
    left_in, left_out = set(inputs), set(outputs)
    for number in range(draw(st.integers(1, 3))):
        taken_ports, sent_ports = draw(some), draw(others)
        left_in -= set(taken_ports)
        left_out -= set(sent_ports)
        hooks.append(_hook(draw, f"h{number}", taken_ports, sent_ports))
    if draw(st.sampled_from([True, True, True, False])):
        rest_in, rest_out = sorted(left_in), sorted(left_out)
        if rest_in or rest_out:
            hooks.append(_hook(draw, "rest", rest_in, rest_out))
    if draw(st.booleans()):
        hooks.append(Hook("end", "finalise", sleep_ms=draw(st.sampled_from([0, 20]))))
    return tuple(hooks)


def _hook(draw: Draw, name: str, inputs: Sequence[str], outputs: Sequence[str]) -> Hook:
    is_tick = draw(st.sampled_from([True, False, False] if inputs else [True, True, False]))
    return Hook(
        name,
        "tick" if is_tick else "function",
        tuple(wrapped(draw, port, is_fed=True) for port in inputs),
        tuple(sendings(draw, port) for port in outputs),
        seconds=draw(PERIODS_S) if is_tick else 0.0,
        sleep_ms=draw(SLEEPS_MS),
    )


def _ending(draw: Draw, node: Node) -> Node:
    """The node with a hook that ends the project."""
    hook = draw(st.sampled_from([each for each in node.hooks if each.kind != "finalise"] or [None]))
    if hook is None:
        return node
    ending = replace(hook, shutdown_at=draw(st.sampled_from([1, 5, 20])))
    return replace(node, hooks=tuple(ending if each is hook else each for each in node.hooks))


# ------------------------------------------------------------------ shapes


def source(draw: Draw, name: str, *, outputs: Sequence[str] = ("o",)) -> tuple[Node, Port]:
    """A node that sends unasked."""
    port = draw(ports())
    if draw(st.booleans()):
        hook = Hook("send", "tick", (), tuple(map(Sent, outputs)), seconds=draw(PERIODS_S))
    else:
        sleep_ms = draw(SLEEPS_MS.filter(lambda ms: ms < 100))
        hook = Hook("send", "function", (), tuple(map(Sent, outputs)), sleep_ms=sleep_ms)
    return Node(name, (hook,), {}, dict.fromkeys(outputs, port)), port


@st.composite
def pipelines(draw: Draw) -> Project:
    """Lossless, with queues: a source, relays, a sink that ends it or not."""
    first, port = source(draw, "first")
    names = [f"relay{i}" for i in range(draw(st.integers(1, 3)))]
    nodes = [first]
    for name in names:
        relay = Hook("relay", "function", (Taken("x"),), (Sent("o"),), sleep_ms=draw(SLEEPS_MS))
        nodes.append(Node(name, (relay,), {"x": port}, {"o": port}))
    ends_at = draw(st.sampled_from([0, 0, 10]))
    last = Hook("take", inputs=(Taken("x"),), sleep_ms=draw(SLEEPS_MS), shutdown_at=ends_at)
    end = Hook("end", "finalise")
    nodes.append(Node("last", (last, end), {"x": port}, {}))
    chain = [node.name for node in nodes]
    connections = [
        Connection(a, "o", b, "x", draw(st.sampled_from([0, 0, 0, 2])), draw(QUEUES))
        for a, b in itertools.pairwise(chain)
    ]
    return finished(draw, nodes, connections)


@st.composite
def overloads(draw: Draw) -> Project:
    """A fast input into a slow hook, and beside it one that has to be served all the same."""
    image = Port("image", draw(SIZES))
    fast = Hook("send", "tick", (), (Sent("o"),), seconds=draw(st.sampled_from([0.004, 0.01])))
    slow = Hook("send", "tick", (), (Sent("o"),), seconds=draw(st.sampled_from([0.05, 0.15])))
    sleep_ms = draw(st.sampled_from([30, 60, 120]))
    hooks = [
        Hook("watch", inputs=(Taken("x"),), sleep_ms=sleep_ms),
        Hook("obey", inputs=(Taken("y"),), sleep_ms=draw(SLEEPS_MS)),
    ]
    if draw(st.booleans()):
        hooks.append(Hook("clock", "tick", seconds=draw(PERIODS_S), sleep_ms=draw(SLEEPS_MS)))
    nodes = [
        Node("camera", (fast,), {}, {"o": image}),
        Node("commander", (slow,), {}, {"o": Port("byte")}),
        Node("robot", tuple(draw(st.permutations(hooks))), {"x": image, "y": Port("byte")}, {}),
    ]
    connections = [
        Connection("camera", "o", "robot", "x", draw(st.sampled_from([None, None, 1, 3])),
                   draw(QUEUES)),
        Connection("commander", "o", "robot", "y", draw(st.sampled_from([0, 0, None, 2])),
                   draw(QUEUES)),
    ]  # fmt: skip
    return finished(draw, nodes, connections)


@st.composite
def main_loops(draw: Draw) -> Project:
    """A simulator that steps as fast as it may, with receivers and an ``Optional`` command."""
    port = draw(ports())
    step = Hook(
        "step",
        inputs=(Taken("command", draw(st.booleans()), True),),
        outputs=(Sent("o"),),
        sleep_ms=draw(st.sampled_from([2, 5, 5, 20])),
    )
    simulator = Node("simulator", (step,), {"command": Port("int")}, {"o": port})
    receivers = [f"receiver{i}" for i in range(draw(st.integers(1, 3)))]
    commanders = [f"commander{i}" for i in range(draw(st.integers(1, 2)))]
    nodes = [simulator]
    for name in receivers:
        hook = Hook("take", inputs=(Taken("x"),), sleep_ms=draw(SLEEPS_MS))
        nodes.append(Node(name, (hook,), {"x": port}, {}))
    for name in commanders:
        period_s = draw(st.sampled_from([0.05, 0.15]))
        hook = Hook("send", "tick", (), (Sent("o"),), seconds=period_s)
        nodes.append(Node(name, (hook,), {}, {"o": Port("int")}))
    connections = [
        *(Connection("simulator", "o", name, "x", draw(LIMITS), draw(QUEUES))
          for name in receivers),
        *(Connection(name, "o", "simulator", "command", draw(LIMITS), 1) for name in commanders),
    ]  # fmt: skip
    return finished(draw, nodes, connections)


@st.composite
def joins(draw: Draw) -> Project:
    """Two or three sources of different pace that one hook joins, with limits."""
    names = ["a", "b", "c"][: draw(st.integers(2, 3))]
    made = [source(draw, name) for name in names]
    inputs = {name: port for name, (_, port) in zip(names, made, strict=True)}
    first = wrapped(draw, names[0], is_fed=True)
    taken = (replace(first, is_optional=False), *(Taken(name) for name in names[1:]))
    hooks = [Hook("join", inputs=taken, sleep_ms=draw(SLEEPS_MS))]
    if draw(st.booleans()):
        hooks.append(Hook("also", inputs=(Taken(names[0]),), sleep_ms=draw(SLEEPS_MS)))
    connections = [Connection(name, "o", "join", name, draw(LIMITS), draw(QUEUES))
                   for name in names]  # fmt: skip
    nodes = [*(node for node, _ in made), Node("join", tuple(hooks), inputs, {})]
    return finished(draw, nodes, connections)


@st.composite
def votes(draw: Draw) -> Project:
    """One node asks, several answer, and it takes all answers, or those that are there."""
    names = [f"voter{i}" for i in range(draw(st.integers(2, 4)))]
    is_optional = draw(st.booleans())
    port = draw(ports())
    hooks = [
        Hook("ask", "initialise", (), (Sent("question"),)),
        Hook(
            "count",
            draw(st.sampled_from(["function", "tick"])) if is_optional else "function",
            (Taken("vote", True, is_optional),),
            (Sent("question", is_optional, is_answer=is_optional),),
            seconds=0.02,
            sleep_ms=draw(SLEEPS_MS),
        ),
    ]
    nodes = [Node("chair", tuple(hooks), {"vote": port}, {"question": Port("int")})]
    for name in names:
        vote = Hook("vote", inputs=(Taken("x"),), outputs=(Sent("o"),), sleep_ms=draw(SLEEPS_MS))
        nodes.append(Node(name, (vote,), {"x": Port("int")}, {"o": port}))
    limit = draw(st.sampled_from([0, 0, 1, None]))
    connections = [
        *(Connection("chair", "question", name, "x", 0, draw(QUEUES)) for name in names),
        *(Connection(name, "o", "chair", "vote", limit, draw(QUEUES))
          for name in draw(st.permutations(names))),
    ]  # fmt: skip
    return finished(draw, nodes, connections)


@st.composite
def rings(draw: Draw) -> Project:
    """A step and a control: some of these stall by themselves, as the guide says, others do not."""
    port = draw(ports())
    cure = draw(st.sampled_from(["none", "own hook", "required", "command", "sensors"]))
    sleep_ms = draw(SLEEPS_MS)
    command = Taken("command", draw(st.booleans()), is_optional=cure != "required")
    steps = [Hook("step", inputs=(command,), outputs=(Sent("o"),), sleep_ms=sleep_ms)]
    if cure == "required":
        steps.insert(0, Hook("first", "initialise", (), (Sent("o"),)))
    if cure == "own hook":
        steps = [Hook("step", outputs=(Sent("o"),), sleep_ms=sleep_ms),
                 Hook("obey", inputs=(Taken("command"),))]  # fmt: skip
    control = Hook("control", inputs=(Taken("x"),), outputs=(Sent("o"),), sleep_ms=draw(SLEEPS_MS))
    nodes = [
        Node("step", tuple(steps), {"command": Port("int")}, {"o": port}),
        Node("control", (control,), {"x": port}, {"o": Port("int")}),
    ]
    connections = [
        Connection("step", "o", "control", "x", None if cure == "sensors" else 0, draw(QUEUES)),
        Connection("control", "o", "step", "command", None if cure == "command" else 0, 1),
    ]
    return finished(draw, nodes, connections)


@st.composite
def self_arming(draw: Draw) -> Project:
    """A tick that needs a packet of its own node, which it sends itself."""
    tick = Hook(
        "tick",
        draw(st.sampled_from(["tick", "tick", "function"])),
        (Taken("armed", draw(st.booleans()), draw(st.sampled_from([False, False, True]))),),
        (Sent("arm"), Sent("o")),
        seconds=draw(PERIODS_S),
        sleep_ms=draw(SLEEPS_MS),
    )
    hooks = [Hook("begin", "initialise", (), (Sent("arm"),)), tick]
    if draw(st.booleans()):
        hooks.append(Hook("listen", inputs=(Taken("armed"),), sleep_ms=draw(SLEEPS_MS)))
    port, arm = draw(ports()), Port("byte")
    take = Hook("take", inputs=(Taken("x"),), sleep_ms=draw(SLEEPS_MS))
    nodes = [
        Node("clock", tuple(hooks), {"armed": arm}, {"arm": arm, "o": port}),
        Node("display", (take,), {"x": port}, {}),
    ]
    connections = [
        Connection("clock", "arm", "clock", "armed", draw(LIMITS), draw(QUEUES)),
        Connection("clock", "o", "display", "x", draw(LIMITS), draw(QUEUES)),
    ]
    return finished(draw, nodes, connections)
