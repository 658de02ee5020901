"""The plugin of every node of a conformance run: its hooks are described in its environment.

Each execution is one line of ``observed.jsonl`` in the node's run folder: what the hook took, what
it sent, and when it started and ended, on the machine's monotonic clock, or in virtual time.
"""

import array
import json
import os
import struct
import time
from pathlib import Path

from neuros.hooks import (
    All,
    Optional,
    neuros_finalise,
    neuros_function,
    neuros_initialise,
    neuros_tick,
)

_NODE = json.loads(os.environ["CONFORMANCE"])
_IS_VIRTUAL = _NODE.get("is_virtual", False)
_FILE = Path(os.environ["NEUROS_RUN_DIR"]) / "observed.jsonl"
# In virtual time nodes run in the program of the test, which must not be left an open file.
_LOG = None if _IS_VIRTUAL else _FILE.open("w", buffering=1)
_HEAD = struct.Struct("<IQ")
_MANY, _PAUSE_S = 500, 0.002  # after so many executions a hook slows down
_sequence = dict.fromkeys(_NODE["outputs"], 0)


def _note(*entry):
    line = json.dumps(entry, separators=(",", ":")) + "\n"
    if _LOG is not None:
        _LOG.write(line)
        return
    with _FILE.open("a") as log:
        log.write(line)


def _now_ns(node):
    if not _IS_VIRTUAL:
        return time.monotonic_ns()
    now = node.now()
    return now.sec * 1_000_000_000 + now.nanosec


def _fill(packet, port, number):
    kind, size, origin = port["kind"], port["size"], port["origin"]
    if kind == "byte":
        packet.data = number % 256
    elif kind == "int":
        packet.data = origin << 40 | number
    elif kind == "text":
        packet.data = f"{origin} {number} {size} " + "x" * size
    elif kind == "bytes":
        data = _HEAD.pack(origin, number) + bytes([number % 251]) * size
        packet.data = array.array("B", data)
    else:
        packet.height, packet.width = origin, number
        packet.data = array.array("B", bytes([number % 251]) * size)


def _read(port, packet):
    """Who sent a packet, its number, and whether its content is what was sent."""
    kind = _NODE["inputs"][port]
    if kind == "byte":
        return _NODE["only_source"][port], packet.data, True
    if kind == "int":
        return packet.data >> 40, packet.data & (1 << 40) - 1, True
    if kind == "text":
        origin, number, size, text = packet.data.split(" ")
        return int(origin), int(number), text == "x" * int(size)
    if kind == "bytes":
        data = bytes(packet.data)
        origin, number = _HEAD.unpack_from(data)
        rest = data[_HEAD.size :]
    else:
        origin, number, rest = packet.height, packet.width, bytes(packet.data)
    return origin, number, rest == bytes([number % 251]) * len(rest)


def _seen(declared, argument):
    if argument is None:
        return None
    if declared["is_all"]:
        return [None if each is None else _read(declared["port"], each) for each in argument]
    return [_read(declared["port"], argument)]


def _is_empty(taken):
    return all(each is None or not any(each) for each in taken)


def _body(hook):
    count = 0
    sent_by_port = dict.fromkeys((each["port"] for each in hook["outputs"]), 0)

    def body(node, *arguments):
        nonlocal count
        start_ns = _now_ns(node)
        count += 1
        taken = [
            _seen(declared, argument)
            for declared, argument in zip(hook["inputs"], arguments, strict=True)
        ]
        slows_down = count > _MANY and not _IS_VIRTUAL
        pause_s = max(hook["sleep_ms"] / 1000, _PAUSE_S if slows_down else 0)
        if pause_s:
            time.sleep(pause_s)
        packets, sent = [], {}
        for output in hook["outputs"]:
            port = output["port"]
            is_wanted = count % output["every"] == 0 and not (
                (output["at_most"] and sent_by_port[port] >= output["at_most"])
                or (output["is_answer"] and _is_empty(taken))
            )
            if output["is_optional"] and not is_wanted:
                packets.append(None)
                continue
            sent_by_port[port] += 1
            _sequence[port] += 1
            packet = node.make_packet(port)
            _fill(packet, _NODE["outputs"][port], _sequence[port])
            packets.append(packet)
            sent[port] = _sequence[port]
        if count == hook["shutdown_at"]:
            node.shutdown("as described", drain_s=2.0)
        _note(hook["name"], start_ns, _now_ns(node), taken, sent)
        if not sent:
            return None
        return packets[0] if len(packets) == 1 else tuple(packets)

    body.__name__ = hook["name"]
    return body


def _input(declared):
    port = All(declared["port"]) if declared["is_all"] else declared["port"]
    return Optional(port) if declared["is_optional"] else port


def _output(declared):
    return Optional(declared["port"]) if declared["is_optional"] else declared["port"]


def _mark(hook):
    if hook["kind"] == "finalise":
        return neuros_finalise()
    inputs, outputs = map(_input, hook["inputs"]), map(_output, hook["outputs"])
    ports = {"inputs": list(inputs), "outputs": list(outputs)}
    if hook["kind"] == "initialise":
        return neuros_initialise(**ports)
    if hook["kind"] == "tick":
        return neuros_tick(hook["seconds"], **ports)
    return neuros_function(**ports)


for _each in _NODE["hooks"]:
    globals()[_each["name"]] = _mark(_each)(_body(_each))
del _each
_note("", time.monotonic_ns(), time.monotonic_ns(), [], {})
