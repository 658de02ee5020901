"""Reset of a session: every node is where it was when the session began, with a seed."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from api_projects import COUNTER, ENDLESS, THROWER, dice
from cart_project import BRAIN, ROBOT, cart
from deadlines import wait_until
from hypothesis import given, settings
from hypothesis import strategies as st
from std_msgs.msg import Float64
from test_python_api import thrown
from test_stepped_sessions import ACCEPTANCE, DEADLINE_S, EVERY_BACK_END, poses

import neuros
from containers import require_containers
from neuros.api.live import LiveRun
from neuros.api.session import Session
from neuros.backends.control_sockets import connect
from neuros.control import (
    TO_OBSERVERS,
    GetStatus,
    Message,
    NodeStatus,
    Pause,
    Reset,
    Resume,
    Step,
    WasReset,
    Watch,
)
from neuros.control.link import ControlLink
from neuros.errors import RunError, UsageError

EYES = "thrower.eyes"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def shown(s: Session, rounds: int = 10) -> list[int]:
    """The dice of each round."""
    found = []
    for _ in range(rounds):
        assert s.step(timeout_s=DEADLINE_S)
        found.append(s[EYES].packet.data)
    return found


def is_in_place(s: Session) -> bool:
    """Whether no reset has needed a new run."""
    return not s.runs


@pytest.mark.parametrize("back_end", EVERY_BACK_END)
class TestOnEveryBackEnd:
    def test_one_seed_gives_one_sequence_of_packets(self, tmp_path: Path, back_end: str) -> None:
        if back_end == "docker":
            require_containers()
        with neuros.Project.from_file(dice(tmp_path, ENDLESS)).session(backend=back_end) as s:
            assert shown(s) == thrown(1)
            s.reset(seed=3)
            assert s[EYES].packet is None
            assert shown(s) == thrown(3)
            s.reset()
            assert shown(s) == thrown(3) != thrown(1)
        assert [run.exit_code for run in s.runs] == (
            [] if back_end in ("local", "in-process") else [0, 0]
        )
        assert s.close().exit_code == 0

    def test_a_loop_with_physics_begins_again(self, tmp_path: Path, back_end: str) -> None:
        if back_end == "docker":
            require_containers()
        with neuros.Project.from_file(cart(tmp_path)).session(backend=back_end) as s:
            assert poses(s, 3) == [1.0, 0.5, 0.25]
            s.reset()
            assert s.sim_time is None
            assert poses(s, 3) == [1.0, 0.5, 0.25]
            assert s["robot.pose"].count == 3
            assert s.sim_time == pytest.approx(0.03)


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder = tmp_path_factory.mktemp("dice")
    project = neuros.Project.from_file(dice(folder, ENDLESS))
    with project.session(backend="in-process", output=folder / "run") as s:
        yield s
        assert is_in_place(s)


@settings(max_examples=20, deadline=None)
@given(seeds=st.lists(st.integers(0, 9), min_size=2, max_size=4), rounds=st.integers(0, 12))
def test_episodes_of_one_seed_are_equal_whatever_came_before(
    held: Session, seeds: list[int], rounds: int
) -> None:
    for seed in seeds:
        held.reset(seed=seed)
        assert shown(held, rounds) == [*thrown(seed), *shown_later(seed)][:rounds]


def shown_later(seed: int) -> list[int]:
    """What follows the first ten."""
    source = random.Random(seed)
    return [source.randint(1, 6) for _ in range(12)][10:]


def test_counters_and_queues_begin_at_zero(tmp_path: Path) -> None:
    with neuros.Project.from_file(cart(tmp_path)).session(backend="in-process") as s:
        s.step(4)
        s.send("robot.push", Float64(data=8.0))  # not taken when the reset comes
        with pytest.raises(UsageError, match="no node of cart has an environment variable"):
            s.reset(seed=1)
        s.reset()
        counters = s.state()["robot"].counters
        assert counters is not None
        assert not any(c["received"] for c in counters.metrics["incoming"].values())
        assert not any(c["sent"] for c in counters.metrics["outgoing"].values())
        assert poses(s, 2) == [1.0, 0.5]
    connection = s.close().connections["robot.pose -> brain.pose"]
    assert (connection["sent"], connection["received"], connection["lost"]) == (2, 2, 0)


def test_a_plugin_is_loaded_anew_with_the_modules_beside_it(tmp_path: Path) -> None:
    made = cart(tmp_path)
    (made / "memory.py").write_text("rounds = []\n")
    own = "\nimport memory, os\nfrom neuros.hooks import neuros_finalise\n"
    end = "\n@neuros_finalise()\ndef end(node):\n    print('rounds', len(memory.rounds))\n"
    noting = ROBOT.replace("    steps += 1", "    steps += 1; memory.rounds.append(steps)")
    noting = noting.replace(
        "pose.data = place", "pose.data = float(len(memory.rounds)); os.environ['LEFT'] = '1'"
    )
    check = "\nassert 'LEFT' not in os.environ\n"
    (made / "robot.py").write_text(own + check + noting + end)
    with neuros.Project.from_file(made).session(backend="in-process") as s:
        assert poses(s, 3) == [1.0, 2.0, 3.0]
        s.reset()
        assert poses(s, 2) == [1.0, 2.0]
        assert is_in_place(s)
    log = (s.folder / "robot" / "node.log").read_text()
    assert log.count("rounds 3") == 1


RESETTING = """
import os, random
from neuros.hooks import neuros_initialise, neuros_function, neuros_reset

loads = []

@neuros_initialise(outputs="eyes")
def start(node):
    loads.append("expensive")
    return begin(node)

@neuros_reset(outputs="eyes")
def begin(node):
    node.set_user_data(random.Random(int(os.environ["SEED"])))
    packet = node.make_packet("eyes")
    packet.data = 100 * len(loads) + int(os.environ["SEED"])
    return packet
"""


def test_a_reset_hook_keeps_the_plugin_and_takes_the_place_of_its_initialise_hooks(
    tmp_path: Path,
) -> None:
    made = dice(tmp_path, ENDLESS)
    (made / "thrower.py").write_text(RESETTING + THROWER[THROWER.index("@neuros_function") :])
    with neuros.Project.from_file(made).session(backend="in-process") as s:
        for seed, first in ((None, 101), (3, 103), (3, 103), (1, 101)):
            if seed is not None:
                s.reset(seed=seed)
            assert s[EYES].packet.data == first
            assert shown(s) == thrown(seed or 1)
        assert is_in_place(s)
    assert s.close().exit_code == 0


BEYOND_REACH = {
    "a thread": "import threading, time\n"
    "threading.Thread(target=time.sleep, args=(600,), daemon=True).start()\n",
    "a ROS timer": "from neuros.hooks import neuros_initialise\n"
    "@neuros_initialise()\n"
    "def listen(node):\n    node.get_ros_node().create_timer(600.0, lambda: None)\n",
}


@pytest.mark.parametrize("what", ["a thread", pytest.param("a ROS timer", marks=ACCEPTANCE)])
def test_what_a_process_cannot_take_back_takes_a_new_one(tmp_path: Path, what: str) -> None:
    made = cart(tmp_path)
    (made / "brain.py").write_text(BEYOND_REACH[what] + BRAIN)
    with neuros.Project.from_file(made).session(backend="in-process") as s:
        assert poses(s, 2) == [1.0, 0.5]
        s.reset()
        assert poses(s, 2) == [1.0, 0.5]
    (before,) = s.runs
    assert (before.exit_code, before.reason) == (0, "the session was reset")
    assert before.folder != s.folder


@ACCEPTANCE
@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_each_recorded_episode_is_a_run(tmp_path: Path, back_end: str) -> None:
    project = neuros.Project.from_file(dice(tmp_path, ENDLESS))
    with project.session(backend=back_end, record=True, output=tmp_path / "out", seed=3) as s:
        for seed in (3, 4):
            assert shown(s) == thrown(seed)
            s.reset(seed=4)
        shown(s)
    runs = [*s.runs, s.close()]
    assert [run.folder.name for run in runs] == ["out", "out-2", "out-3"]
    recorded = [[m.data for _, m in run.bag[EYES].messages()][:10] for run in runs]
    assert recorded == [thrown(3), thrown(4), thrown(4)]


@ACCEPTANCE
def test_a_run_that_has_ended_or_failed_can_be_reset(tmp_path: Path) -> None:
    with neuros.Project.from_file(dice(tmp_path, COUNTER)).session(backend="in-process") as s:
        assert not s.step(20)
        s.reset(seed=2)
        assert shown(s, 9) == thrown(2)[:9]
    assert s.runs[0].reason == "counter ended the project: ten were thrown"


@ACCEPTANCE
def test_a_plugin_that_cannot_be_loaded_again_fails_the_run(tmp_path: Path) -> None:
    made = cart(tmp_path)
    with neuros.Project.from_file(made).session(backend="in-process") as s:
        s.step()
        (made / "brain.py").write_text(BRAIN + "\nraise ValueError('no brain')\n")
        with pytest.raises(RunError, match="no brain"):
            s.reset()
        (made / "brain.py").write_text(BRAIN)
        s.reset()
        assert poses(s, 2) == [1.0, 0.5]


def observed(live: LiveRun) -> ControlLink:
    """An observer of the run, as soon as it can be observed."""
    while True:
        with contextlib.suppress(OSError):
            link = ControlLink(connect(live.control_address), TO_OBSERVERS, "the supervisor")
            link.send(Watch())
            return link


def answer(link: ControlLink, *wishes: Message) -> WasReset:
    """What the observer hears of a reset."""
    for wish in wishes:
        link.send(wish)
    while True:
        for message in link.receive() or ():
            if isinstance(message, WasReset):
                return message


def counted(link: ControlLink) -> tuple[str, int]:
    """The state of the thrower, and how many dice it has thrown."""
    link.send(GetStatus({}))
    while True:
        for message in link.receive() or ():
            if isinstance(message, NodeStatus) and message.node == "thrower":
                assert message.counters is not None
                (sent,) = message.counters.metrics["outgoing"].values()
                return message.counters.metrics["state"]["state"], sent["sent"]


def test_an_observer_resets_a_run_only_while_that_is_paused(tmp_path: Path) -> None:
    project = neuros.Project.from_file(dice(tmp_path, ENDLESS))
    with project.start(backend="in-process", output=tmp_path / "run") as live:
        link = observed(live)
        while answer(link, Reset({})).why_not == "its nodes have not started yet":
            pass
        while counted(link)[1] == 0:
            pass
        assert answer(link, Reset({})).why_not == "the run is not paused: pause it first"
        assert answer(link, Pause(), Step(1_000_000), Reset({})).why_not == ""
        wait_until(lambda: counted(link)[0] == "paused")  # it registers, and initialises, first
        assert counted(link) == ("paused", 0)
        link.send(Resume())
        while counted(link)[1] == 0:
            pass
        link.close()
    assert live.wait().exit_code == 0
