"""What was recorded, as arrays: the same numbers as rosbags reads one by one."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import ANSWER, NUMBER, answer, number, plan, record, spool
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import neuros.bag
from neuros.bag import Bag
from neuros.cli.main import main
from neuros.errors import EnvironmentFault, UsageError
from neuros.recording.columns import columns_of
from neuros.registry import Registry

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types

floats = st.floats(width=32, allow_nan=False)
texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=6)
stamps = st.builds(TYPES["builtin_interfaces/msg/Time"], st.integers(0, 9), st.integers(0, 9))
headers = st.builds(TYPES["std_msgs/msg/Header"], stamps, texts)


def doubles(sizes: st.SearchStrategy[int]) -> st.SearchStrategy[Any]:
    return sizes.flatmap(lambda n: st.lists(floats, min_size=n, max_size=n)).map(
        lambda values: np.array(values, np.float64)
    )


MESSAGES = {
    "std_msgs/msg/Int32": st.builds(TYPES["std_msgs/msg/Int32"], st.integers(-(2**31), 2**31 - 1)),
    "std_msgs/msg/Bool": st.builds(TYPES["std_msgs/msg/Bool"], st.booleans()),
    "std_msgs/msg/Empty": st.builds(TYPES["std_msgs/msg/Empty"]),
    "std_msgs/msg/String": st.builds(TYPES["std_msgs/msg/String"], texts),
    "geometry_msgs/msg/Vector3Stamped": st.builds(
        TYPES["geometry_msgs/msg/Vector3Stamped"],
        headers,
        st.builds(TYPES["geometry_msgs/msg/Vector3"], floats, floats, floats),
    ),
    "sensor_msgs/msg/JointState": st.builds(
        TYPES["sensor_msgs/msg/JointState"],
        headers,
        st.lists(texts, max_size=2),
        doubles(st.integers(0, 3)),
        doubles(st.just(2)),
        doubles(st.just(0)),
    ),
    "sensor_msgs/msg/MagneticField": st.builds(
        TYPES["sensor_msgs/msg/MagneticField"],
        headers,
        st.builds(TYPES["geometry_msgs/msg/Vector3"], floats, floats, floats),
        doubles(st.just(9)),
    ),
}
Sent = tuple[str, list[Any]]
sent = st.sampled_from(sorted(MESSAGES)).flatmap(
    lambda name: st.tuples(st.just(name), st.lists(MESSAGES[name], min_size=1, max_size=8))
)


def field(message: Any, name: str) -> Any:
    for part in name.split("."):
        message = getattr(message, part)
    return message


@settings(deadline=None)
@given(sent)
def test_columns_hold_what_rosbags_reads(messages: Sent) -> None:
    name, expected = messages
    packets = [bytes(STORE.serialize_cdr(message, name)) for message in expected]
    columns = columns_of(packets, name, STORE)
    assert columns or name == "std_msgs/msg/Empty"
    for column_name, column in columns.items():
        assert len(column) == len(expected)
        for message, found in zip(expected, column, strict=True):
            wanted = field(message, column_name)
            assert np.array_equal(np.asarray(wanted), np.asarray(found)), column_name


def test_arrays_of_one_length_have_a_dimension_and_others_are_objects() -> None:
    name = "std_msgs/msg/Float32MultiArray"
    layout = TYPES["std_msgs/msg/MultiArrayLayout"]([], 0)

    def packed(*lengths: int) -> list[bytes]:
        made = (TYPES[name](layout, np.arange(n, dtype=np.float32)) for n in lengths)
        return [bytes(STORE.serialize_cdr(message, name)) for message in made]

    assert columns_of(packed(3, 3), name, STORE)["data"].shape == (2, 3)
    ragged = columns_of(packed(1, 3), name, STORE)["data"]
    assert ragged.dtype == object
    assert [value.tolist() for value in ragged] == [[0.0], [0.0, 1.0, 2.0]]


def test_the_numbers_of_a_multi_array_have_the_shape_of_its_layout() -> None:
    name = "std_msgs/msg/Float64MultiArray"

    def packed(*shapes: tuple[int, ...], label: str = "") -> list[bytes]:
        made = []
        for shape in shapes:
            dim = [TYPES["std_msgs/msg/MultiArrayDimension"](label, size, 1) for size in shape]
            layout = TYPES["std_msgs/msg/MultiArrayLayout"](dim, 0)
            made.append(TYPES[name](layout, np.arange(6.0)))
        return [bytes(STORE.serialize_cdr(message, name)) for message in made]

    for label in ("", "rows", "columns"):
        columns = columns_of(packed((2, 3), (2, 3), label=label), name, STORE)
        assert columns["data"].tolist() == [[[0, 1, 2], [3, 4, 5]]] * 2
        assert columns["layout.dim"].tolist() == [[2, 3]] * 2
        assert columns["layout.data_offset"].tolist() == [0, 0]
    reshaped = columns_of(packed((2, 3), (3, 2), (6,)), name, STORE)["data"]
    assert [value.shape for value in reshaped] == [(2, 3), (3, 2), (6,)]
    wrong = columns_of(packed((2, 2), (2, 2)), name, STORE)["data"]
    assert wrong.shape == (2, 6)


def test_more_layouts_than_one_can_keep_are_read_all_the_same() -> None:
    name = "std_msgs/msg/String"
    texts = ["x" * k for k in range(200)]
    packets = [bytes(STORE.serialize_cdr(TYPES[name](text), name)) for text in texts]
    assert columns_of(packets, name, STORE)["data"].tolist() == texts


def test_a_run_is_opened_by_its_folder_or_its_bag(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, 5, number(1)), (30, 6, number(3))])
    record(tmp_path, plan(time_owner="a"))
    for folder in (tmp_path, tmp_path / "bag"):
        with neuros.bag.open(folder) as bag:
            array = bag["a.number -> b.n"].array()
            assert array.dtype.names == ("log_time_ns", "publish_time_ns", "data")
            assert array.tolist() == [(10, 5, 1), (30, 6, 3)]
            assert bag.custom == {"run_id": "0123"}


def test_a_bag_by_itself_is_opened(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1))])
    record(tmp_path, plan())
    (tmp_path / "bag").rename(tmp_path / "elsewhere")
    (tmp_path / "recording.json").unlink()
    with neuros.bag.open(tmp_path / "elsewhere") as bag:
        assert bag[NUMBER.name].array()["data"].tolist() == [1]


def test_without_the_extension_that_makes_frames_an_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(tmp_path, plan())
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    formats: Registry[Any] = Registry("neuros.bag_formats", "format", object)
    monkeypatch.setattr("neuros.bag.BAG_FORMATS", formats)
    said = r"format 'frame' is in the extension neuros-analysis, .* install"
    with neuros.bag.open(tmp_path) as bag, pytest.raises(UsageError, match=said):
        bag["/answer"].frame()


def test_topics_are_the_same_whichever_is_asked_for_first(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(wall, None, number(wall)) for wall in range(1, 40_001)])
    spool(tmp_path, "b", [(wall, None, answer(wall)) for wall in range(1, 9)])
    record(tmp_path, plan())
    names = [NUMBER.name, ANSWER.name]
    found = []
    for order in (names, names[::-1]):
        with neuros.bag.open(tmp_path) as bag:
            found.append({name: bag[name].raw() for name in order})
    assert found[0] == found[1]
    assert [packet.data for packet in found[0][NUMBER.name]] == list(map(number, range(1, 40_001)))
    assert [packet.data for packet in found[0][ANSWER.name]] == list(map(answer, range(1, 9)))


def test_a_topic_without_packets_is_an_empty_array(tmp_path: Path) -> None:
    record(tmp_path, plan())
    with neuros.bag.open(tmp_path) as bag:
        array = bag["/answer"].array()
        assert len(array) == 0
        assert array.dtype.names == ("log_time_ns", "publish_time_ns", "data")
        assert array["data"].dtype == np.float64
        assert bag["/answer"].count == 0


@settings(deadline=None)
@given(sent)
def test_columns_of_no_message_are_those_of_any(messages: Sent) -> None:
    name, packets = messages
    found = columns_of([bytes(STORE.serialize_cdr(each, name)) for each in packets], name, STORE)
    empty = columns_of([], name, STORE)
    assert {*empty} == {*found}
    for column_name, column in empty.items():
        assert len(column) == 0
        kinds = "iuO" if column.dtype.kind in "iu" else column.dtype.kind + "O"
        assert found[column_name].dtype.kind in kinds


def test_columns_of_no_message_of_an_intricate_type_have_its_fields() -> None:
    store = get_typestore(Stores.EMPTY)
    definition = f"string[2] names\nstd_msgs/Bool on\n{'=' * 80}\nMSG: std_msgs/Bool\nbool data"
    store.register(get_types_from_msg(definition, "a/msg/B"))
    assert [*columns_of([], "a/msg/B", store)] == ["names", "on.data"]


def test_an_output_with_several_receivers_is_any_of_its_connections(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(1)), (30, None, number(3))])
    record(tmp_path, plan())
    with neuros.bag.open(tmp_path) as bag:
        assert bag["a.number"].array()["data"].tolist() == [1, 3]


def test_a_name_that_means_no_topic_is_said(tmp_path: Path) -> None:
    record(tmp_path, plan())
    with (
        neuros.bag.open(tmp_path) as bag,
        pytest.raises(KeyError, match=r"there are a\.number -> b\.n, a\.number -> c\.n"),
    ):
        bag["nothing"]


def test_what_was_cut_off_is_completed_when_it_is_opened(tmp_path: Path) -> None:
    plan().save(tmp_path)
    spool(tmp_path, "a", [(10, None, number(1))])
    with neuros.bag.open(tmp_path) as bag:
        assert bag["a.number -> b.n"].array()["data"].tolist() == [1]
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 2


def test_what_has_gone_since_the_run_ended_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan().save(tmp_path)
    spool(tmp_path, "a", [(at, None, number(at)) for at in range(1, 40_001)])  # several chunks
    neuros.bag.open(tmp_path).close()
    topics = {NUMBER.name: {"recorded": 40_000}}
    (tmp_path / "run.json").write_text(json.dumps({"format": 2, "recording": {"topics": topics}}))
    with neuros.bag.open(tmp_path) as bag:
        assert bag.missing == {}
    assert main(["bag", "info", str(tmp_path)]) == 0
    file = tmp_path / "bag" / "bag.mcap"
    os.truncate(file, file.stat().st_size // 2)
    with pytest.warns(UserWarning, match="damaged since the run"):
        bag = neuros.bag.open(tmp_path)
    with bag:
        left = bag["a.number -> b.n"].array()["data"].tolist()
        assert bag.missing == {NUMBER.name: 40_000 - len(left)}
    assert left == [*range(1, len(left) + 1)]
    assert left
    capsys.readouterr()
    assert main(["bag", "info", str(tmp_path)]) == 4
    shown = capsys.readouterr()
    assert NUMBER.name in shown.out
    assert f"missing: {40_000 - len(left)} of {NUMBER.name}" in shown.err


def test_a_run_that_was_not_recorded_and_one_of_another_version_are_said(tmp_path: Path) -> None:
    (tmp_path / "run.json").touch()
    with pytest.raises(UsageError, match="was not recorded"):
        neuros.bag.open(tmp_path)
    (tmp_path / "recording.json").write_text('{"version": 99}')
    with pytest.raises(UsageError, match="version 99, and this NeuROS reads version 1"):
        neuros.bag.open(tmp_path)
    (tmp_path / "recording.json").write_text('{"version": 1')
    with pytest.raises(EnvironmentFault, match="is damaged"):
        neuros.bag.open(tmp_path)


def test_metadata_that_are_none_are_written_anew(tmp_path: Path) -> None:
    record(tmp_path, plan())
    (tmp_path / "bag" / "metadata.yaml").write_text("nonsense: 1")
    with pytest.raises(EnvironmentFault, match="cannot be read"):
        Bag(tmp_path / "bag", {})
    with neuros.bag.open(tmp_path) as bag:
        assert NUMBER.name in bag.topics


def lay_out(folder: Path, *files: str) -> None:
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("[")


@pytest.mark.parametrize(
    ("path", "said", "exit_code"),
    [
        ("nowhere", "nowhere: there is no such file or folder", 2),
        ("loose/a.mcap", "loose/a.mcap is no bag: it begins neither as MCAP nor as SQLite", 2),
        ("loose", "loose/a.mcap is no bag: it begins neither as MCAP nor as SQLite", 2),
        ("empty", "empty is the folder of neither a run nor a bag: it has no run.json, no meta", 2),
        ("run", "run was not recorded: launch the project with -r, or name topics with -t", 2),
        ("killed", "killed was not recorded: launch the project with -r, or name topics", 2),
        ("torn", "torn cannot be read: it is damaged (metadata.yaml is no YAML: ", 4),
    ],
)
def test_a_path_without_a_bag_gets_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    path: str,
    said: str,
    exit_code: int,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    lay_out(tmp_path, "loose/a.mcap", "run/run.json", "killed/a/node.json", "torn/metadata.yaml")
    assert main(["bag", "info", path]) == exit_code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"neuros: {said}")
