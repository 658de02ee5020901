"""Types of recorded topics: as the bag defines them, else as ROS or this machine does.

Bags hold no definitions before Iron, and incomplete or wrong ones after. So the definitions of the
bag are tried first, then those of its distribution, those installed here, and those of other
distributions; and the first that fit the first packets of a topic are right.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from textwrap import shorten
from typing import Any, TypeAlias

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault
from neuros.recording.bag_writer import define, types_of_fields

_Types: TypeAlias = Mapping[str, Any]
_NEXT_TYPE = re.compile(r"^={80}$", re.MULTILINE)
_PARTS = re.compile(r"^---[ \t]*$", re.MULTILINE)


class TopicType:
    """How messages of a topic are decoded.

    Args:
        recorded: the topic.
        distribution: of the bag, as ``humble``; empty if unknown.
        packets: some of the topic, to find the definitions that fit.

    Attributes:
        name: of the type, as the store knows it.
        store: the type, and the types of its fields.
        is_own: whether the bag itself defines the type.

    Raises:
        EnvironmentFault: if there is no definition that fits.
    """

    def __init__(self, recorded: Connection, distribution: str, packets: Sequence[bytes]) -> None:
        self.name = normalize_msgtype(recorded.msgtype)
        encoding = getattr(recorded.ext, "serialization_format", "cdr")
        if encoding != "cdr":
            raise EnvironmentFault(f"its packets are encoded as {encoding}, and not as CDR")
        own: _Types = {}
        why_not = ""
        try:
            own = _own_types(recorded)
        except Exception as error:  # rosbags raises any for what it does not know, as a wstring
            why_not = shorten(str(error), 200, placeholder=" ...") or type(error).__name__
        self.is_own = self.name in own
        sources = [own, *_sources(distribution)]
        first: Typestore | None = None
        for place, source in enumerate(sources):
            if self.name not in source:
                continue
            try:
                store = _store([self.name], sources[place:])
            except EnvironmentFault:
                if place + 1 == len(sources) and first is None:
                    raise
                continue
            if first is None:
                first = store
            if all(_fits(store, self.name, packet) for packet in packets):
                self.store = store
                return
        if first is None and why_not:
            raise EnvironmentFault(f"its definition in the bag cannot be parsed ({why_not})")
        if first is None:
            raise EnvironmentFault(_unknown(recorded.msgtype))
        if not self.is_own:
            raise EnvironmentFault(
                f"its packets are none of {self.name} as ROS defines it, and the bag does not"
                " define it"
            )
        self.store = first  # reading names the damage


def _unknown(name: str) -> str:
    return (
        f"the bag does not define message type {name}, and it is not installed here: build its"
        " package (neuros build), and add the folder `python` of the build to PYTHONPATH"
    )


def _fits(store: Typestore, name: str, packet: bytes) -> bool:
    try:
        store.deserialize_cdr(packet, name)
    except Exception:  # rosbags raises any for other bytes
        return False
    return True


def _own_types(recorded: Connection) -> _Types:
    """The types that the bag defines for a topic. Raises any exception."""
    text, name = recorded.msgdef.data, recorded.msgtype
    if recorded.msgdef.format == MessageDefinitionFormat.NONE:
        return {}
    if recorded.msgdef.format == MessageDefinitionFormat.IDL:
        return get_types_from_idl(text)
    package, _, service = name.partition("/srv/")
    if not (service.endswith("_Event") and _PARTS.search(text)):
        return get_types_from_msg(text, name)
    # rosbag2 defines a service event by the file of the service.
    main, *others = _NEXT_TYPE.split(text, maxsplit=1)
    used = "".join(f"{'=' * 80}{other}" for other in others)
    base = service.removesuffix("_Event")
    types: dict[str, Any] = {}
    for part, kind in zip(_PARTS.split(main), ("Request", "Response"), strict=True):
        types |= get_types_from_msg(f"{part.strip()}\n{used}", f"{package}/srv/{base}_{kind}")
    fields = "service_msgs/ServiceEventInfo info\n"
    fields += f"{base}_Request[<=1] request\n{base}_Response[<=1] response\n"
    return types | get_types_from_msg(fields, name)


class _Installed(Mapping[str, Any]):
    """Message types that are installed here."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.EMPTY)

    def __getitem__(self, name: str) -> Any:
        try:
            define(name, self._store)
        except EnvironmentFault:
            raise KeyError(name) from None
        return self._store.fielddefs[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._store.fielddefs)

    def __len__(self) -> int:
        return len(self._store.fielddefs)


class _OfRos(Mapping[str, Any]):
    """Message types of a ROS distribution, which rosbags knows; loaded when they are needed."""

    def __init__(self, which: Stores) -> None:
        self._which = which

    def __getitem__(self, name: str) -> Any:
        return get_typestore(self._which).fielddefs[name]

    def __iter__(self) -> Iterator[str]:
        return iter(get_typestore(self._which).fielddefs)

    def __len__(self) -> int:
        return len(get_typestore(self._which).fielddefs)


def _sources(distribution: str) -> list[_Types]:
    """Definitions outside of the bag, the most likely ones first."""
    ros = [each for each in Stores if each.value.startswith("ros2_")]
    own = [each for each in ros if each.value == f"ros2_{distribution}"]
    others = [each for each in reversed(ros) if each not in own]
    return [*map(_OfRos, own), _Installed(), *map(_OfRos, others)]


def _store(names: Iterable[str], sources: Sequence[_Types]) -> Typestore:
    """A store of types and all types of their fields, each from the first source that has it.

    Raises:
        EnvironmentFault: if no source has one of them.
    """
    found: dict[str, Any] = {}
    pending = [*names]
    while pending:
        name = pending.pop()
        if name in found:
            continue
        source = next((each for each in sources if name in each), None)
        if source is None:
            raise EnvironmentFault(_unknown(name))
        found[name] = source[name]
        pending += types_of_fields(found[name][1])
    store = get_typestore(Stores.EMPTY)
    store.register(found)
    return store
