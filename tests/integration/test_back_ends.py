"""What every back end guarantees: the same projects, with real rclpy, on each of them.

Each project of the folder ``back_ends`` is run once per back end; the tests look at what it left.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from launching import BACKENDS, Finished, launch, start
from ros_program import RosProgram
from std_msgs.msg import Int32
from std_srvs.srv import SetBool, Trigger

from containers import require_containers
from neuros.backends.domain import choose_domain

PROJECTS = Path(__file__).parent / "back_ends"
COUNT = 200
TIMEOUT_S = 60.0


Run = Callable[..., Finished]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a project on a back end with some arguments, once."""

    @cache
    def run_once(back_end: str, project: str, *arguments: str) -> Finished:
        folder = tmp_path_factory.mktemp(f"{back_end}-{project}")
        finished = launch(
            PROJECTS / project, "--backend", back_end, *arguments, cwd=folder, timeout_s=TIMEOUT_S
        )
        assert finished.exit_code == 0, finished.output
        return finished

    return run_once


def read(finished: Finished, path: str) -> str:
    """A file of the run folder."""
    return (finished.run_folder / path).read_text()


def hooks(finished: Finished, node: str) -> dict[str, int]:
    """How often each hook has run."""
    books = finished.record["nodes"][node]["hooks"]
    return {name: hook["executions"] for name, hook in books.items()}


@pytest.fixture(params=[*BACKENDS, "docker"])
def back_end(request: pytest.FixtureRequest) -> str:
    if request.param == "docker":
        require_containers()
    return str(request.param)


# ------------------------------------------------------------------ connections


@pytest.fixture
def pipeline(back_end: str, run: Run) -> Finished:
    return run(back_end, "pipeline")


@pytest.mark.parametrize(
    "connection",
    [
        "source.number -> relay.number",
        "source.series -> relay.series",
        "relay.number -> sink.number",
        "relay.total -> sink.total",
    ],
)
def test_a_lossless_connection_loses_nothing_up_to_the_drained_end(pipeline, connection):
    counters = pipeline.connection(connection)
    assert {counters[key] for key in ("sent", "received", "consumed")} == {COUNT}
    assert counters["discarded"] == counters["unread"] == 0


def test_a_discard_limit_is_never_exceeded(pipeline):
    counters = pipeline.connection("source.number -> limited.number")
    assert counters["sent"] == counters["received"] == COUNT
    assert 0 < counters["discarded"] < COUNT
    assert counters["longest_discard"] <= 2
    taken = [0, *map(int, read(pipeline, "limited/taken").split())]
    assert len(taken) - 1 == counters["consumed"]
    assert max(b - a for a, b in itertools.pairwise(taken)) <= 3


def test_a_connection_without_limit_holds_up_nobody(pipeline):
    counters = pipeline.connection("source.number -> unlimited.number")
    assert counters["sent"] == COUNT
    assert 0 < counters["received"] <= COUNT
    taken = list(map(int, read(pipeline, "unlimited/taken").split()))
    assert taken == sorted(set(taken))


def test_the_ledger_closes(pipeline):
    for counters in pipeline.record["connections"]:
        settled = counters["consumed"] + counters["discarded"] + counters["unread"]
        assert counters["received"] == settled
        assert counters["sent"] >= counters["received"]
        if counters["discard_limit"] is not None:
            assert counters["sent"] == counters["received"]


def test_each_hook_runs_as_often_as_it_should(pipeline):
    assert hooks(pipeline, "source") == {"begin": 1, "emit": COUNT}
    assert hooks(pipeline, "relay") == {"begin": 1, "relay": COUNT}
    assert hooks(pipeline, "sink") == {"begin": 1, "take_number": COUNT, "take_total": COUNT}


def test_the_times_of_a_node_add_up(pipeline):
    for node in pipeline.record["nodes"].values():
        spent = node["accounting"]
        parts = sum(
            sum(part.values()) if isinstance(part, dict) else part
            for name, part in spent.items()
            if name != "total"
        )
        assert parts == pytest.approx(spent["total"], rel=1e-6)
        assert node["report"] == "final"


def test_a_reproducible_project_sends_the_same_bytes_on_every_back_end(pipeline, run):
    digests = {read(run(back_end, "pipeline"), "sink/digest") for back_end in BACKENDS}
    assert digests == {read(pipeline, "sink/digest")}


# ------------------------------------------------------------------ joins


@pytest.fixture
def joins(back_end: str, run: Run) -> Finished:
    return run(back_end, "joins")


def test_all_gives_one_packet_of_each_source_in_the_order_of_the_project(joins):
    expected = [f"e{i},a{i},b{i}" for i in range(1, 11)]
    assert read(joins, "chair/rounds").split() == expected


def test_a_connection_to_itself_is_lossless_too(joins):
    counters = joins.connection("chair.round -> chair.round")
    assert [counters[key] for key in ("sent", "received", "consumed")] == [10, 10, 10]


def test_one_output_feeds_several_receivers_losslessly(joins):
    for receiver in ("ann", "bob", "eve"):
        counters = joins.connection(f"chair.question -> {receiver}.question")
        assert [counters[key] for key in ("sent", "received", "consumed")] == [10, 10, 10]


def test_optional_inputs_are_taken_when_they_are_there(joins):
    seen = ast.literal_eval(read(joins, "watcher/seen"))
    votes = [vote for vote, _ in seen]
    extra = [extra for _, extra in seen if extra]
    assert votes == [f"a{i}" for i in range(1, 11)]
    assert extra == [f"b{i}" for i in range(1, len(extra) + 1)]
    left = joins.connection("bob.vote -> watcher.extra")
    assert left["consumed"] == len(extra)
    assert left["unread"] == 10 - len(extra)


# ------------------------------------------------------------------ surroundings


@pytest.fixture
def surroundings(back_end: str, run: Run) -> Finished:
    """Its plugin fails at once if it sees anything of the other node; see there."""
    return run(back_end, "surroundings")


def test_nodes_of_one_plugin_share_neither_globals_nor_environment_nor_modules(surroundings):
    for node in ("ann", "bob"):
        *_, last = read(surroundings, f"{node}/notes").splitlines()
        assert last == "finalise after 5 strokes and 5 calls"


def test_initialise_and_finalise_hooks_run_once(surroundings):
    for node in ("ann", "bob"):
        notes = read(surroundings, f"{node}/notes").splitlines()
        assert [note.split()[0] for note in notes] == ["initialise", "finalise"]


def test_what_a_node_says_is_in_its_own_log_up_to_the_end(surroundings):
    for node, other in (("ann", "bob"), ("bob", "ann")):
        log = read(surroundings, f"{node}/node.log")
        assert log.count(f"print on import: {node}\n") == 1
        assert log.count(f"print in hook: {node}\n") == 5
        assert log.count(f"print in a callback: {node}\n") == 1
        assert log.count(f"child of {node}, ") == 5
        assert len(re.findall(rf"\[INFO\] \[[\d.]+\] \[{node}\]: log in hook: {node}\n", log)) == 5
        assert log.count(f"print at the end: {node}\n") == 1
        assert other not in log.replace("standard", "")


def test_a_variable_of_one_node_hides_that_of_the_process_for_that_node_only(surroundings):
    assert read(surroundings, "ann/node.log").count("home /ann\n") == 5
    assert "home /ann\n" not in read(surroundings, "bob/node.log")


def test_everything_that_nodes_say_reaches_the_console(surroundings):
    for node in ("ann", "bob"):
        assert surroundings.output.count(f"log in hook: {node}") == 5
        assert f"print at the end: {node}" in surroundings.output


# ------------------------------------------------------------------ the rest of the world


def test_external_topics_services_and_timers_are_served_between_hooks(
    back_end, tmp_path, monkeypatch
):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with choose_domain(None, {}, False) as domain:
        arguments = ("--backend", back_end, "-d", str(domain.id))
        with (
            RosProgram(domain_id=domain.id) as program,
            start(PROJECTS / "outside", *arguments, cwd=tmp_path) as running,
        ):
            talk_to_the_gate(program)
            finished = running.finish(TIMEOUT_S)
    assert finished.exit_code == 0, finished.output
    assert "gate ended the project: told to by a service" in finished.output
    counters = finished.connection("gate.passed -> book.passed")
    written = read(finished, "book/book").split()
    assert counters["sent"] == counters["received"] == counters["consumed"] == len(written) >= 1


def talk_to_the_gate(program: RosProgram) -> None:
    """Ask, listen to what is answered and to what it sends its neighbour, and end it."""
    answered = program.listen("/answered", "std_msgs/msg/Int32")
    passed = program.listen("/neuros/gate/passed/book/passed/data", "std_msgs/msg/Int32")
    ask = program.node.create_publisher(Int32, "/asked", 10)

    def is_heard() -> bool:
        ask.publish(Int32(data=21))
        return bool(answered and passed)

    program.spin_until(is_heard)
    assert answered[0].data == 42
    assert passed[0].data == 21

    def has_ticked() -> bool:
        told = program.call(Trigger, "/gate/tell", Trigger.Request())
        assert int(told.message) >= 1
        return bool(told.success)  # whether its timer has run

    program.spin_until(has_ticked)
    assert program.call(SetBool, "/gate/stop", SetBool.Request(data=True)).success


# ------------------------------------------------------------------ time


def test_ticks_keep_their_schedule_and_a_duration_in_wall_time_ends_drained(back_end, run):
    finished = run(back_end, "time", "--duration", "0.5")
    ticks = finished.record["nodes"]["clock"]["hooks"]["step"]
    # 50 ticks of 10 ms, some of which a machine with other work to do may miss.
    assert 35 <= ticks["executions"] <= 52
    assert 48 <= ticks["executions"] + ticks["missed_ticks"] <= 52
    counters = finished.connection("clock.clock -> reader.clock")
    assert counters["sent"] == counters["consumed"] == ticks["executions"]


def test_a_duration_in_simulated_time_ends_exactly_there(back_end, run):
    finished = run(back_end, "time", "--duration", "0.25sim")
    assert finished.record["sim_s"] == pytest.approx(0.25)
    counters = finished.connection("clock.clock -> reader.clock")
    assert [counters[key] for key in ("sent", "received", "consumed")] == [25, 25, 25]
