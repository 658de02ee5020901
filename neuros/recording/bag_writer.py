"""Writer of the bag of a run: a rosbag2 folder (version 9) with one MCAP file.

The file holds the definitions of its message types, so that machines without them can read it. Its
index and ``metadata.yaml`` are written at the end; :mod:`neuros.recording.stored` reads a file
without them up to the last flush.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from neuros.distribution import __version__
from neuros.errors import EnvironmentFault
from neuros.ordinary_files import write_whole
from neuros.project.message_types import message_folder, normalised
from neuros.recording.recording_plan import Topic

_LAST_NS = (1 << 63) - 1
_FOREVER = {"sec": 9223372036, "nsec": 854775807}  # as rmw has it for "no deadline"


def define(type_name: str, store: Typestore) -> None:
    """Add an installed message type, and all types of its fields, to the store.

    Raises:
        EnvironmentFault: if a definition is missing.
    """
    if type_name in store.fielddefs:
        return
    is_type = normalised(type_name) == type_name
    folder = message_folder(type_name.split("/")[0]) if is_type else None
    # In ROS and in a wheel, the share folder is some folders above the module.
    shares = (above / "share" / f"{type_name}.msg" for above in folder.parents) if folder else ()
    path = next(filter(Path.is_file, shares), None)
    if path is None:
        raise EnvironmentFault(
            f"the definition of message type {type_name} (share/{type_name}.msg) is not installed"
            " here"
        )
    types = get_types_from_msg(path.read_text("utf-8"), type_name)
    for used in types_of_fields(types[type_name][1]):
        if used.endswith("/msg/wstring"):
            raise EnvironmentFault(
                f"message type {type_name} has a wstring, which the library that reads bags does"
                " not know; use string, which is UTF-8"
            )
        if used != type_name:
            define(used, store)
    store.register(types)


def types_of_fields(fields: object) -> Iterator[str]:
    """The message types in rosbags' description of fields."""
    if isinstance(fields, str):
        if "/" in fields:
            yield fields
    elif isinstance(fields, (list, tuple)):
        for part in fields:
            yield from types_of_fields(part)


class BagWriter:
    """Writes a bag.

    Args:
        path: the folder of the bag, which must not exist.
        custom: custom data for its metadata.

    Attributes:
        counts: messages by the number of their topic.

    Raises:
        OSError: if it cannot be written.
    """

    def __init__(self, path: Path, custom: Mapping[str, str]) -> None:
        path.mkdir(parents=True)
        self.counts: dict[int, int] = {}
        self._path, self._custom = path, dict(custom)
        self._file = (path / f"{path.name}.mcap").open("xb")
        # Compression of images took 2.7 times the processor time, for 0.6 times the size.
        self._mcap = Writer(self._file, compression=CompressionType.NONE)
        self._mcap.start("ros2", f"neuros-{__version__}")
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._schemas: dict[str, int] = {}
        self._topics: list[dict[str, Any]] = []
        self._first_ns, self._last_ns = _LAST_NS, 0

    def add_topic(self, topic: Topic, types: Typestore | None = None) -> int:
        """The number of a new topic, for :meth:`put`.

        Args:
            types: has the definition of its type, which is that of the first topic of the type;
                ``None``: the installed one.

        Raises:
            EnvironmentFault: if the definition of its type is not installed.
        """
        if types is None:
            types = self._types
            define(topic.type, types)
        name = normalize_msgtype(topic.type)  # differs for a service event
        if topic.type not in self._schemas:
            definition, _ = types.generate_msgdef(name, ros_version=2)
            schema = self._mcap.register_schema(topic.type, "ros2msg", definition.encode())
            self._schemas[topic.type] = schema
        qos = [
            {
                "history": "keep_last",
                "depth": topic.depth,
                "reliability": "reliable" if topic.is_reliable else "best_effort",
                "durability": "transient_local" if topic.is_latched else "volatile",
                "deadline": _FOREVER,
                "lifespan": _FOREVER,
                "liveliness": "automatic",
                "liveliness_lease_duration": _FOREVER,
                "avoid_ros_namespace_conventions": False,
            }
        ]
        number = self._mcap.register_channel(
            topic.name, "cdr", self._schemas[topic.type], {"offered_qos_profiles": _yaml(qos)}
        )
        self.counts[number] = 0
        self._topics.append(
            {
                "name": topic.name,
                "type": topic.type,
                "serialization_format": "cdr",
                "offered_qos_profiles": qos,
                "type_description_hash": types.hash_rihs01(name),
            }
        )
        return number

    def put(self, topic: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message; times in nanoseconds. Raises ``OSError``."""
        self.counts[topic] += 1
        sequence = self.counts[topic] & 0xFFFFFFFF
        self._mcap.add_message(topic, log_ns, data, publish_ns, sequence)
        self._first_ns, self._last_ns = min(self._first_ns, log_ns), max(self._last_ns, log_ns)

    def flush(self) -> None:
        """Write all messages to the disk, against a power failure. Raises ``OSError``."""
        self._mcap.flush()
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Complete the bag. Raises ``OSError``."""
        file = f"{self._path.name}.mcap"
        content = {
            "starting_time": {"nanoseconds_since_epoch": self._first_ns},
            "duration": {"nanoseconds": max(0, self._last_ns - self._first_ns)},
            "message_count": sum(self.counts.values()),
        }
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [file],
            **content,
            "topics_with_message_count": [
                {"topic_metadata": topic, "message_count": self.counts[number]}
                for number, topic in enumerate(self._topics, 1)
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": file, **content}],
            "custom_data": self._custom or None,
            "ros_distro": "jazzy",
        }
        try:
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": _yaml(information)})
            self._mcap.finish()
            self._file.close()
            text = _yaml({"rosbag2_bagfile_information": information})
            write_whole(self._path / "metadata.yaml", f"{text}\n".encode())
        finally:
            self.shut()

    def shut(self) -> None:
        """Close the file without completing the bag."""
        with contextlib.suppress(OSError):  # the disk is full, which was reported before
            self._file.close()


def _yaml(content: Any) -> str:
    """JSON, which is YAML, and 30 times as fast to write."""
    return json.dumps(content, indent=1, ensure_ascii=False)
