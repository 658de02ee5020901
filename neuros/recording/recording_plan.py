"""Plan of a recording: which packets it holds, and which node keeps each.

The launcher makes the plan; as a file in the run folder it tells nodes and recorder what to record.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from neuros.control.link import read_as
from neuros.errors import ControlError, EnvironmentFault, UsageError
from neuros.ordinary_files import write_whole
from neuros.ports import Way
from neuros.project.model import Project
from neuros.project.names import INTERNAL
from neuros.project.qos import ASKED, DEPTH, OFFERED
from neuros.recording.run_file import read_object

CLOCK = "/clock"
PLAN_NAME = "recording.json"
BAG_NAME = "bag"

_VERSION = 1
_NODE_NAME = re.compile(r"_?[A-Za-z][A-Za-z0-9_]{,250}")  # a folder has this name


@dataclass(frozen=True)
class Topic:
    """A topic of the bag.

    Attributes:
        name: as on the ROS graph.
        type: in ROS notation.
        is_reliable, depth, is_latched: of the quality of service that its sender offers.
        connection: ``a.out -> b.in``, or ``None`` for an external topic.
    """

    name: str
    type: str
    is_reliable: bool = True
    depth: int = 10
    connection: str | None = None
    is_latched: bool = False


@dataclass(frozen=True)
class RecordedStream:
    """Packets that one node keeps.

    Attributes:
        way: how they pass the node (:class:`neuros.ports.Way`).
        name: of the port or connection.
        topics: places in the plan of the topics that carry them.
    """

    way: str
    name: str
    topics: tuple[int, ...]


@dataclass(frozen=True)
class RecordingPlan:
    """All that is recorded of a run.

    Attributes:
        topics: of the bag; the recorder adds those of others when their senders appear.
        streams: by node, in the order of their numbers in its spool.
        listen: topics that the recorder subscribes to itself.
        wanted: those of ``listen`` that the user has named.
        time_owner: the one node that owns simulated time; ``None`` if none or several do.
        custom: for the metadata of the bag.
        flush_interval: seconds after which packets are on the disk.
        is_virtual: whether the times of packets are virtual.
    """

    topics: tuple[Topic, ...]
    streams: Mapping[str, tuple[RecordedStream, ...]]
    listen: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()
    time_owner: str | None = None
    custom: Mapping[str, str] = field(default_factory=dict)
    flush_interval: float = 1.0
    is_virtual: bool = False

    def save(self, run: Path) -> None:
        """Write the plan into the run folder. Raises ``OSError``."""
        content = {"version": _VERSION, **asdict(self)}
        write_whole(run / PLAN_NAME, f"{json.dumps(content, indent=2)}\n".encode())


def load_plan(run: Path) -> RecordingPlan:
    """The plan of a run.

    Raises:
        UsageError: if there is none, or this version of NeuROS cannot read it.
        EnvironmentFault: if it is damaged.
    """
    path = run / PLAN_NAME
    try:
        content = read_object(path)
        version = content.pop("version", None)
        if version != _VERSION:
            raise UsageError(
                f"{path} is of version {version}, and this NeuROS reads version {_VERSION}"
            )
        content.pop("storage", None)  # earlier versions had a choice of storages
        plan = read_as(RecordingPlan, content)
        places = {place for each in plan.streams.values() for s in each for place in s.topics}
        if not places <= {*range(len(plan.topics))} or not all(
            map(_NODE_NAME.fullmatch, plan.streams)
        ):
            raise ControlError("its streams do not belong to its topics and nodes")
        return plan
    except (FileNotFoundError, NotADirectoryError) as error:
        raise UsageError(_why_no_plan(run)) from error
    except (EnvironmentFault, ControlError) as error:
        raise EnvironmentFault(f"{path} is damaged: {error}") from error


def _why_no_plan(run: Path) -> str:
    """Why a path is not the folder of a recorded run."""
    if not run.exists():
        return f"{run}: there is no such file or folder"
    if not run.is_dir():
        return f"{run} is a file: give the folder of a run, or a bag (a folder, .mcap or .db3)"
    if (run / "run.json").exists() or any(run.glob("*/node.json")):
        return f"{run} was not recorded: launch the project with -r, or name topics with -t"
    return f"{run} is the folder of neither a run nor a bag: it has no run.json, no metadata.yaml"


@dataclass(frozen=True)
class RecordingRequest:
    """Topics to record.

    Attributes:
        everything: all topics that nodes of the project send or receive, and ``/clock``.
        topics: names and patterns of topics, connections or outputs to record as well, or alone.
        exclude: names and patterns of what is left out in any case.
        flush_interval: seconds after which packets are on the disk.
    """

    everything: bool
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    flush_interval: float = 1.0


class _Candidate(NamedTuple):
    """A node that can keep the packets of a topic, and the way in which they pass the node."""

    node: str
    way: Way
    name: str
    topic: Topic


def plan_recording(
    project: Project,
    names: Collection[str],
    request: RecordingRequest,
    *,
    is_alone: bool,
    custom: Mapping[str, str],
) -> RecordingPlan:
    """Plan the recording of a run of the nodes ``names``.

    Args:
        is_alone: no other program can publish in the domain, so ``/clock`` is not recorded.

    Raises:
        UsageError: for a topic that does not exist.
    """
    everywhere = _candidates(project, [node.name for node in project.nodes])
    labels = [(each.topic.name, each.topic.connection) for each in everywhere]
    for text in request.exclude:
        if not _may_be_on_graph(text, project) and not any(is_named(*x, [text]) for x in labels):
            raise _unknown("--exclude", text, project)
    candidates = list(_candidates(project, names))
    chosen = [
        each
        for each in candidates
        if not is_named(each.topic.name, each.topic.connection, request.exclude)
        and (request.everything or is_named(each.topic.name, each.topic.connection, request.topics))
    ]
    known = {each.topic.name for each in candidates}
    passing = [(each.topic.name, each.topic.connection) for each in candidates]
    wanted: dict[str, None] = {}  # topics that only the ROS graph can know
    for text in request.topics:
        if any(is_named(name, label, [text]) for name, label in passing):
            continue
        if not _may_be_on_graph(text, project) or set(text) & set("*?["):
            raise _unknown("--topic", text, project)
        wanted[text] = None
    listen = list(wanted)
    clock = project.names.resolve(CLOCK, "")
    if request.everything and not is_alone and clock not in known:
        listen.append(clock)
    topics = list(dict.fromkeys(each.topic for each in chosen))
    owners = [n.name for n in project.nodes if n.name in names and n.owns_time]
    return RecordingPlan(
        topics=tuple(topics),
        streams=_streams(chosen, topics),
        listen=tuple(
            name for name in dict.fromkeys(listen) if not is_named(name, None, request.exclude)
        ),
        wanted=tuple(wanted),
        time_owner=owners[0] if len(owners) == 1 else None,
        custom=custom,
        flush_interval=request.flush_interval,
        is_virtual=project.is_virtual,
    )


def _candidates(project: Project, names: Collection[str]) -> Iterator[_Candidate]:
    """One for each topic and sender, in the order of the project."""
    for connection in project.connections:
        source, destination = connection.source_node, connection.destination_node
        topic = Topic(
            f"{connection.topic}/data",
            project.node(source).output(connection.source_output).ros_type,
            connection.is_reliable,
            connection.window,
            str(connection),
        )
        if source in names and source == destination:
            yield _Candidate(source, Way.TO_ITSELF, str(connection), topic)
        elif source in names:
            yield _Candidate(source, Way.SENT, connection.source_output, topic)
        elif destination in names:
            yield _Candidate(destination, Way.RECEIVED, str(connection), topic)
    nodes = [node for node in project.nodes if node.name in names]
    seen: set[str] = set()
    for is_output, node in itertools.product((True, False), nodes):
        for port in node.outputs if is_output else node.inputs:
            if port.external_topic is None:
                continue
            name = project.names.resolve(port.external_topic, node.name)
            if name in seen and not is_output:
                continue  # a node that sends the topic, or receives it, keeps it already
            seen.add(name)
            qos = port.qos or (OFFERED if is_output else ASKED)
            topic = Topic(
                name,
                port.ros_type,
                qos.reliability != "best_effort" if is_output else qos.reliability == "reliable",
                qos.depth or DEPTH,
                is_latched=qos.is_latched,
            )
            yield _Candidate(node.name, Way.SENT if is_output else Way.HEARD, port.name, topic)


def _streams(
    chosen: Sequence[_Candidate], topics: Sequence[Topic]
) -> dict[str, tuple[RecordedStream, ...]]:
    """By node, its streams: packets that pass a node in one way are kept once for all topics."""
    groups: dict[tuple[str, Way, str], list[int]] = {}
    for node, way, name, topic in chosen:
        groups.setdefault((node, way, name), []).append(topics.index(topic))
    streams: dict[str, tuple[RecordedStream, ...]] = {}
    for (node, way, name), members in groups.items():
        stream = RecordedStream(way.value, name, tuple(members))
        streams[node] = (*streams.get(node, ()), stream)
    return streams


def is_named(name: str, connection: str | None, patterns: Sequence[str]) -> bool:
    """Whether a pattern fits a topic, its connection, or the output that sends on it."""
    words = [name, name.removesuffix("/data")] if connection else [name]
    if connection:
        words += [connection, connection.partition(" -> ")[0]]
    return any(fnmatchcase(word, pattern) for word in words for pattern in patterns)


def _may_be_on_graph(text: str, project: Project) -> bool:
    """Whether another program may have a topic of that name."""
    return text.startswith("/") and not text.startswith(project.names.namespace + INTERNAL)


def _unknown(option: str, text: str, project: Project) -> UsageError:
    outputs = dict.fromkeys(str(each).partition(" -> ")[0] for each in project.connections)
    return UsageError(
        f"{option} {text}: the project has no such topic, connection or output; outputs:"
        f" {', '.join(outputs) or 'none'}"
    )
