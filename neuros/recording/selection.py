"""Selection of the packets that a recording holds, and of the node that keeps each."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from neuros.errors import UsageError
from neuros.ports import Way
from neuros.project.model import Connection, Node, Project
from neuros.project.names import INTERNAL, Names
from neuros.project.qos import ASKED, DEPTH, OFFERED
from neuros.recording.plan import RecordingPlan, Stream, Topic

CLOCK = "/clock"


@dataclass(frozen=True)
class Request:
    """Topics to record, and the storage.

    Attributes:
        everything: all that the project's nodes send and hear, and ``/clock``.
        topics: names and patterns of topics, connections or outputs; besides everything, or alone.
        exclude: names and patterns that are left out in any case.
        storage: ``mcap`` or ``sqlite3``.
    """

    everything: bool
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    storage: str = "mcap"


@dataclass(frozen=True)
class _Candidate:
    """Candidate to keep the packets of a topic: a node, and the way in which they pass it."""

    node: str
    way: Way
    name: str
    topic: Topic


def plan_recording(
    project: Project,
    names: Collection[str],
    request: Request,
    *,
    is_alone: bool,
    custom: Mapping[str, str],
) -> RecordingPlan:
    """Plan the recording of a run of the nodes ``names``.

    Args:
        is_alone: only the run can publish in its domain, so there is no clock to hear.

    Raises:
        UsageError: if something is asked for that does not exist.
    """
    _check_excluded(request, project)
    places = [place for place in _places(project, names) if _is_chosen(place.topic, request)]
    known = {place.topic.name for place in _places(project, names)}
    wanted = _asked_of_ros(request, known, project)
    listen = list(wanted)
    clock = project.names.resolve(CLOCK, "")
    if request.everything and not is_alone and clock not in known:
        listen.append(clock)
    topics = list(dict.fromkeys(place.topic for place in places))
    owners = [n.name for n in project.nodes if n.name in names and n.owns_time]
    return RecordingPlan(
        storage=request.storage,
        topics=tuple(topics),
        streams=_streams(places, topics),
        listen=tuple(
            name for name in dict.fromkeys(listen) if not is_named(name, None, request.exclude)
        ),
        wanted=wanted,
        time_owner=owners[0] if len(owners) == 1 else None,
        custom=custom,
    )


def _places(project: Project, names: Collection[str]) -> Iterator[_Candidate]:
    """One place for each topic and sender, in the order of the project."""
    for connection in project.connections:
        yield from _connection_place(project, connection, names)
    nodes = [node for node in project.nodes if node.name in names]
    sent: set[str] = set()
    for node in nodes:
        for place in _external(project.names, node, is_output=True):
            sent.add(place.topic.name)
            yield place
    heard: set[str] = set()
    for node in nodes:
        for place in _external(project.names, node, is_output=False):
            if place.topic.name not in sent | heard:
                heard.add(place.topic.name)
                yield place


def _connection_place(
    project: Project, connection: Connection, names: Collection[str]
) -> Iterator[_Candidate]:
    source, destination = connection.source_node, connection.destination_node
    topic = Topic(
        f"{connection.topic}/data",
        project.node(source).output(connection.source_output).type,
        connection.is_reliable,
        connection.window,
        str(connection),
    )
    if source in names:
        if source == destination:
            yield _Candidate(source, Way.TO_ITSELF, str(connection), topic)
        else:
            yield _Candidate(source, Way.SENT, connection.source_output, topic)
    elif destination in names:
        yield _Candidate(destination, Way.RECEIVED, str(connection), topic)


def _external(names: Names, node: Node, *, is_output: bool) -> Iterator[_Candidate]:
    for port in node.outputs if is_output else node.inputs:
        if port.external_topic is not None:
            qos = port.qos or (OFFERED if is_output else ASKED)
            topic = Topic(
                names.resolve(port.external_topic, node.name),
                port.type,
                qos.reliability != "best_effort" if is_output else qos.reliability == "reliable",
                qos.depth or DEPTH,
                is_latched=qos.is_latched,
            )
            way = Way.SENT if is_output else Way.HEARD
            yield _Candidate(node.name, way, port.name, topic)


def _streams(
    places: Sequence[_Candidate], topics: Sequence[Topic]
) -> dict[str, tuple[Stream, ...]]:
    """Packets that pass a node in one way are kept once, for all their topics."""
    groups: dict[tuple[str, Way, str], list[int]] = {}
    for place in places:
        key = (place.node, place.way, place.name)
        groups.setdefault(key, []).append(topics.index(place.topic))
    streams: dict[str, list[Stream]] = {}
    for (node, way, name), members in groups.items():
        streams.setdefault(node, []).append(Stream(way.value, name, tuple(members)))
    return {node: tuple(found) for node, found in streams.items()}


def _is_chosen(topic: Topic, request: Request) -> bool:
    if is_named(topic.name, topic.connection, request.exclude):
        return False
    return request.everything or is_named(topic.name, topic.connection, request.topics)


def is_named(name: str, connection: str | None, patterns: Sequence[str]) -> bool:
    """Whether one of the patterns fits a topic, its connection, or the output that feeds it."""
    words = [name, name.removesuffix("/data")] if connection else [name]
    if connection:
        words += [connection, connection.partition(" -> ")[0]]
    return any(fnmatchcase(word, pattern) for word in words for pattern in patterns)


def _asked_of_ros(request: Request, known: Collection[str], project: Project) -> tuple[str, ...]:
    """Topics that only the ROS graph can know.

    Raises:
        UsageError: for what can be neither on the graph nor in the project.
    """
    found = []
    internal = project.names.namespace + INTERNAL
    labels = {str(connection): f"{connection.topic}/data" for connection in project.connections}
    for text in request.topics:
        in_project = any(
            is_named(name, label, [text]) for label, name in labels.items() if name in known
        ) or any(fnmatchcase(name, text) for name in known)
        if in_project:
            continue
        if not text.startswith("/") or text.startswith(internal) or set(text) & set("*?["):
            raise _unknown("--topic", text, project)
        found.append(text)
    return tuple(dict.fromkeys(found))


def _check_excluded(request: Request, project: Project) -> None:
    """Raise ``UsageError`` for what leaves nothing out, nor could on the ROS graph."""
    everywhere = _places(project, [node.name for node in project.nodes])
    topics = [place.topic for place in everywhere]
    internal = project.names.namespace + INTERNAL
    for text in request.exclude:
        is_of_ros = text.startswith("/") and not text.startswith(internal)
        if not is_of_ros and not any(is_named(t.name, t.connection, [text]) for t in topics):
            raise _unknown("--exclude", text, project)


def _unknown(option: str, text: str, project: Project) -> UsageError:
    outputs = dict.fromkeys(str(each).partition(" -> ")[0] for each in project.connections)
    return UsageError(
        f"{option} {text}: the project has no such topic, connection or output; outputs:"
        f" {', '.join(outputs) or 'none'}"
    )
