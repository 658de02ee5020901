"""Forks of sessions: a second one at the same place, which goes on by itself, or with a change."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from std_msgs.msg import Float64

import neuros
from neuros.api.session import Session
from neuros.errors import ProjectError, RunError, UsageError

DEADLINE_S = 60.0
FLOAT = "std_msgs/msg/Float64"
BACK_ENDS = ["local", "in-process", "process"]
# A state that grows by what its environment, its parameter and its input say.
GROWS = """
import os
from neuros.hooks import Optional, neuros_function, neuros_initialise

@neuros_initialise()
def begin(node):
    node.set_user_data([0.0, 0])
    node.on_change(lambda: node.get_user_data().__setitem__(1, 100))

@neuros_function(inputs=Optional("more"), outputs="sum")
def grow(node, more):
    state = node.get_user_data()
    state[0] += float(os.environ["STEP"]) + node.get_ros_node().get_parameter("extra").value
    state[0] += 0.0 if more is None else more.data
    sum = node.make_packet("sum")
    sum.data = state[0] + state[1]
    return sum
"""
DOUBLES = """
from neuros.hooks import neuros_function

@neuros_function(inputs="sum", outputs="twice")
def double(node, sum):
    twice = node.make_packet("twice")
    twice.data = 2 * sum.data
    return twice
"""
FALLS = """
from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

@neuros_initialise()
def begin(node):
    node.set_user_data(MuJoCo(node, '''<mujoco><option timestep="0.01"/><worldbody>
      <body pos="0 0 10"><freejoint/><geom size="0.1" mass="2"/></body></worldbody></mujoco>'''))

@neuros_function(outputs="sum")
def fall(node):
    simulator = node.get_user_data()
    simulator.step_synchronous()
    height = node.make_packet("sum")
    height.data = float(simulator.data.qpos[2])
    return height
"""


def described(folder: Path, plugin: str = GROWS, limit: int | None = 0) -> neuros.Project:
    (folder / "grower.py").write_text(plugin)
    (folder / "doubler.py").write_text(DOUBLES)
    out, twice = {"name": "sum", "type": FLOAT}, {"name": "twice", "type": FLOAT}
    more = [{"name": "more", "type": FLOAT}] if plugin is not FALLS else []
    grower: dict[str, Any] = {
        "name": "grower",
        "container": "neuros_mujoco",
        "plugin": "grower.py",
        "inputs": more,
        "outputs": [out],
        "environment": {"STEP": 1},
        "parameters": {"extra": 0.0},
    }
    doubler = {"name": "doubler", "container": "neuros_python", "plugin": "doubler.py"}
    doubler |= {"inputs": [out], "outputs": [twice]}
    wire: dict[str, Any] = {"source_node": "grower", "source_output": "sum"}
    wire |= {"destination_node": "doubler", "destination_input": "sum"}
    if limit is not None:
        wire["discard_limit"] = limit
    project = {"nodes": [grower, doubler], "connections": [wire]}
    (folder / "project.json").write_text(json.dumps(project))
    return neuros.Project.from_file(folder)


def sums(s: Session, rounds: int) -> list[float]:
    """What comes of so many rounds more."""
    s["doubler.twice"].packets  # noqa: B018  # those of before are read
    s.step(rounds, timeout_s=DEADLINE_S)
    return [packet.data / 2 for packet in s["doubler.twice"].packets]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NEUROS_BACKEND", raising=False)


pytestmark = pytest.mark.filterwarnings("ignore:.*nothing in the plugin of node")


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_a_fork_is_where_the_session_is_and_both_go_on_by_themselves(
    tmp_path: Path, back_end: str
) -> None:
    with described(tmp_path).session(backend=back_end) as s:
        assert sums(s, 3)[-1] == 3.0
        with s.fork() as other:
            assert sums(other, 2) == [4.0, 5.0]
            assert sums(s, 1) == [4.0]
        assert sums(s, 1) == [5.0]
    assert other.folder != s.folder


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_environment_and_parameters_change_at_the_fork(tmp_path: Path, back_end: str) -> None:
    settings = {"nodes.grower.environment.STEP": 10, "nodes.grower.parameters.extra": 0.5}
    with described(tmp_path).session(backend=back_end) as s:
        sums(s, 3)
        with s.fork(set=settings) as other:
            assert sums(other, 2) == [113.5, 124.0]  # on_change adds the 100
            assert sums(s, 2) == [4.0, 5.0]
    about = other.close().record["fork"]
    assert about["run"] == str(s.folder)
    assert about["set"] == {
        "nodes.grower.environment.STEP": "10",
        "nodes.grower.parameters.extra": "0.5",
    }
    assert "fork" not in s.close().record


@pytest.mark.parametrize("back_end", ["local", "process"])
def test_a_field_of_the_model_changes_and_the_state_stays(tmp_path: Path, back_end: str) -> None:
    with described(tmp_path, FALLS).session(backend=back_end) as s:
        fallen = sums(s, 20)
        with s.fork() as same, s.fork(set={"grower.model.opt.gravity": 0}) as other:
            still = sums(other, 5)
            goes_on = sums(s, 5)
            assert sums(same, 5) == goes_on
    assert still[0] < fallen[-1]
    speeds = [before - after for before, after in itertools.pairwise(still)]
    assert speeds == pytest.approx([speeds[0]] * 4)
    assert goes_on[-1] < still[-1]


def test_the_time_of_the_fork_is_in_its_record(tmp_path: Path) -> None:
    project = described(tmp_path, FALLS)
    with project.session() as s:
        sums(s, 7)
        with s.fork() as other:
            pass
    assert other.close().record["fork"]["at_sim_s"] == s.sim_time


def test_packets_that_the_session_has_sent_are_sent_again(tmp_path: Path) -> None:
    with described(tmp_path).session(forkable=True) as s:
        packet = Float64(data=5.0)
        s.send("grower.more", packet)
        packet.data = 70.0  # it was sent as it was
        assert sums(s, 2) == [6.0, 7.0]
        s.send("grower.more", packet)
        with s.fork() as other:
            assert sums(other, 1) == [78.0]
            with other.fork(set={"nodes.grower.environment.STEP": 0}) as third:
                assert sums(third, 1) == [178.0]
        assert sums(s, 1) == [78.0]


def test_a_fork_of_a_changed_fork_changes_it_at_the_same_place(tmp_path: Path) -> None:
    with described(tmp_path).session() as s:
        sums(s, 2)
        with s.fork(set={"nodes.grower.environment.STEP": 3}) as other:
            assert sums(other, 2) == [105.0, 108.0]
            with other.fork() as third:
                assert sums(third, 1) == sums(other, 1) == [111.0]


def test_a_fork_begins_with_the_last_reset_and_its_settings(tmp_path: Path) -> None:
    with described(tmp_path).session() as s:
        sums(s, 5)
        s.reset(set={"nodes.grower.environment.STEP": 2})
        sums(s, 1)
        with s.fork() as other:
            assert sums(other, 1) == [4.0]


moves = st.lists(
    st.one_of(
        st.tuples(st.just("step"), st.integers(1, 4)),
        st.tuples(st.just("until"), st.integers(1, 3)),
        st.tuples(st.just("send"), st.integers(-5, 5)),
        st.tuples(st.just("look"), st.just(0)),
    ),
    max_size=12,
)


def play(s: Session, done: list[tuple[str, int]]) -> list[float]:
    found = []
    for what, number in done:
        if what == "step":
            found += sums(s, number)
        elif what == "until":
            count = s["grower.sum"].count + number
            s.step(until=lambda s, count=count: s["grower.sum"].count >= count)
        elif what == "send":
            s.send("grower.more", Float64(data=float(number)))
        else:
            s.state()
    return found + sums(s, 1)


@settings(max_examples=15, deadline=None)
@given(moves, moves)
def test_whatever_was_done_a_fork_does_then_what_the_session_does(
    tmp_path_factory: pytest.TempPathFactory,
    before: list[tuple[str, int]],
    after: list[tuple[str, int]],
) -> None:
    with described(tmp_path_factory.mktemp("p"), limit=None).session(forkable=True) as s:
        play(s, before)
        with s.fork() as other:
            assert play(other, after) == play(s, after)


def test_in_virtual_time_a_session_that_ran_for_a_time_is_forked(tmp_path: Path) -> None:
    project = described(tmp_path, limit=None)
    times = {"nodes.grower.durations": {"grow": {"uniform": [0.01, 0.03]}}}
    with project.session(time="virtual", set=times) as s:
        s.run(duration_s=0.5)
        with s.fork() as other:
            assert other["grower.sum"].count == s["grower.sum"].count > 10
            for each in (s, other):
                each.run(duration_s=0.3)
            assert other["doubler.twice"].packet == s["doubler.twice"].packet


# ------------------------------------------------------------------ refused


def runs_for_a_time(s: Session) -> None:
    s.run(duration_s=0.01)


def sends(s: Session) -> None:
    s.send("grower.more", Float64(data=1.0))


@pytest.mark.parametrize(
    ("before", "says"),
    [
        (runs_for_a_time, "it ran for a wall time .*use duration_sim_s"),
        (sends, r"grower.more was sent packets that are not kept: .*session\(forkable=True\)"),
    ],
)
def test_what_cannot_be_done_again_is_refused_until_the_next_reset(
    tmp_path: Path, before: Callable[[Session], None], says: str
) -> None:
    with described(tmp_path).session() as s:
        before(s)
        with pytest.raises(UsageError, match=f"(?s)cannot be forked:.*{says}"):
            s.fork()
        s.reset()
        s.fork().close()


def test_values_that_were_kept_over_a_reset_are_refused(tmp_path: Path) -> None:
    keeps = GROWS.replace(
        "    node.on_change", "    node.keep('it', lambda: 1, lambda _: None)\n    node.on_change"
    )
    with described(tmp_path, keeps).session() as s:
        s.reset(keep=True)
        with pytest.raises(UsageError, match="values were kept over its reset: reset it without"):
            s.fork()


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("nodes.grower.plugin", "other.py", "set: nodes.grower.plugin: a fork changes nodes.NODE"),
        ("connections.grower.sum.doubler.sum.discard_limit", 1, "a fork changes nodes.NODE.env"),
        ("nodes.grower.environment.STEP", None, "a fork changes .* each to a value"),
        ("nodes.grower.parameters.extr", 1.0, "has no parameter 'extr' .did you mean 'extra'"),
        ("growr.model.geom_friction", 1.0, "has no node 'growr' .did you mean 'grower'"),
    ],
)
def test_a_wrong_setting_is_refused_before_anything_is_executed(
    tmp_path: Path, path: str, value: Any, says: str
) -> None:
    with described(tmp_path).session() as s:
        before = {*tmp_path.glob("runs/*/*")}
        with pytest.raises((UsageError, ProjectError), match=f"(?s){says}"):
            s.fork(set={path: value})
        assert {*tmp_path.glob("runs/*/*")} == before
        assert sums(s, 1) == [1.0]


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("geom_fricton", 1.0, "the model has no field 'geom_fricton' with numbers .*geom_friction"),
        ("opt.gravity", [1, 2], r"'opt.gravity' has the shape \(3,\), not \(2,\)"),
    ],
)
def test_a_field_that_the_model_lacks_is_refused_before_the_rounds(
    tmp_path: Path, field: str, value: Any, says: str
) -> None:
    with described(tmp_path, FALLS).session() as s:
        sums(s, 3)
        with pytest.raises(RunError, match=says):
            s.fork(set={f"grower.model.{field}": value})
        (run,) = {*tmp_path.glob("runs/*/*")} - {s.folder}
        assert json.loads((run / "run.json").read_text())["sim_s"] == 0.0
        assert len(sums(s, 1)) == 1


def test_a_session_that_has_ended_is_refused(tmp_path: Path) -> None:
    with described(tmp_path).session() as s:
        s.close()
        with pytest.raises(RunError, match="the run has ended"):
            s.fork()


def test_packets_that_may_be_lost_between_processes_are_refused(tmp_path: Path) -> None:
    session = described(tmp_path, limit=None).session(backend="process")
    with session as s, pytest.raises(UsageError) as error:
        s.fork()
    assert str(error.value).splitlines()[1:] == [
        '  grower.sum -> doubler.sum: may lose packets: give it "discard_limit": 0'
    ]


def test_physics_that_runs_by_itself_is_refused(tmp_path: Path) -> None:
    runs = FALLS.replace("simulator.step_synchronous()", "simulator.run_asynchronous()")
    says = "grower: its plugin sends from a thread"
    with described(tmp_path, runs).session() as s, pytest.raises(UsageError, match=says):
        s.fork()


def test_a_plugin_that_does_something_else_the_next_time_is_found_out(tmp_path: Path) -> None:
    later = tmp_path / "later"
    looks = GROWS.replace('outputs="sum"', 'outputs=Optional("sum")').replace(
        "    return sum", f"    return None if os.path.exists({str(later)!r}) else sum"
    )
    says = "the fork has come to another place: (.*): does a plugin use wall time"
    with described(tmp_path, looks).session() as s:
        sums(s, 100)
        later.touch()
        with pytest.raises(RunError, match=says):
            s.fork()
        assert s.is_running
