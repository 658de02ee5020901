"""Bags that other programs have written, in every storage and compression of rosbag2 and MCAP."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import neuros.bag
from neuros.cli.main import main
from neuros.errors import EnvironmentFault

STORE = get_typestore(Stores.ROS2_JAZZY)
KIND = "std_msgs/msg/Float64"
TIMES = [1_000_000_000, 2_000_000_000, 3_000_000_000]
VALUES = [0.0, 0.5, 1.0]
PACKETS = [bytes(STORE.serialize_cdr(STORE.types[KIND](value), KIND)) for value in VALUES]


def by_rosbags(storage: StoragePlugin, mode: CompressionMode) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        writer = Writer(folder, version=9, storage_plugin=storage)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/height", KIND, typestore=STORE)
            for time_ns, packet in zip(TIMES, PACKETS, strict=True):
                writer.write(connection, time_ns, packet)

    return write


TABLES = """
    CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
      serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
    CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
      timestamp INTEGER NOT NULL, data BLOB NOT NULL);
"""
DEFINITIONS = """
    CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
    INSERT INTO schema VALUES(4, 'jazzy');
    CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,
      encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,
      type_description_hash TEXT NOT NULL);
"""
Topics = Mapping[str, tuple[str, list[bytes]]]
HEIGHT: Topics = {"/height": (KIND, PACKETS)}


def sqlite_file(
    path: Path,
    topics: Topics = HEIGHT,
    definitions: Mapping[str, tuple[str, str]] | None = None,
) -> Path:
    """A file as ROS 2 writes it: up to Humble without definitions."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        file.executescript(TABLES)
        for number, (name, (kind, packets)) in enumerate(topics.items(), 1):
            file.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", [number, name, kind])
            insert = f"INSERT INTO messages(topic_id, timestamp, data) VALUES({number}, ?, ?)"
            file.executemany(insert, zip(TIMES, packets, strict=False))
        if definitions is not None:
            file.executescript(DEFINITIONS)
            insert = "INSERT INTO message_definitions VALUES(NULL, ?, ?, ?, '')"
            rows = [(kind, *definition) for kind, definition in definitions.items()]
            file.executemany(insert, rows)
    return path


def metadata(folder: Path, version: int, files: list[str], topics: Topics = HEIGHT) -> Path:
    """``metadata.yaml``; a file is named with its folder, as Dashing did."""
    rows = [
        {
            "topic_metadata": {
                "name": name,
                "type": kind,
                "serialization_format": "cdr",
                **({"offered_qos_profiles": ""} if version > 3 else {}),
            },
            "message_count": len(packets),
        }
        for name, (kind, packets) in topics.items()
    ]
    information = {
        "version": version,
        "storage_identifier": "sqlite3",
        "relative_file_paths": files,
        "duration": {"nanoseconds": TIMES[-1] - TIMES[0]},
        "starting_time": {"nanoseconds_since_epoch": TIMES[0]},
        "message_count": sum(row["message_count"] for row in rows),
        "topics_with_message_count": rows,
    }
    if version > 2:
        information |= {"compression_format": "", "compression_mode": ""}
    text = json.dumps({"rosbag2_bagfile_information": information})
    (folder / "metadata.yaml").write_text(text)
    return folder


def by_ros(version: int, topics: Topics = HEIGHT) -> Callable[[Path], None]:
    """An SQLite file without definitions of its types, as ROS 2 writes it up to Humble."""

    def write(folder: Path) -> None:
        sqlite_file(folder / "bag_0.db3", topics)
        metadata(folder, version, [f"{folder.name}/bag_0.db3"], topics)

    return write


def mcap_file(path: Path, **options: object) -> Path:
    """A file of a program that knows nothing of rosbag2."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = McapWriter(file, **options)  # type: ignore[arg-type]
        writer.start("", "somebody")
        schema = writer.register_schema(KIND, "ros2msg", b"float64 data")
        channel = writer.register_channel("/height", "cdr", schema)
        for time_ns, packet in zip(TIMES, PACKETS, strict=True):
            writer.add_message(channel, time_ns, packet, time_ns)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "write",
    [
        *(pytest.param(by_ros(version), id=f"version {version}") for version in (1, 2, 3, 4, 5)),
        *(
            pytest.param(by_rosbags(storage, mode), id=f"{storage.name}-{mode.name}")
            for storage in StoragePlugin
            for mode in CompressionMode
            if (storage, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)
        ),
    ],
)
def test_a_bag_of_another_program_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], write: Callable[[Path], None]
) -> None:
    folder = tmp_path / "foreign"
    write(folder)
    check(folder)
    (file,) = (each for each in folder.iterdir() if each.name != "metadata.yaml")
    check(file)
    (folder / "metadata.yaml").unlink()
    check(folder)
    assert main(["bag", "info", str(folder)]) == 0
    assert "/height  std_msgs/msg/Float64  3" in capsys.readouterr().out


def check(bag_path: Path) -> None:
    """What every bag here holds; nothing of it is damaged."""
    with neuros.bag.open(bag_path) as bag:
        heights = bag["/height"].array()
        assert heights["data"].tolist() == VALUES
        assert heights["log_time_ns"].tolist() == TIMES
        assert (bag.start_ns, bag.duration_s) == (TIMES[0], 2.0)
        assert (bag["/height"].count, bag.check(), bag.notes) == (3, None, [])
        assert [message.data for message in bag["/height"]] == VALUES


class TestStorages:
    @pytest.mark.parametrize("compression", [*CompressionType])
    @pytest.mark.parametrize("chunks", [True, False])
    @pytest.mark.parametrize("summary", [True, False])
    def test_an_mcap_file_is_read_whatever_its_writer_left_out(
        self, tmp_path: Path, compression: CompressionType, chunks: bool, summary: bool
    ) -> None:
        options = {
            "compression": compression,
            "use_chunking": chunks,
            "enable_crcs": False,
            **(
                {}
                if summary
                else {
                    "index_types": IndexType.NONE,
                    "repeat_channels": False,
                    "repeat_schemas": False,
                    "use_statistics": False,
                    "use_summary_offsets": False,
                }
            ),
        }
        check(mcap_file(tmp_path / "some.mcap", **options))

    def test_packets_in_a_write_ahead_log_are_read_and_the_bag_is_left_as_it_is(
        self, tmp_path: Path
    ) -> None:
        """As a recorder leaves it that is killed, or still records."""
        copy = tmp_path / "copy"
        file = sqlite_file(tmp_path / "bag/bag_0.db3", {"/height": (KIND, PACKETS[:1])})
        with contextlib.closing(sqlite3.connect(file)) as recorder:
            recorder.execute("PRAGMA journal_mode=WAL")
            insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)"
            recorder.executemany(insert, [*zip(TIMES, PACKETS, strict=True)][1:])
            recorder.commit()
            shutil.copytree(file.parent, copy)
        before = {each.name: each.read_bytes() for each in copy.iterdir()}
        check(copy)
        assert before == {each.name: each.read_bytes() for each in copy.iterdir()}
        assert any(name.endswith("-wal") for name in before)

    def test_a_split_bag_is_one(self, tmp_path: Path) -> None:
        folder, names = tmp_path / "bag", [f"bag_{number}.db3" for number in (9, 10, 11)]
        for name, packet, time_ns in zip(names, PACKETS, TIMES, strict=True):
            file = sqlite_file(folder / name, {"/height": (KIND, [packet])})
            with contextlib.closing(sqlite3.connect(file)) as database, database:
                database.execute("UPDATE messages SET timestamp = ?", [time_ns])
        check(folder)
        check(metadata(folder, 5, names))

    def test_topics_of_one_name_and_several_types_are_two(self, tmp_path: Path) -> None:
        with (tmp_path / "a.mcap").open("wb") as file:
            writer = McapWriter(file)
            writer.start()
            for kind, text in ((KIND, b"float64 data"), ("std_msgs/msg/Int8", b"int8 data")):
                schema = writer.register_schema(kind, "ros2msg", text)
                channel = writer.register_channel("/x", "cdr", schema)
                writer.add_message(channel, 1, b"\0\1\0\0" + bytes(8), 1)
            writer.finish()
        with neuros.bag.open(tmp_path / "a.mcap") as bag:
            assert [*bag.topics] == ["/x", "/x (std_msgs/msg/Int8)"]
            assert bag["/x (std_msgs/msg/Int8)"].array()["data"].tolist() == [0]

    def test_a_bag_of_ros_1_that_was_cut_off_is_damaged(self, tmp_path: Path) -> None:
        (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
        with pytest.raises(EnvironmentFault, match=r"old\.bag cannot be read: it is damaged"):
            neuros.bag.open(tmp_path / "old.bag")


class TestROS1:
    """A bag of ROS 1 is read as what ROS 2 would have recorded."""

    GAUGE = "lab_msgs/msg/Gauge"
    DEFINITION = "Header header\nfloat64[] values\ntime read_at\n"

    @pytest.fixture
    def old(self, tmp_path: Path) -> Path:
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg(self.DEFINITION, self.GAUGE))
        kinds, file = store.types, tmp_path / "old.bag"
        time = kinds["builtin_interfaces/msg/Time"]
        header = kinds["std_msgs/msg/Header"](7, time(2, 5), "lamp")
        with Ros1Writer(file) as writer:
            for topic, kind, message in (
                ("/gauge", self.GAUGE, kinds[self.GAUGE](header, np.array([1.5, 2.5]), time(3, 4))),
                ("/temperature", "sensor_msgs/msg/Temperature",
                 kinds["sensor_msgs/msg/Temperature"](header, 21.5, 0.1)),
                ("/unused", "std_msgs/msg/Int8", None),
            ):  # fmt: skip
                added = writer.add_connection(topic, kind, typestore=store)
                if message is not None:
                    writer.write(added, TIMES[0], store.serialize_ros1(message, kind))
        return file

    def test_topics_types_and_values_are_there(self, old: Path) -> None:
        with neuros.bag.open(old) as bag:
            assert {name: topic.type for name, topic in bag.topics.items()} == {
                "/gauge": self.GAUGE,
                "/temperature": "sensor_msgs/msg/Temperature",
                "/unused": "std_msgs/msg/Int8",
            }
            (gauge,) = bag["/gauge"]
            assert (gauge.header.frame_id, gauge.header.stamp.sec) == ("lamp", 2)
            assert (gauge.values.tolist(), gauge.read_at.nanosec) == ([1.5, 2.5], 4)
            assert bag["/temperature"].array()["temperature"].tolist() == [21.5]
            assert [*bag["/unused"]] == []

    def test_it_becomes_a_bag_of_ros_2(self, old: Path, tmp_path: Path) -> None:
        assert main(["bag", "info", str(old)]) == 0
        assert main(["bag", "convert", str(old), "-o", str(tmp_path / "new")]) == 0
        with AnyReader([tmp_path / "new"]) as bag:
            for connection, time_ns, data in bag.messages():
                assert time_ns == TIMES[0]
                assert bag.deserialize(data, connection.msgtype).header.frame_id == "lamp"

    def test_damage_of_it_is_named(self, old: Path) -> None:
        data = bytearray(old.read_bytes())
        at = data.index(b"lamp")
        data[at - 4 : at] = b"\xff\xff\xff\x7f"  # the length of the text
        old.write_bytes(data)
        with (
            neuros.bag.open(old) as bag,
            pytest.raises(EnvironmentFault, match=r"old\.bag is damaged"),
        ):
            bag["/gauge"].raw()


MARKER = "visualization_msgs/msg/Marker"


def marker(distribution: Stores) -> bytes:
    """A marker, which Humble gave more fields."""
    store = get_typestore(distribution)
    kinds = store.types
    none = np.zeros(0, np.uint8)
    vector = kinds["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0)
    values = {
        "header": kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](1, 2), "map"),
        "pose": kinds["geometry_msgs/msg/Pose"](
            kinds["geometry_msgs/msg/Point"](1.0, 2.0, 3.0),
            kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        ),
        "scale": vector,
        "color": kinds["std_msgs/msg/ColorRGBA"](0.1, 0.2, 0.3, 1.0),
        "lifetime": kinds["builtin_interfaces/msg/Duration"](0, 0),
        **{name: name for name in ("ns", "text", "mesh_resource", "texture_resource")},
        **dict.fromkeys(("id", "type", "action"), 7),
        **dict.fromkeys(("frame_locked", "mesh_use_embedded_materials"), False),
        **{name: [] for name in ("points", "colors", "uv_coordinates")},
    }
    if "visualization_msgs/msg/MeshFile" in kinds:
        values["texture"] = kinds["sensor_msgs/msg/CompressedImage"](values["header"], "", none)
        values["mesh_file"] = kinds["visualization_msgs/msg/MeshFile"]("", none)
    made = kinds[MARKER](*(values[name] for name, _ in store.fielddefs[MARKER][1]))
    return bytes(store.serialize_cdr(made, MARKER))


class TestTypes:
    @pytest.mark.parametrize(
        ("version", "distribution"), [(4, Stores.ROS2_FOXY), (5, Stores.ROS2_HUMBLE)]
    )
    def test_a_type_without_definition_is_that_of_its_distribution(
        self, tmp_path: Path, version: int, distribution: Stores
    ) -> None:
        by_ros(version, {"/marker": (MARKER, [marker(distribution)])})(tmp_path / "bag")
        for path in (tmp_path / "bag", tmp_path / "bag/bag_0.db3"):
            with neuros.bag.open(path) as bag:
                (row,) = bag["/marker"].array()
                assert (row["ns"], row["text"], row["id"]) == ("ns", "text", 7)

    def test_a_type_that_nobody_defines_fails_alone_and_by_name(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder, topics = tmp_path / "bag", {**HEIGHT, "/odd": ("odd_msgs/msg/Odd", PACKETS)}
        by_ros(5, topics)(folder)
        with neuros.bag.open(folder) as bag:
            assert bag["/height"].array()["data"].tolist() == VALUES
            assert [packet.data for packet in bag["/odd"].raw()] == PACKETS
            said = "/odd cannot be decoded: the bag does not define message type odd_msgs/msg/Odd"
            with pytest.raises(EnvironmentFault, match=said):
                bag["/odd"].array()
            with pytest.raises(EnvironmentFault, match=said):
                next(iter(bag["/odd"]))
        assert main(["bag", "info", str(folder)]) == 0
        out = capsys.readouterr().out
        assert f"note: {folder}: {said}" in out
        assert "damage" not in out

    def test_packets_in_another_encoding_fail_alone_and_by_name(self, tmp_path: Path) -> None:
        file = sqlite_file(tmp_path / "a.db3", {**HEIGHT, "/odd": (KIND, [b"{}"])})
        with contextlib.closing(sqlite3.connect(file)) as database, database:
            database.execute("UPDATE topics SET serialization_format='json' WHERE name='/odd'")
        with neuros.bag.open(file) as bag:
            assert bag["/height"].array()["data"].tolist() == VALUES
            with pytest.raises(EnvironmentFault, match="/odd cannot be decoded: its packets are"):
                bag["/odd"].array()

    def test_topics_that_are_not_of_ros_fail_alone(self, tmp_path: Path) -> None:
        """As other programs mix them in a file: JSON, Protobuf, and channels without schema."""
        with (tmp_path / "a.mcap").open("wb") as file:
            writer = McapWriter(file)
            writer.start()
            schemas = [
                ("/json", "json", writer.register_schema("Pose", "jsonschema", b"{}")),
                ("/protobuf", "protobuf", writer.register_schema("x.P", "protobuf", b"\x0a\xff")),
                ("/plain", "", 0),
                ("/height", "cdr", writer.register_schema(KIND, "ros2msg", b"float64 data")),
            ]
            for topic, encoding, schema in schemas:
                channel = writer.register_channel(topic, encoding, schema)
                for time_ns, packet in zip(TIMES, PACKETS, strict=True):
                    writer.add_message(channel, time_ns, packet, time_ns)
            writer.finish()
        check(tmp_path / "a.mcap")
        with neuros.bag.open(tmp_path / "a.mcap") as bag:
            assert {name: topic.type for name, topic in bag.topics.items()} == {
                "/json": "Pose",
                "/protobuf": "x.P",
                "/plain": "unknown",
                "/height": KIND,
            }
            assert {*bag.undecodable()} == {"/json", "/protobuf", "/plain"}
            with pytest.raises(EnvironmentFault, match="/json cannot be decoded: its packets are"):
                bag["/json"].array()

    @pytest.mark.parametrize(
        ("encoding", "text"),
        [
            pytest.param("unknown", "", id="none, as rosbag2 says it"),
            pytest.param("ros2msg", "Header header\nfloat64 data", id="no definition of a field"),
            pytest.param("ros2msg", "wstring data", id="what rosbags cannot parse"),
            pytest.param("ros2msg", "float32 data", id="one that does not fit"),
            pytest.param("ros2idl", "struct", id="no IDL"),
        ],
    )
    def test_a_definition_of_no_use_is_replaced_by_that_of_ros(
        self, tmp_path: Path, encoding: str, text: str
    ) -> None:
        check(sqlite_file(tmp_path / "a.db3", definitions={KIND: (encoding, text)}))

    def test_definitions_may_be_idl(self, tmp_path: Path) -> None:
        text = "module odd_msgs { module msg { struct Odd { double data; }; }; };"
        kind = "odd_msgs/msg/Odd"
        definitions = {kind: ("ros2idl", text)}
        check(sqlite_file(tmp_path / "a.db3", {"/height": (kind, PACKETS)}, definitions))

    def test_events_of_services_are_decoded(self, tmp_path: Path) -> None:
        kind, text = "odd_msgs/srv/Add_Event", "int32 a\nint32 b\n---\nint32 sum\n"
        numbers = (each.to_bytes(4, "little") for each in (1, 3, 4, 0))
        packet = b"\0\1\0\0" + bytes([2]) + bytes(39) + b"".join(numbers)
        definitions = {kind: ("ros2msg", text)}
        file = sqlite_file(tmp_path / "a.db3", {"/add": (kind, [packet])}, definitions)
        for path in (file, converted(file, tmp_path / "new")):
            with neuros.bag.open(path) as bag:
                (event,) = bag["/add"]
                assert bag["/add"].type == kind
                assert (event.info.event_type, event.response) == (2, [])
                assert [(each.a, each.b) for each in event.request] == [(3, 4)]


def converted(bag_path: Path, folder: Path, *options: str) -> Path:
    assert main(["bag", "convert", str(bag_path), "-o", str(folder), *options]) == 0
    return folder


class TestConversion:
    def test_any_bag_becomes_mcap_with_its_definitions(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        by_ros(4, {"/marker": (MARKER, [marker(Stores.ROS2_FOXY)]), **HEIGHT})(tmp_path / "old")
        new = converted(tmp_path / "old", tmp_path / "new")
        assert capsys.readouterr().out == f"{new}: 4 packets on 2 topics\n"
        assert sorted(each.name for each in new.iterdir()) == ["metadata.yaml", "new.mcap"]
        with neuros.bag.open(new / "new.mcap") as bag:
            assert bag["/height"].array()["data"].tolist() == VALUES
            assert bag["/marker"].array()["ns"].tolist() == ["ns"]
            assert bag["/marker"].definition.is_own
            assert bag.check() is None

    def test_a_topic_that_cannot_be_decoded_is_left_out_by_name(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        by_ros(5, {**HEIGHT, "/odd": ("odd_msgs/msg/Odd", PACKETS)})(tmp_path / "old")
        arguments = ["bag", "convert", str(tmp_path / "old"), "-o", str(tmp_path / "new")]
        assert main(arguments) == 4
        assert f"left out: {tmp_path}/old: /odd cannot be decoded" in capsys.readouterr().err
        check(tmp_path / "new")
        check(converted(tmp_path / "old", tmp_path / "third", "-t", "/hei*"))
        assert main(arguments) == 2
        assert f"{tmp_path}/new exists: name a new folder" in capsys.readouterr().err
        assert main([*arguments[:-1], str(tmp_path / "x"), "-t", "/none"]) == 2
        said = "--topic /none: the bag has no such topic; it has /height, /odd"
        assert said in capsys.readouterr().err


class TestDamage:
    def test_fewer_packets_than_metadata_count_are_noted_and_are_no_damage(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """`ros2 bag record` counts packets that it drops, as its cache is full."""
        folder = sqlite_file(tmp_path / "bag/a.db3").parent
        metadata(folder, 5, ["a.db3"], {"/height": (KIND, [*PACKETS, *PACKETS])})
        assert main(["bag", "info", str(folder)]) == 0
        said = "note: metadata.yaml counts 6 packets of /height, and the files have 3"
        assert said in capsys.readouterr().out
        with neuros.bag.open(folder) as bag:
            assert bag["/height"].array()["data"].tolist() == VALUES

    def test_a_file_that_was_cut_off_is_read_up_to_there_and_noted(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file = mcap_file(tmp_path / "a.mcap", use_chunking=False)
        data = file.read_bytes()
        file.write_bytes(data[: data.index(PACKETS[2]) + 6])
        with neuros.bag.open(file) as bag:
            assert bag["/height"].array()["data"].tolist() == VALUES[:2]
        assert main(["bag", "info", str(file)]) == 0
        assert "note: a.mcap has no end: what is there was recorded" in capsys.readouterr().out

    def test_nothing_is_left_of_a_conversion_that_fails(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file = mcap_file(tmp_path / "a.mcap", compression=CompressionType.NONE)
        data = file.read_bytes()
        file.write_bytes(data.replace(PACKETS[1], PACKETS[2], 1))
        assert main(["bag", "convert", str(file), "-o", str(tmp_path / "new")]) == 4
        assert "is damaged between bytes" in capsys.readouterr().err
        assert not (tmp_path / "new").exists()

    def test_a_file_that_is_missing_is_named(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = sqlite_file(tmp_path / "bag/a.db3").parent
        metadata(folder, 5, ["a.db3", "b.db3"])
        assert main(["bag", "info", str(folder)]) == 4
        assert "metadata.yaml names b.db3, which is not there" in capsys.readouterr().err

    def test_a_database_that_has_changed_is_damaged(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        many = [PACKETS[0] + bytes(4000)] * 3
        file = sqlite_file(tmp_path / "a.db3", {"/height": (KIND, many)})
        data = bytearray(file.read_bytes())
        data[4096 * 2 : 4096 * 3] = b"\xff" * 4096
        file.write_bytes(data)
        assert main(["bag", "info", str(file)]) == 4
        assert "is damaged (database disk image is malformed)" in capsys.readouterr().err
