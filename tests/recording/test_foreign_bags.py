"""Bags that other programs have written, in every storage and compression that rosbags knows."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import neuros.bag
from neuros.cli.main import main

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


def by_humble(folder: Path) -> None:
    """An SQLite file without definitions of its types, as ROS 2 writes it up to Humble."""
    folder.mkdir()
    with contextlib.closing(sqlite3.connect(folder / "bag_0.db3")) as database, database:
        database.executescript(
            """
            CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
              serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
            CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
              timestamp INTEGER NOT NULL, data BLOB NOT NULL);
            INSERT INTO topics VALUES(1, '/height', 'std_msgs/msg/Float64', 'cdr', '');
            """
        )
        insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)"
        database.executemany(insert, zip(TIMES, PACKETS, strict=True))
    topic = {"name": "/height", "type": KIND, "serialization_format": "cdr"}
    information = {
        "version": 5,
        "storage_identifier": "sqlite3",
        "relative_file_paths": ["bag_0.db3"],
        "duration": {"nanoseconds": TIMES[-1] - TIMES[0]},
        "starting_time": {"nanoseconds_since_epoch": TIMES[0]},
        "message_count": 3,
        "topics_with_message_count": [
            {"topic_metadata": {**topic, "offered_qos_profiles": ""}, "message_count": 3}
        ],
        "compression_format": "",
        "compression_mode": "",
    }
    text = json.dumps({"rosbag2_bagfile_information": information})
    (folder / "metadata.yaml").write_text(text)


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(by_humble, id="humble"),
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
    with neuros.bag.open(folder) as bag:
        heights = bag["/height"].array()
    assert heights["data"].tolist() == VALUES
    assert heights["log_time_ns"].tolist() == TIMES
    assert main(["bag", "info", str(folder)]) == 0
    assert "/height  std_msgs/msg/Float64  3" in capsys.readouterr().out
