"""Whole runs that are recorded: nothing is missing in the bag, whatever ends the run."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until
from launching import BACKENDS, EXAMPLES, Finished, Running, launch, start
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from processes import is_alive, processes_of
from recordings import flushed
from ros_program import RosProgram
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, String
from test_back_ends import talk_to_the_gate

import neuros.bag
from neuros.backends.domain import choose_domain
from neuros.cli.main import main

HERE = Path(__file__).parent
PROJECTS = HERE / "back_ends"
NUMBER = "/neuros/source/number/relay/number/data"
TIMEOUT_S = 60.0


def recorded(finished: Finished) -> dict[str, dict[str, Any]]:
    """What ``run.json`` says of the recording, by topic."""
    topics: dict[str, dict[str, Any]] = finished.record["recording"]["topics"]
    return topics


@pytest.fixture(scope="module", params=BACKENDS)
def pipeline(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("recorded")
    finished = launch(
        PROJECTS / "pipeline", "-r", "--backend", request.param, cwd=folder, timeout_s=TIMEOUT_S
    )
    assert finished.exit_code == 0, finished.output
    return finished


# ------------------------------------------------------------------ every packet, every reader


def test_every_packet_of_every_connection_is_in_the_bag(pipeline: Finished) -> None:
    connections = {c["connection"]: c["sent"] for c in pipeline.record["connections"]}
    found = {t["connection"]: t["recorded"] for t in recorded(pipeline).values()}
    assert found == connections
    assert found["source.number -> relay.number"] == 200
    assert found["source.number -> unlimited.number"] == 200  # more than arrived there
    assert found["limited.permit -> limited.permit"] > 0
    assert pipeline.record["recording"]["problems"] == []


def test_the_end_of_a_run_says_what_was_recorded_of_lossy_connections(pipeline: Finished) -> None:
    count = sum(topic["recorded"] for topic in recorded(pipeline).values())
    assert f"recorded {count} packets on 7 topics" in pipeline.output
    assert "recorded 200 of 200 packets of connections that may lose any number" in pipeline.output


def test_rosbags_reads_it_in_the_order_of_time(pipeline: Finished) -> None:
    assert pipeline.run_folder is not None
    with Reader(pipeline.run_folder / "bag") as reader:
        times = [at for _, at, _ in reader.messages()]
    assert times == sorted(times)
    assert len(times) == sum(topic["recorded"] for topic in recorded(pipeline).values())


def test_mcap_ros2_support_reads_the_very_numbers_that_were_sent(pipeline: Finished) -> None:
    assert pipeline.run_folder is not None
    with (pipeline.run_folder / "bag" / "bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        numbers = [
            each.decoded_message.data for each in reader.iter_decoded_messages(topics=[NUMBER])
        ]
    assert numbers == list(range(1, 201))


def test_neuros_gives_arrays(pipeline: Finished) -> None:
    with neuros.bag.open(pipeline.run_folder) as bag:
        assert bag["source.number -> relay.number"].array()["data"].tolist() == [*range(1, 201)]
        totals = bag["relay.total"].array()["data"].tolist()
        assert len(totals) == 200
        assert totals == sorted(totals)
        assert bag.custom["project"] == "pipeline"
        assert len(bag.custom["project_sha256"]) == 64


def test_nothing_but_the_bag_is_left_of_the_recording(pipeline: Finished) -> None:
    assert pipeline.run_folder is not None
    assert list(pipeline.run_folder.rglob("spool")) == []
    assert list(pipeline.run_folder.rglob(".listener")) == []


def test_images_are_recorded_whole_and_still_pass_through_shared_memory(tmp_path: Path) -> None:
    project = HERE / "large_packets"
    finished = launch(project, "-r", "--backend", "process", cwd=tmp_path, timeout_s=TIMEOUT_S)
    assert finished.exit_code == 0, finished.output
    assert "stores in neuros_" in finished.output
    sys.path.insert(0, str(project))
    try:
        pixels = importlib.import_module("pixels").pixels
    finally:
        sys.path.remove(str(project))
    with neuros.bag.open(finished.run_folder) as bag:
        images = bag["camera.image -> lossless.image"].array()
        assert images["header.stamp.sec"].tolist() == [*range(1, 61)]
        assert all(bytes(image["data"]) == bytes(pixels(k)) for k, image in enumerate(images, 1))


def test_publish_time_is_simulated_time(tmp_path: Path) -> None:
    finished = launch(
        PROJECTS / "time", "-r", "--duration", "0.3sim", cwd=tmp_path, timeout_s=TIMEOUT_S
    )
    assert finished.exit_code == 0, finished.output
    with neuros.bag.open(finished.run_folder) as bag:
        clock = bag["clock.clock"].array()
    stamps = clock["clock.sec"].astype(int) * 10**9 + clock["clock.nanosec"]
    assert len(clock) >= 30
    assert clock["publish_time_ns"].tolist() == stamps.tolist()
    assert abs(clock["log_time_ns"][0] / 1e9 - time.time()) < 600


# ------------------------------------------------------------------ the rest of the world


@pytest.mark.parametrize("back_end", BACKENDS)
def test_external_topics_topics_of_nobody_in_the_project_and_the_clock_of_somebody_else(
    back_end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with choose_domain(None, {}, False) as domain:
        options = ("-r", "-t", "/news", "--backend", back_end, "-d", str(domain.id))
        with (
            RosProgram(domain_id=domain.id) as program,
            start(PROJECTS / "outside", *options, cwd=tmp_path) as running,
        ):
            news = program.node.create_publisher(String, "/news", 10)
            clock = program.node.create_publisher(Clock, "/clock", 10)
            for publisher in (news, clock):
                program.spin_until(lambda each=publisher: each.get_subscription_count() > 0)
            news.publish(String(data="rain"))
            clock.publish(Clock())
            talk_to_the_gate(program)
            finished = running.finish(TIMEOUT_S)
    assert finished.exit_code == 0, finished.output
    with neuros.bag.open(finished.run_folder) as bag:
        asked, answered = bag["/asked"].array()["data"], bag["/answered"].array()["data"]
        assert bag["/news"].array()["data"].tolist() == ["rain"]
        passed = len(bag["gate.passed"].raw())
        assert passed == finished.connection("gate.passed -> book.passed")["sent"]
        # What was heard while a question waited has taken its place.
        assert 1 <= passed <= len(asked)
        assert set(asked) == {21}
        assert set(answered) == {42}
        assert bag["/news"].type == "std_msgs/msg/String"
        assert bag["/clock"].count == 1


def test_replay_publishes_what_was_recorded(
    tmp_path: Path, pipeline: Finished, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    command = [sys.executable, "-m", "neuros.cli", "replay", str(pipeline.run_folder)]
    with choose_domain(None, {}, False) as domain, RosProgram(domain_id=domain.id) as program:
        totals: list[Float64] = []
        program.node.create_subscription(
            Float64, "/neuros/relay/total/sink/total/data", totals.append, 1000
        )
        numbers = program.listen(NUMBER, "std_msgs/msg/Int32")
        options = ["-t", "relay.total", "--rate", "2", "--delay", "0", "-w", "1"]
        options += ["-d", str(domain.id)]
        with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as replay:
            program.spin_until(lambda: len(totals) == 200)
            output, _ = replay.communicate(timeout=TIMEOUT_S)
    assert replay.returncode == 0
    assert output == "200 packets on 1 topics\n"
    with neuros.bag.open(pipeline.run_folder) as bag:
        assert [m.data for m in totals] == bag["relay.total"].array()["data"].tolist()
    assert numbers == []


# ------------------------------------------------------------------ what to record


def test_only_what_is_named_is_recorded(tmp_path: Path) -> None:
    finished = launch(
        PROJECTS / "pipeline",
        *("-t", "source.*", "--exclude", "source.number -> l*"),
        cwd=tmp_path,
        timeout_s=TIMEOUT_S,
    )
    assert finished.exit_code == 0, finished.output
    found = {t["connection"]: t["recorded"] for t in recorded(finished).values()}
    assert found == {
        "source.number -> relay.number": 200,
        "source.number -> unlimited.number": 200,
        "source.series -> relay.series": 200,
    }
    with neuros.bag.open(finished.run_folder) as bag:
        assert bag["source.series"].count == 200


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("-t", "source.nmber"), "the project has no such topic, connection or output"),
        (("-r", "-t", "/neuros/a/b/c/d/data"), "the project has no such topic"),
        (("-r", "--exclude", "source.nmber"), "--exclude source.nmber: the project has no such"),
        (("--exclude", "/clock"), "--exclude: nothing is recorded; add -r"),
    ],
)
def test_what_cannot_be_recorded_is_said_before_the_start(
    options: tuple[str, ...], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(["launch", str(PROJECTS / "pipeline"), "-o", str(run), *options]) == 2
    assert text in capsys.readouterr().err
    assert not run.exists()


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A plugin puts a file where the spool of its node would go, and a topic has no publisher."""
    folder = tmp_path_factory.mktemp("troubled")
    project = folder / "project"
    shutil.copytree(PROJECTS / "pipeline", project)
    with (project / "relay.py").open("a") as relay:
        relay.write("import os, pathlib\n")
        relay.write("pathlib.Path(os.environ['NEUROS_RUN_DIR'], 'spool').touch()\n")
    return launch(project, "-r", "-t", "/nobody", cwd=folder, timeout_s=TIMEOUT_S)


def test_a_topic_that_nobody_publishes_is_said_and_the_run_goes_on(troubled: Finished) -> None:
    assert troubled.exit_code == 4
    assert "/nobody is not recorded: nobody published it" in troubled.output
    assert recorded(troubled)[NUMBER]["recorded"] == 200


def test_a_spool_that_cannot_be_written_ends_no_experiment(troubled: Finished) -> None:
    assert troubled.exit_code == 4
    assert "its packets are not recorded from now on" in troubled.output
    assert "200 of 200 packets of /neuros/relay/total/sink/total/data are not" in troubled.output
    assert recorded(troubled)[NUMBER]["recorded"] == 200
    assert troubled.connection("relay.total -> sink.total")["consumed"] == 200


TALK = """
import resource
from neuros.hooks import neuros_initialise, neuros_tick

@neuros_initialise()
def start(node):
    node.set_user_data(0)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))

@neuros_tick(seconds=0.005, outputs="word")
def say(node):
    node.set_user_data(node.get_user_data() + 1)
    if node.get_user_data() == 50:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    if node.get_user_data() == 100:
        node.shutdown("all is said")
    word = node.make_packet("word")
    word.data = "x" * 10_000
    return word
"""


def test_packets_of_an_external_topic_that_are_not_recorded_are_said(tmp_path: Path) -> None:
    word = {"name": "word", "type": "std_msgs/msg/String", "external_topic": "/word"}
    talk = {"name": "talk", "container": "neuros_python", "plugin": "talk.py", "outputs": [word]}
    (tmp_path / "talk.py").write_text(TALK)
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [talk]}))
    run = launch(tmp_path, "-r", "-t", "/word", cwd=tmp_path, timeout_s=TIMEOUT_S)
    assert run.exit_code == 4
    assert run.said("neuros")[-1].startswith("node 'talk': its packets are not recorded to the end")
    assert 0 < recorded(run)["/word"]["recorded"] < 100


# ------------------------------------------------------------------ SIGKILL


@pytest.fixture
def endless(tmp_path: Path) -> Iterator[tuple[Running, Path]]:
    """A run that goes on and on, with packets in its bag."""
    run = tmp_path / "run"
    with start(
        PROJECTS / "pipeline",
        *("-r", "-o", str(run), "--set", "nodes.source.environment.COUNT=1000000"),
        cwd=tmp_path,
    ) as running:
        wait_until(lambda: flushed(run).total() > 100)
        yield running, run


def consecutive(run: Path) -> int:
    """The numbers that source has sent to relay are all there up to this one."""
    with neuros.bag.open(run) as bag:
        numbers = bag["source.number -> relay.number"].array()["data"]
    assert numbers.tolist() == list(range(1, len(numbers) + 1))
    return len(numbers)


def test_a_recorder_that_is_killed_is_made_up_for_at_the_end(
    endless: tuple[Running, Path],
) -> None:
    running, run = endless
    (recorder,) = [pid for pid, command in processes_of(run).items() if " recorder " in command]
    os.kill(recorder, signal.SIGKILL)
    wait_until(lambda: not is_alive(recorder))
    before = consecutive(run)  # and the bag can be read meanwhile
    running.signal(signal.SIGINT)
    finished = running.finish(TIMEOUT_S)
    assert finished.exit_code == 130, finished.output
    assert finished.record["recording"]["problems"] == []
    assert consecutive(run) > before


def test_a_launcher_that_is_killed_leaves_a_complete_bag(endless: tuple[Running, Path]) -> None:
    running, run = endless
    processes = processes_of(run)
    os.kill(running.process.pid, signal.SIGKILL)
    wait_until(lambda: not any(map(is_alive, processes)))
    with Reader(run / "bag") as reader:
        assert reader.message_count > 100
    assert consecutive(run) >= 20


def test_everything_killed_at_once_leaves_the_packets_up_to_the_last_flush(
    endless: tuple[Running, Path],
) -> None:
    running, run = endless
    os.kill(running.process.pid, signal.SIGSTOP)  # so that it cannot see the others go
    processes = processes_of(run)
    for pid in sorted(processes, key=lambda pid: " recorder " not in processes[pid]):
        os.kill(pid, signal.SIGKILL)
    os.kill(running.process.pid, signal.SIGKILL)
    wait_until(lambda: not any(map(is_alive, processes)))
    count = flushed(run).total()
    assert count > 100
    assert main(["bag", "repair", str(run)]) == 0
    assert consecutive(run) * 7 > count // 2
    with Reader(run / "bag") as reader:
        assert reader.message_count >= count  # with what was on its way to it


@pytest.mark.acceptance
@pytest.mark.parametrize("back_end", BACKENDS)
@pytest.mark.parametrize("name", ["project", "strict"])
def test_whiskeye_is_recorded_whole(name: str, back_end: str, tmp_path: Path) -> None:
    finished = launch(
        EXAMPLES / "4_neurorobotics" / "whiskeye" / f"{name}.json",
        *("-r", "--duration", "10sim", "--backend", back_end),
        cwd=tmp_path,
        timeout_s=120.0,
        NEUROS_GUI="0",
    )
    assert finished.exit_code == 0, finished.output
    sent = {c["connection"]: c["sent"] for c in finished.record["connections"]}
    assert {t["connection"]: t["recorded"] for t in recorded(finished).values()} == sent
    with neuros.bag.open(finished.run_folder) as bag:
        simulated_s = (bag["robot.imu"].array()["publish_time_ns"] / 1e9).tolist()
    assert simulated_s == sorted(simulated_s)
    assert simulated_s[-1] == pytest.approx(10.0, abs=0.1)
