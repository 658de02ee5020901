"""From spools to a bag that every reader of bags opens."""

from __future__ import annotations

import os
import resource
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recordings import ANSWER, NUMBER, answer, fail, number, plan, record, spool
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

import neuros.bag
from neuros.errors import EnvironmentFault
from neuros.recording import recorder as recording
from neuros.recording.recorder import Arrived, Recorder, repair
from neuros.recording.recording_plan import RecordedStream, RecordingPlan, Topic, load_plan
from neuros.recording.spool import NO_TIME, SpoolWriter
from neuros.recording.storages import Stored
from neuros.recording.stored import StoredBag


def bag_file(run: Path) -> Path:
    return run / "bag" / "bag.mcap"


def counts_after_repair(run: Path) -> dict[str, int]:
    repaired = repair(run, fail)
    assert repaired is not None
    assert repaired.changed == 0
    return repaired.counts


def test_a_packet_for_two_connections_is_kept_once_and_recorded_on_both(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(7))])
    recorder = record(tmp_path, plan())
    assert recorder.counts() == {
        "/neuros/a/number/b/number/data": 1,
        "/neuros/a/number/c/number/data": 1,
        "/answer": 0,
    }


def test_packets_of_all_nodes_are_in_the_order_of_their_wall_time(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1)), (30, None, number(3))])
    spool(tmp_path, "b", [(20, None, answer()), (40, None, answer())])
    record(tmp_path, plan())
    times = [message.log_ns for message in StoredBag(tmp_path / "bag").messages()]
    assert times == [10, 10, 20, 30, 30, 40]


def test_publish_time_is_simulated_time_where_a_node_owns_it(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, 500, number(1)), (30, 600, number(3))])
    spool(tmp_path, "b", [(5, None, answer()), (20, None, answer()), (40, None, answer())])
    record(tmp_path, plan(time_owner="a"))
    times = {(m.topic, m.log_ns): m.publish_ns for m in StoredBag(tmp_path / "bag").messages()}
    assert times[NUMBER.name, 10] == 500
    assert [times[ANSWER.name, wall_ns] for wall_ns in (5, 20, 40)] == [0, 500, 600]


def test_in_virtual_time_packets_that_come_late_have_the_simulated_time_of_their_moment(
    tmp_path: Path,
) -> None:
    what = replace(plan(time_owner="a"), is_virtual=True)
    what.save(tmp_path)
    recorder = Recorder(what, tmp_path, fail)
    spool(tmp_path, "a", [(10, 500, number(1)), (30, 600, number(3)), (50, 700, number(5))])
    while recorder.poll():
        """Read what is there."""
    spool(tmp_path, "b", [(5, None, answer()), (10, None, answer()), (40, None, answer())])
    recorder.complete()
    times = {(m.topic, m.log_ns): m.publish_ns for m in StoredBag(tmp_path / "bag").messages()}
    assert [times[ANSWER.name, time_ns] for time_ns in (5, 10, 40)] == [0, 500, 600]


def test_in_virtual_time_a_packet_waits_for_the_node_that_owns_simulated_time(
    tmp_path: Path,
) -> None:
    what = replace(plan(time_owner="a", flush_interval=0.0), is_virtual=True)
    what.save(tmp_path)
    recorder = Recorder(what, tmp_path, fail)
    spool(tmp_path, "b", [(20, None, answer())])
    recorder.poll()
    assert recorder.counts()[ANSWER.name] == 0
    spool(tmp_path, "a", [(10, 500, number(1)), (30, 600, number(3))])
    recorder.poll()
    assert recorder.counts()[ANSWER.name] == 1
    recorder.complete()
    times = {m.topic: m.publish_ns for m in StoredBag(tmp_path / "bag").messages()}
    assert times[ANSWER.name] == 500


def test_in_virtual_time_a_packet_of_another_program_has_the_time_of_the_run(
    tmp_path: Path,
) -> None:
    arrived: SimpleQueue[Arrived] = SimpleQueue()
    what = replace(plan(), is_virtual=True)
    what.save(tmp_path)
    recorder = Recorder(what, tmp_path, fail, arrived=arrived)
    spool(tmp_path, "a", [(10, None, number(1))])
    recorder.poll()
    arrived.put((Topic("/other", "std_msgs/msg/Int32"), time.time_ns(), number(2)))
    recorder.complete()
    assert {m.log_ns for m in StoredBag(tmp_path / "bag").messages()} == {10}


def test_publish_time_is_wall_time_where_nobody_owns_time(tmp_path: Path) -> None:
    spool(tmp_path, "b", [(20, None, answer())])
    record(tmp_path, plan())
    assert next(StoredBag(tmp_path / "bag").messages()) == Stored("/answer", 20, 20, answer())


def test_rosbags_reads_types_quality_of_service_and_custom_data(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(-3))])
    record(tmp_path, plan())
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / "bag") as reader:
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
        read = [
            (c.topic, at, store.deserialize_cdr(data, c.msgtype).data)
            for c, at, data in reader.messages()
        ]
        digests = {c.digest for c in reader.connections if c.msgtype == NUMBER.type}
    assert offered[NUMBER.name].reliability.name == "RELIABLE"
    assert offered["/neuros/a/number/c/number/data"].reliability.name == "BEST_EFFORT"
    assert read == [
        ("/neuros/a/number/b/number/data", 10, -3),
        ("/neuros/a/number/c/number/data", 10, -3),
    ]
    assert digests == {store.hash_rihs01(NUMBER.type)}
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    assert metadata["rosbag2_bagfile_information"]["custom_data"] == {"run_id": "0123"}


def test_mcap_reads_index_and_both_times(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, 500, number(1)), (30, 600, number(3))])
    record(tmp_path, plan(time_owner="a"))
    with bag_file(tmp_path).open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 4
        found = [(m.log_time, m.publish_time, m.sequence) for _, _, m in reader.iter_messages()]
    assert found == [(10, 500, 1), (10, 500, 1), (30, 600, 2), (30, 600, 2)]


def test_metadata_keep_every_letter(tmp_path: Path) -> None:
    text = 'Größe 大きさ 🤖: "a\\b"\n- c\t#'
    recorder = Recorder(replace(plan(), custom={"project": text}), tmp_path, fail)
    recorder.complete()
    with Reader(tmp_path / "bag") as reader:
        assert reader.storage.metadata.custom == {"project": text}


def test_mcap_ros2_support_decodes_the_messages(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1)), (30, None, number(3))])
    record(tmp_path, plan())
    with bag_file(tmp_path).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(topics=[NUMBER.name])
        assert [each.decoded_message.data for each in decoded] == [1, 3]


def test_a_bag_that_is_still_written_has_the_packets_up_to_the_last_flush(tmp_path: Path) -> None:
    now_s, what = 0.0, plan(flush_interval=2.0)
    what.save(tmp_path)
    recorder = Recorder(what, tmp_path, fail, clock=lambda: now_s)
    sender = SpoolWriter(tmp_path / "a", ())
    found = []
    for now_s in range(6):
        sender.append(10 + now_s, NO_TIME, 0, number(now_s))
        recorder.poll()
        with neuros.bag.open(tmp_path) as bag:
            found.append([*bag[NUMBER.name].array()["data"]] if bag.topics else [])
            assert bag.custom == {"run_id": "0123"}
    sender.close()
    recorder.abandon()
    assert found == [[], [], [0, 1, 2], [0, 1, 2], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4]]


def test_spools_are_gone_when_their_packets_are_in_the_bag(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1))])
    record(tmp_path, plan())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "bag", "recording.json"]
    assert list((tmp_path / "a").iterdir()) == []


def test_a_type_without_definition_is_said_and_the_others_are_recorded(tmp_path: Path) -> None:
    what = RecordingPlan(
        topics=(Topic("/odd", "odd_msgs/msg/Odd"), ANSWER),
        streams={
            "b": (RecordedStream("sent", "odd", (0,)), RecordedStream("sent", "answer", (1,)))
        },
    )
    spool(tmp_path, "b", [(10, None, b"whatever")])
    complaints: list[str] = []
    recorder = Recorder(what, tmp_path, complaints.append)
    recorder.complete()
    (complaint,) = complaints
    assert complaint.startswith(
        "/odd is not recorded: the definition of message type odd_msgs/msg/Odd"
    )
    assert recorder.counts() == {"/odd": 0, "/answer": 0}


def test_packets_do_not_pile_up_where_somebody_sets_the_clock_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(plan(), tmp_path, fail)
    now_ns = time.time_ns()
    spool(tmp_path, "b", [(now_ns - 50_000_000, None, answer())])
    monkeypatch.setattr(time, "time_ns", lambda: now_ns - 3600 * 10**9)
    recorder.poll()
    assert recorder.counts()[ANSWER.name] == 1
    recorder.abandon()


def test_a_spool_stays_while_a_packet_of_it_is_held_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "_MOST_BYTES", 72)  # two packets of a node at a time
    recorder = Recorder(plan(flush_interval=0.0), tmp_path, fail)
    recorder.poll()
    spool(tmp_path, "a", [(wall_ns, None, number(0)) for wall_ns in (110, 150, 160, 170, 180)])
    late = SpoolWriter(tmp_path / "b", (), file_bytes=1)
    for wall_ns in (100, 200, 300):
        late.append(wall_ns, NO_TIME, 0, answer())
    late.close()
    recorder.poll()
    recorder.poll()  # a has more to tell up to 180, so 200 has to wait
    assert recorder.counts()[ANSWER.name] == 1
    assert sorted(os.listdir(tmp_path / "b" / "spool")) == ["00000001", "00000002"]
    recorder.abandon()


def test_a_full_disk_leaves_the_packets_up_to_the_last_flush(tmp_path: Path) -> None:
    plan().save(tmp_path)
    recorder = Recorder(plan(), tmp_path, fail)
    recorder.bag.put(1, 10, 10, number(1))
    recorder.bag.flush()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    room = bag_file(tmp_path).stat().st_size + 100
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
        recorder.bag.put(1, 20, 20, os.urandom(50_000))
        with pytest.raises(OSError, match="File too large"):
            recorder.bag.flush()
        recorder.abandon()
        with neuros.bag.open(tmp_path) as bag:  # there is no room to complete it
            assert bag[NUMBER.name].array()["log_time_ns"].tolist() == [10]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert counts_after_repair(tmp_path)[NUMBER.name] == 1


# ---------------------------------------------------------------------- what was cut off


def test_a_complete_bag_needs_no_repair(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1))])
    record(tmp_path, plan())
    assert repair(tmp_path, fail) is None


@settings(deadline=None, max_examples=25)
@given(
    numbers=st.lists(st.integers(-9, 9), min_size=1, max_size=30),
    moved=st.integers(0, 30),
    kept=st.floats(0, 1),
)
def test_repair_brings_together_the_file_and_the_spools_without_doubles(
    tmp_path_factory: pytest.TempPathFactory,
    numbers: list[int],
    moved: int,
    kept: float,
) -> None:
    run = tmp_path_factory.mktemp("run")
    plan().save(run)
    packets = [(10 * k, None, number(value)) for k, value in enumerate(numbers, start=1)]
    spool(run, "a", packets)
    recorder = Recorder(plan(), run, fail)
    for wall_ns, _, data in packets[:moved]:
        for topic in (1, 2):
            recorder.bag.put(topic, wall_ns, wall_ns, data)
    recorder.bag.flush()
    recorder.abandon()
    # Cut off anywhere: the spools still have it all.
    os.truncate(bag_file(run), int(kept * bag_file(run).stat().st_size))
    counts = counts_after_repair(run)
    assert counts == {NUMBER.name: len(numbers), plan().topics[1].name: len(numbers), "/answer": 0}
    with Reader(run / "bag") as reader:
        found = [data for c, _, data in reader.messages() if c.topic == NUMBER.name]
    assert found == [data for _, _, data in packets]
    assert repair(run, fail) is None


def test_a_truncated_bag_keeps_what_is_left_of_it(tmp_path: Path) -> None:
    recorder = Recorder(plan(), tmp_path, fail)
    plan().save(tmp_path)
    sizes = []
    for k in range(3):
        recorder.bag.put(1, k + 1, k + 1, number(k))
        recorder.bag.flush()
        sizes.append(bag_file(tmp_path).stat().st_size)
    recorder.abandon()
    os.truncate(bag_file(tmp_path), sizes[0])
    counts = counts_after_repair(tmp_path)
    assert counts[NUMBER.name] >= 1
    with Reader(tmp_path / "bag") as reader:
        assert len(list(reader.messages())) == counts[NUMBER.name]


def test_a_repair_that_was_cut_off_is_repeated(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1))])
    record(tmp_path, plan())
    (tmp_path / "bag").rename(tmp_path / "bag.damaged")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag.mcap").write_bytes(b"half")
    counts = counts_after_repair(tmp_path)
    assert counts[NUMBER.name] == 1
    assert not (tmp_path / "bag.damaged").exists()


def test_a_bag_larger_than_memory_can_be_repaired(tmp_path: Path) -> None:
    recorder = Recorder(plan(), tmp_path, fail)
    plan().save(tmp_path)
    for k in range(40):
        recorder.bag.put(1, k + 1, k + 1, bytes(1 << 20))
    recorder.bag.flush()
    recorder.abandon()
    tracemalloc.start()
    try:
        counts = counts_after_repair(tmp_path)
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert counts[NUMBER.name] == 40
    assert most_bytes < 20 << 20


def test_a_plan_survives_its_file(tmp_path: Path) -> None:
    plan(time_owner="a").save(tmp_path)
    assert load_plan(tmp_path) == plan(time_owner="a")


def test_a_record_that_claims_gigabytes_is_told_and_what_came_before_is_in_the_bag(
    tmp_path: Path,
) -> None:
    spool(tmp_path, "a", [(10, None, number(7))])
    (file,) = (tmp_path / "a" / "spool").iterdir()
    with file.open("ab") as more:
        more.write(b"\xff" * 4 + bytes(20))
    os.truncate(file, 4 << 30)
    told: list[str] = []
    recorder = Recorder(plan(), tmp_path, told.append)
    recorder.complete()
    recorder.clean_up()
    assert recorder.counts()["/neuros/a/number/b/number/data"] == 1
    assert told == [
        f"{tmp_path}/a/spool is damaged: packets in it are not recorded, and it is kept"
    ]
    assert file.exists()


def test_packets_that_no_node_can_have_kept_are_told_once_and_stay_in_the_spool(
    tmp_path: Path,
) -> None:
    spool(tmp_path, "a", [(10, None, number(7))])
    strange = SpoolWriter(tmp_path / "b", ())
    for wall_ns, sim_ns, stream in ((20, NO_TIME, 1000), (-1, NO_TIME, 0), (20, -2, 0)):
        strange.append(wall_ns, sim_ns, stream, b"")
    strange.close()
    told: list[str] = []
    recorder = Recorder(plan(), tmp_path, told.append)
    recorder.complete()
    recorder.clean_up()
    assert recorder.counts()["/neuros/a/number/b/number/data"] == 1
    assert told == [
        f"{tmp_path}/b/spool is damaged: packets in it are not recorded, and it is kept"
    ]
    assert [path.name for path in (tmp_path / "b/spool").iterdir()] == ["00000000"]
    assert not (tmp_path / "a/spool").exists()


def test_packets_that_no_node_sees_are_recorded_and_survive_a_killed_recorder(
    tmp_path: Path,
) -> None:
    heard, arrived = Topic("/heard", NUMBER.type), SimpleQueue[Arrived]()
    plan().save(tmp_path)
    recorder = Recorder(plan(), tmp_path, fail, arrived=arrived)
    arrived.put((heard, 5, number(5)))
    recorder.poll()
    assert load_plan(tmp_path).topics == (*plan().topics, heard)
    recorder.bag.flush()
    recorder.abandon()
    spool(tmp_path, "a", [(10, None, number(7))])
    counts = counts_after_repair(tmp_path)
    assert counts["/heard"] == 1
    assert counts["/neuros/a/number/b/number/data"] == 1


@pytest.mark.parametrize("name", ["std_msgs//msg/Int32", "std_msgs/msg/../msg/Int32", "/", ""])
def test_a_name_that_is_no_type_s_is_no_topic_of_the_bag(tmp_path: Path, name: str) -> None:
    told: list[str] = []
    recorder = Recorder(plan(), tmp_path, told.append)
    assert recorder.number_of(Topic("/heard", name)) is None
    recorder.complete()
    assert told == [
        f"/heard is not recorded: the definition of message type {name} (share/{name}.msg) is not"
        " installed here"
    ]


@pytest.mark.parametrize("name", ["²", "1", "000000001", "x"])
def test_other_files_in_a_spool_are_left_alone(tmp_path: Path, name: str) -> None:
    spool(tmp_path, "a", [(10, None, number(7))])
    (tmp_path / "a/spool" / name).write_text("strange")
    recorder = record(tmp_path, plan())
    assert recorder.counts()["/neuros/a/number/b/number/data"] == 1
    assert [path.name for path in (tmp_path / "a/spool").iterdir()] == [name]
    assert repair(tmp_path, fail) is None


@pytest.mark.parametrize("name", ["bag", "bag.damaged"])
def test_no_bag_is_repaired_through_a_link(tmp_path: Path, name: str) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    elsewhere.mkdir()
    run.mkdir()
    plan().save(run)
    spool(run, "a", [(10, None, number(7))])
    (run / name).symlink_to(elsewhere)
    with pytest.raises(EnvironmentFault, match=f"run/{name}: it is a link: .* left as it is"):
        repair(run, fail)
    assert (run / name).is_symlink()
    (run / name).unlink()
    assert counts_after_repair(run)["/neuros/a/number/b/number/data"] == 1
    assert not [*elsewhere.iterdir()]
