"""Packets of any bag as the inputs of one node of a project, in the order of their time.

The node runs on the real engine, with a clock that stands at the time of the packet that arrives:
its timed hooks start when they would have started, and a replay gives the same result each time.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

from neuros.bag import Bag
from neuros.errors import UsageError
from neuros.project.model import Connection, Node, Port
from neuros.recording.bag_writer import BagWriter
from neuros.recording.recording_plan import Topic
from neuros.testing import PluginHarness
from neuros.transport.messages import RosPackets


class Target(NamedTuple):
    """An input of the node, and which of its sources the packets stand for."""

    input: str
    source: str | None
    port: Port


@dataclass
class Replayed:
    """What a node did with the packets of a bag.

    Attributes:
        arrived: by topic of the bag, how many of its packets the node got.
        waiting: by topic, how many packets waited for the node at the end.
        sent: by output, how many packets it sent.
        executions: by hook.
        ended: why the node ended the project, ``None`` if it did not.
    """

    arrived: dict[str, int] = field(default_factory=dict)
    waiting: dict[str, int] = field(default_factory=dict)
    sent: dict[str, int] = field(default_factory=dict)
    executions: dict[str, int] = field(default_factory=dict)
    ended: str | None = None


def rules_of(texts: Sequence[str]) -> dict[str, str]:
    """By topic of the bag, the input or output that gets its packets: ``/image:=robot.eye``.

    Raises:
        UsageError: for a text that is no such rule, and a topic that is named twice.
    """
    rules: dict[str, str] = {}
    for text in texts:
        topic, sign, target = text.partition(":=")
        if not (topic and sign and target.count(".") == 1):
            raise UsageError(
                f"replay: --remap {text}: write TOPIC:=NODE.PORT, as /camera/image:=robot.eye"
            )
        if topic in rules:
            raise UsageError(f"replay: --remap {text}: {topic} goes to {rules[topic]} already")
        rules[topic] = target
    return rules


def replay_into(
    harness: PluginHarness,
    bag: Bag,
    rules: Mapping[str, str],
    *,
    keep: Path | None,
    log: Callable[[str], object],
) -> Replayed:
    """Give a node the packets of topics, and run its hooks, to the end of the bag.

    Args:
        harness: has the node.
        rules: from :func:`rules_of`.
        keep: a new folder for a bag with what the node sends; ``None``: keep nothing.
        log: receives the lines of the node's log.

    Raises:
        UsageError: if a rule names what is not there, or its types differ.
        EnvironmentFault: if a topic cannot be decoded, or the bag is damaged.
        HookError, NodeError: if the node fails.
        OSError: if the new bag cannot be written.
    """
    node = harness.file.node
    connections = [c for c in harness.file.connections if c.destination_node == node.name]
    targets = _targets(node, connections, bag, rules)
    done = Replayed(arrived=dict.fromkeys(targets, 0))
    outputs = {port.name: port for port in node.outputs}
    done.sent = dict.fromkeys(outputs, 0)
    writer = None if keep is None else BagWriter(keep, {})
    try:
        numbers = {}
        if writer is not None:
            for name, port in outputs.items():
                topic = port.external_topic or f"/{node.name}/{name}"
                numbers[name] = writer.add_topic(Topic(topic, port.ros_type))
        packets = RosPackets()
        lines = 0

        def collect(now_ns: int) -> None:
            nonlocal lines
            for name in outputs:
                for packet in harness.received(name, start=done.sent[name]):
                    done.sent[name] += 1
                    if writer is not None:
                        data = packets.encode(packet)
                        writer.put(numbers[name], now_ns, now_ns, data)
            for record in harness.log[lines:]:
                log(f"[{record.severity}] [{node.name}]: {record.text}")
            lines = len(harness.log)

        now_ns = bag.start_ns
        for at_ns, topic, data in _merged(bag, targets):
            harness.advance(max(0, at_ns - now_ns) / 1e9)
            now_ns = max(now_ns, at_ns)
            target = targets[topic]
            packet = packets.decode(target.port.type, data)
            harness.send(target.input, packet, source=target.source)
            harness.run()
            collect(now_ns)
            done.arrived[topic] += 1
            if harness.shutdown_reason is not None:
                break
        harness.finalise()
        collect(now_ns)
        if writer is not None:
            writer.close()
    finally:
        if writer is not None:
            writer.shut()
    done.ended = harness.shutdown_reason
    done.executions = harness.executions
    for topic, target in targets.items():
        if target.port.external_topic is None:
            done.waiting[topic] = harness.unsent(target.input, target.source)
    return done


def _merged(bag: Bag, topics: Mapping[str, Target]) -> Iterator[tuple[int, str, bytes]]:
    """Packets of all topics by their time; those of one time in the order of the rules."""
    streams = [
        [(packet.log_time_ns, place, name, packet.data) for packet in bag[name].raw()]
        for place, name in enumerate(topics)
    ]
    for at_ns, _, name, data in heapq.merge(*streams, key=itemgetter(0, 1)):
        yield at_ns, name, data


def _targets(
    node: Node, connections: Sequence[Connection], bag: Bag, rules: Mapping[str, str]
) -> dict[str, Target]:
    """By topic of the bag, where its packets go; all mistakes at once."""
    found: dict[str, Target] = {}
    problems = []
    inputs = {port.name: port for port in node.inputs}
    for topic, text in rules.items():
        owner, _, name = text.partition(".")
        source = None
        if owner != node.name:
            fitting = [c for c in connections if (c.source_node, c.source_output) == (owner, name)]
            source, name = text, fitting[0].destination_input if fitting else ""
        if name not in inputs:
            sources = [f"{c.source_node}.{c.source_output}" for c in connections]
            there = [*(f"{node.name}.{each}" for each in inputs), *dict.fromkeys(sources)]
            problems.append(
                f"--remap {topic}:={text}: '{node.name}' has no such input or source; it has"
                f" {', '.join(there)}"
            )
            continue
        try:
            recorded = bag[topic]
        except KeyError as error:
            problems.append(f"--remap {topic}:={text}: the bag has no topic {error.args[0]}")
            continue
        kind, wanted = recorded.definition.name, inputs[name].ros_type
        problem = recorded.misfit
        if kind != wanted:
            problem = f"its packets are {kind}, and those of '{name}' {wanted}"
        if problem:
            problems.append(f"--remap {topic}:={text}: {problem}")
        found[topic] = Target(name, source, inputs[name])
    if problems:
        raise UsageError("\n".join(f"replay: {each}" for each in problems))
    return found
