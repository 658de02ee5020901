"""Virtual time in a project: its clock, durations, delays and losses, and a file of them."""

from __future__ import annotations

import json
from pathlib import Path
from statistics import NormalDist
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.errors import ProjectError
from neuros.project.load import load_project
from neuros.project.model import Connection, Folders, Project
from neuros.project.split import (
    node_file_from_json,
    node_file_to_json,
    project_to_json,
    split,
)
from neuros.project.timing import Distribution, Draws, seed_of, standard_normal
from neuros.project.validate import mistake

PLUGIN = """
from neuros.hooks import neuros_function, neuros_initialise, neuros_tick

@neuros_initialise()
def begin(node): ...

@neuros_tick(seconds=0.1, outputs="x")
def tick(node): return node.make_packet("x")

@neuros_function(inputs="x")
def integrate(node, x): ...
"""
X = {"name": "x", "type": "std_msgs/msg/Float64"}
A_TO_B = {
    "source_node": "a", "source_output": "x", "destination_node": "b", "destination_input": "x"
}  # fmt: skip


def node(name: str, **keys: Any) -> dict[str, Any]:
    own = {"name": name, "container": "neuros_python", "plugin": "p.py"}
    return {**own, "inputs": [X], "outputs": [X], **keys}


def write(
    folder: Path,
    *nodes: dict[str, Any],
    first: dict[str, Any] = A_TO_B,
    plugin: str = PLUGIN,
    **keys: Any,
) -> Path:
    """A project of two nodes; ``first`` is the connection that it has besides ``b.x -> a.x``."""
    connections = [first, {**A_TO_B, "source_node": "b", "destination_node": "a"}]
    project = {"nodes": [*nodes], "connections": connections, **keys}
    (folder / "p.py").write_text(plugin)
    (folder / "project.json").write_text(json.dumps(project, indent=2))
    return folder / "project.json"


def load(file: Path, **more: Any) -> Project:
    more = {"reads_plugins": True, **more}
    return load_project(file, workspace=file.parent, **more).project


def problems(file: Path, **more: Any) -> list[str]:
    with pytest.raises(ProjectError) as error:
        load(file, **more)
    return [str(problem).replace(f"{file.parent}/", "") for problem in error.value.problems]


# ---------------------------------------------------------------------- what a project says


def test_a_project_runs_in_real_time_unless_it_says_otherwise(tmp_path: Path) -> None:
    file = write(tmp_path, node("a"), node("b"))
    assert not load(file).is_virtual
    assert load(file, time="virtual").is_virtual


def test_durations_delays_and_losses_reach_the_nodes(tmp_path: Path) -> None:
    lossy = {**A_TO_B, "delay": {"lognormal": [0.04, 0.5]}, "loss": 0.25}
    a = node("a", environment={"SEED": "7"})
    b = node("b", durations={"integrate": {"normal": [0.025, 0.005]}, "tick": 1})
    file = write(tmp_path, a, b, time="virtual", first=lossy)
    project = load(file)
    files = split(project, lambda _: Folders(tmp_path, tmp_path, tmp_path))
    content = json.loads(json.dumps(node_file_to_json(files[1])))
    assert mistake(content, "node", "#/$defs/node_file") == ""
    again = node_file_from_json(content)
    assert again.time == "virtual"
    assert again.seed == seed_of(project.nodes) == '{"a": {"SEED": "7"}}'
    assert again.node.durations == {
        "integrate": Distribution("normal", (0.025, 0.005)),
        "tick": Distribution("constant", (1.0,)),
    }
    connection, _ = again.connections
    assert connection.delay == Distribution("lognormal", (0.04, 0.5))
    assert connection.loss == 0.25
    (tmp_path / "expanded.json").write_text(json.dumps(project_to_json(project)))
    assert load(tmp_path / "expanded.json").connections == project.connections
    assert load(tmp_path / "expanded.json").is_virtual


def test_a_packet_is_under_way_for_100_microseconds_by_default() -> None:
    assert Connection.of(A_TO_B).delay.at_ns(0.5) == 100_000


def test_an_option_sets_a_duration(tmp_path: Path) -> None:
    file = write(tmp_path, node("a"), node("b"))
    project = load(file, overrides=["nodes.b.durations.integrate=0.5"])
    assert project.node("b").durations["integrate"].at_ns(0.5) == 500_000_000


# ---------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("duration", "complaint"),
    [
        (-0.1, "must be at least 0, but is -0.1"),
        ("25 ms", "must be a number or an object, but is a text"),
        (True, "must be a number or an object, but is true or false"),
        ({}, "needs exactly one of 'normal', 'lognormal', 'uniform' or 'samples'"),
        ({"gamma": [1, 2]}, "unknown key 'gamma'"),
        ({"norml": [1, 2]}, "unknown key 'norml' (did you mean 'normal'?)"),
        ({"normal": [1, 2], "uniform": [1, 2]}, "needs exactly one of"),
        ({"normal": [0.025]}, "has less than 2 items"),
        ({"normal": [0.025, -1]}, "must be at least 0, but is -1"),
        ({"uniform": [0.3, 0.1]}, "the least value is above the largest (write [0.1, 0.3])"),
        ({"samples": []}, "must not be empty"),
        (1e9, "must be at most 86400"),
    ],
)
def test_wrong_durations_and_delays_are_named_together(
    tmp_path: Path, duration: Any, complaint: str
) -> None:
    b = node("b", durations={"integrate": duration})
    file = write(tmp_path, node("a"), b, first={**A_TO_B, "delay": duration})
    found = problems(file)
    assert [p for p in found if complaint in p and "/nodes/1/durations/integrate" in p]
    assert [p for p in found if complaint in p and "/connections/0/delay" in p]


def test_a_hook_that_is_not_there_or_takes_no_time_has_no_duration(tmp_path: Path) -> None:
    durations = {"integrat": 0.1, "begin": 0.1}
    found = problems(write(tmp_path, node("a"), node("b", durations=durations)))
    assert len(found) == 2
    assert "node 'b' has no hook 'integrat' (did you mean 'integrate'?)" in found[0]
    assert "hook 'begin' is a neuros_initialise: only tick and function hooks take" in found[1]


@pytest.mark.parametrize("delay", [0, 9e-7, {"uniform": [0, 1]}, {"samples": [1, 0.0000001]}])
def test_a_delay_below_a_microsecond_is_refused(tmp_path: Path, delay: Any) -> None:
    file = write(tmp_path, node("a"), node("b"), first={**A_TO_B, "delay": delay})
    assert "a delay is at least 1 microsecond" in problems(file)[0]


def test_a_loss_where_nothing_may_be_lost_is_refused(tmp_path: Path) -> None:
    limited = {**A_TO_B, "loss": 0.1, "discard_limit": 3}
    (found,) = problems(write(tmp_path, node("a"), node("b"), first=limited))
    assert "a connection with a discard limit loses no packet on its way" in found


def test_a_connection_of_a_node_to_itself_has_neither_delay_nor_loss(tmp_path: Path) -> None:
    own = {**A_TO_B, "destination_node": "a", "delay": 0.1, "loss": 0.1}
    found = problems(write(tmp_path, node("a"), node("b", plugin="q.py"), first=own))
    found = [p for p in found if "p.py" not in p and "q.py" not in p]
    assert len(found) == 2
    assert "packets of a node to itself are not sent, so they have no delay (leave" in found[0]
    assert "packets of a node to itself are not sent, so they have no loss (leave" in found[1]


LOOP = """
from neuros.hooks import Optional, neuros_function

@neuros_function(inputs=Optional("x"), outputs="x")
def step(node, x): return node.make_packet("x")
"""


@pytest.mark.parametrize("durations", [{}, {"step": 0}, {"step": {"samples": [0, 0]}}])
def test_a_hook_that_starts_unasked_takes_time(tmp_path: Path, durations: Any) -> None:
    file = write(tmp_path, node("a", durations=durations), node("b"), plugin=LOOP)
    load(file)
    found = problems(file, time="virtual")
    assert found[0].startswith("p.py:4:")
    assert "hook 'step' of node 'a' starts unasked, and takes no virtual time" in found[0]
    assert '"durations": {"step": 0.01}' in found[0]


def test_an_input_from_outside_is_refused(tmp_path: Path) -> None:
    b = node("b", inputs=[{**X, "external_topic": "/x"}])
    first = {**A_TO_B, "source_node": "a", "source_output": "x", "destination_node": "a"}
    file = write(tmp_path, node("a"), b, first=first)
    load(file)
    (found,) = problems(file, time="virtual")
    assert "/nodes/1/inputs/0/external_topic: packets of an external topic arrive in real" in found
    assert "connect the input to a node, or run in real time" in found


def test_an_unknown_clock_is_refused(tmp_path: Path) -> None:
    (found,) = problems(write(tmp_path, node("a"), node("b"), time="virtul"))
    assert "must be 'real' or 'virtual', but is 'virtul' (did you mean 'virtual'?)" in found


# ---------------------------------------------------------------------- --timing FILE


def timing(folder: Path, **content: Any) -> Path:
    (folder / "timing.json").write_text(json.dumps(content, indent=2))
    return folder / "timing.json"


def test_a_file_replaces_durations_and_delays(tmp_path: Path) -> None:
    b = node("b", durations={"integrate": 5, "tick": 6})
    file = write(tmp_path, node("a"), b)
    measured = timing(
        tmp_path,
        hooks={"b.integrate": {"samples": [0.25]}},
        connections={"a.x -> b.x": 0.04},
        provenance={"run": "runs/robot/1"},
    )
    project = load(file, time="virtual", timing=measured)
    durations = project.node("b").durations
    assert {hook: each.at_ns(0.5) // 1_000_000 for hook, each in durations.items()} == {
        "integrate": 250,
        "tick": 6000,
    }
    assert [c.delay.at_ns(0.5) for c in project.connections] == [40_000_000, 100_000]


def test_mistakes_in_the_file_are_named_with_line_and_path(tmp_path: Path) -> None:
    file = write(tmp_path, node("a"), node("b"))
    measured = timing(
        tmp_path,
        hooks={"b.integrate": 0.1, "c.x": 1, "b": 1, "b.spin": 2},
        connections={"a.x -> b.y": 0.04},
    )
    found = problems(file, time="virtual", timing=measured)
    assert [p.partition(" ")[0] for p in found] == [f"timing.json:{n}:5:" for n in (4, 5, 6, 9)]
    assert "/hooks/c.x: there is no node for 'c.x'" in found[0]
    assert "/hooks/b: there is no node for 'b' (write 'node.hook')" in found[1]
    assert "node 'b' has no hook 'spin'" in found[2]
    assert "there is no connection 'a.x -> b.y' (did you mean 'a.x -> b.x'?)" in found[3]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('{"hooks": {"b.integrate": -1}}', "1:27: /hooks/b.integrate: must be at least 0"),
        ('{"hoks": {}}', "1:2: /hoks: unknown key 'hoks' (did you mean 'hooks'?)"),
        ("[]", "1:1: /: must be an object, but is a list"),
        ("{", "syntax error"),
    ],
)
def test_a_file_of_another_form_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    file = write(tmp_path, node("a"), node("b"))
    (tmp_path / "timing.json").write_text(text)
    (found,) = problems(file, time="virtual", timing=tmp_path / "timing.json")
    assert found.startswith("timing.json:1:")
    assert complaint in found


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    file = write(tmp_path, node("a"), node("b"))
    (found,) = problems(file, time="virtual", timing=tmp_path / "none.json")
    assert found.startswith("none.json:1:1: /: cannot be read: No such file")


def test_a_file_in_real_time_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path, node("a"), node("b"))
    (found,) = problems(file, timing=timing(tmp_path, hooks={"b.integrate": 1}))
    assert "have an effect in virtual time only (add --time virtual)" in found


# ---------------------------------------------------------------------- draws

DISTRIBUTIONS = st.one_of(
    st.floats(0, 10).map(lambda x: Distribution("constant", (x,))),
    st.tuples(st.floats(0, 10), st.floats(0, 10)).map(lambda x: Distribution("normal", x)),
    st.tuples(st.floats(0, 10), st.floats(0, 4)).map(lambda x: Distribution("lognormal", x)),
    st.tuples(st.floats(0, 10), st.floats(0, 10)).map(
        lambda x: Distribution("uniform", tuple(sorted(x)))
    ),
    st.lists(st.floats(0, 10), min_size=1).map(lambda x: Distribution("samples", tuple(x))),
)


@given(DISTRIBUTIONS, st.integers(1, 2**40))
def test_a_draw_is_whole_nanoseconds_from_the_least_on(found: Distribution, number: int) -> None:
    assert Distribution.of(json.loads(json.dumps(found.keys))) == found
    drawn = found.at_ns(Draws("1", "hook", "a").share(number))
    assert isinstance(drawn, int)
    assert found.least_ns <= drawn <= 86_400_000_000_000


@given(st.floats(1e-15, 1 - 1e-15))
def test_the_normal_quantile_is_that_of_the_standard_library(share: float) -> None:
    assert standard_normal(share) == pytest.approx(NormalDist().inv_cdf(share), 2e-7, 1e-7)


def test_distributions_have_the_values_that_they_name() -> None:
    shares = [Draws("", "x").share(number) for number in range(1, 20_001)]
    normal = [Distribution("normal", (0.045, 0.005)).at_ns(s) / 1e9 for s in shares]
    fitted = NormalDist.from_samples(normal)
    assert fitted.mean == pytest.approx(0.045, abs=2e-4)
    assert fitted.stdev == pytest.approx(0.005, rel=0.03)
    skewed = sorted(Distribution("lognormal", (0.04, 0.5)).at_ns(s) / 1e9 for s in shares)
    assert skewed[10_000] == pytest.approx(0.04, rel=0.02)
    assert skewed[16_827] == pytest.approx(0.04 * 2.718281828**0.5, rel=0.05)  # one sigma
    assert Distribution("normal", (0.0, 1.0)).at_ns(0.1) == 0


FIRST_LOGNORMAL = [19427668, 21178388, 34641837]
FIRST_NORMAL = [20797040, 22235090, 30436438]


def test_draws_depend_on_seed_name_and_number_alone_and_never_change() -> None:
    draws = Draws("1", "hook", "snn", "integrate")
    backwards = [draws.share(number) for number in range(5, 0, -1)]
    assert [*reversed(backwards)] == [
        Draws("1", "hook", "snn", "integrate").share(number) for number in range(1, 6)
    ]
    for other in (("2", "hook", "snn", "integrate"), ("1", "hook", "snn", "reset"), ("1", "hook")):
        assert Draws(*other).share(1) != draws.share(1)
    lognormal = Distribution("lognormal", (0.025, 0.3))
    normal = Distribution("normal", (0.025, 0.005))
    # These numbers are part of what a run in virtual time promises: they hold on every machine.
    assert [lognormal.at_ns(draws.share(n)) for n in (1, 2, 3)] == FIRST_LOGNORMAL
    assert [normal.at_ns(draws.share(n)) for n in (1, 2, 3)] == FIRST_NORMAL
