"""Messages of the control channel: what goes in comes out, and what does not fit is refused."""

from __future__ import annotations

import collections.abc
import re
import socket
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_origin

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import fields

from neuros import control
from neuros.control import (
    FROM_NODES,
    FROM_OBSERVERS,
    TO_NODES,
    TO_OBSERVERS,
    Advance,
    AtRest,
    Ended,
    Finalising,
    HookDeclaration,
    Hooks,
    LiveCounters,
    Message,
    Metrics,
    NodeProbe,
    NodeStatus,
    Probed,
    Report,
)
from neuros.control import link as link_module
from neuros.control.link import (
    Arrivals,
    ControlLink,
    decode,
    decoder_of,
    encode,
    remove_messages,
    to_bytes,
)
from neuros.errors import ControlError
from neuros.hooks import HookKind, InputSpec
from neuros.stacks import Stack

PAGE = Path(__file__).resolve().parents[1] / "docs" / "control_channel.md"
MESSAGES = dict.fromkeys([*FROM_NODES, *TO_NODES, *FROM_OBSERVERS, *TO_OBSERVERS])
DECODER = decoder_of(tuple(MESSAGES))
METRICS: Any = {"state": {"state": "idle", "cause": ""}, "executing": None, "hooks": {}}
METRICS |= {"outgoing": {}, "incoming": {}, "accounting": {}}
REPORT = Report(
    node="a",
    waiting_for=("a.o -> b.x",),
    sim_time=1,
    timeline=((0.0, 1.5),),
    metrics=METRICS,
    stack=Stack("a", "step", "  line"),
)
VALUES: dict[Any, Any] = {
    int: 3,
    float: 0.5,
    str: "text",
    bool: True,
    bytes: b"\x00\xff",
    tuple[str, ...]: ("a", "b"),
    Mapping[str, tuple[int, ...]]: {"a": (0, 2)},
    Mapping[str, Mapping[str, Any]]: {"a": {"x": {"fields": ["y"]}}},
    Metrics: METRICS,
}
RICH = [
    REPORT,
    Hooks("a", (HookDeclaration(HookKind.TICK, (InputSpec("x", True),), ("o",)),), ("end",)),
    NodeStatus("a", 1, 2.0, LiveCounters(1.0, METRICS, {"c": (2, (7, 8))}, {"c": (1, 9)}), {}),
    Ended(0, "why", {"a": REPORT}, 2.0, 0.5, True),
    Finalising("a", None),
    Advance(7, 2, {"a.o": 3}),
    AtRest(7, {"a": 0.25}, {"a.o": (4, [bytes(200_000), b"x"]), "a.p": (1, [b""])}),
    Probed(7, {"a": NodeProbe(sent={"c": (3, 2)}, unread=frozenset({"d"}))}, {"a.o": (1, [b""])}),
]


def plain(kind: type[Message]) -> Message:
    """A message with a value in each field that needs one."""
    values = {}
    for each in fields(kind):
        if each.required:
            empty: Any = {} if get_origin(each.type) is collections.abc.Mapping else ()
            is_optional = type(None) in get_args(each.type)
            values[each.name] = None if is_optional else VALUES.get(each.type, empty)
    return kind(**values)


@pytest.mark.parametrize("message", [*map(plain, MESSAGES), *RICH], ids=lambda m: type(m).__name__)
def test_a_message_comes_out_as_it_went_in(message: Message) -> None:
    assert decode(to_bytes(message), DECODER, "node 'a'") == message


class Pieces:
    """A stream that gives bytes piece by piece."""

    def __init__(self, *pieces: bytes) -> None:
        self._pieces = list(pieces)

    def recv(self, size: int) -> bytes:
        return self._pieces.pop(0)


@given(st.lists(st.sampled_from(RICH), max_size=4), st.data())
def test_messages_come_out_wherever_the_stream_was_cut(
    sent: list[Message], data: st.DataObject
) -> None:
    stream = b"".join(map(encode, sent))
    cuts = sorted({*data.draw(st.sets(st.integers(1, len(stream)))), len(stream)}) if stream else []
    pieces = [stream[start:end] for start, end in pairwise([0, *cuts])]
    link = ControlLink(Pieces(*pieces), [*MESSAGES], "it")  # type: ignore[arg-type]
    assert [message for _ in pieces for message in link.receive() or ()] == sent


def test_half_a_character_arrives_as_its_escape() -> None:
    data = bytearray(encode(control.NodeStatus("a", 1, samples={"\udc80": {"x": ["\udc81"]}})))
    (found,) = remove_messages(data, "a")
    escaped = {r"\udc80": {"x": [r"\udc81"]}}
    assert decode(found, DECODER, "a") == control.NodeStatus("a", 1, samples=escaped)


def test_a_number_of_numpy_arrives_as_a_plain_one() -> None:
    data = to_bytes(control.Shutdown("a", np.str_("done"), np.float64(0.5)))
    assert decode(data, DECODER, "a") == control.Shutdown("a", "done", 0.5)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ([1], "Expected `object`, got `array`"),
        (7, "Expected `object`, got `int`"),
        ({"node": "a"}, "missing required field `kind`"),
        ({"kind": "applaud"}, "Invalid value 'applaud'"),
        ({"kind": ["stop"]}, "Expected `str`, got `array` - at `$.kind`"),
        ({"kind": "probe"}, "missing required field `number`: b'\\x81\\xa4kind\\xa5probe'"),
        ({"kind": "stop", "now": 1}, "unknown field `now`"),
        ({"kind": "probe", "number": True}, "Expected `int`, got `bool` - at `$.number`"),
        ({"kind": "probe", "number": 1.5}, "Expected `int`, got `float` - at `$.number`"),
        ({"kind": "publish_state", "text": None}, "Expected `str`, got `None` - at `$.text`"),
        ({"kind": "hello", "nodes": ["a", 2]}, "Expected `str`, got `int` - at `$.nodes[1]`"),
        ({"kind": "report", "node": "a", "timeline": [[1]]}, "of length 2, got 1"),
        ({"kind": "report", "node": "a", "metrics": 3}, "got `int` - at `$.metrics`"),
        (
            {"kind": "hooks", "node": "a", "hooks": [{"kind": "tock"}], "finalise": []},
            "Invalid enum value 'tock' - at `$.hooks[0].kind`",
        ),
        ({"kind": "drain", "last_round": {"a": [0, "1"]}}, "at `$.last_round[...][1]`"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_sender_and_field(
    content: Any, complaint: str
) -> None:
    with pytest.raises(ControlError) as caught:
        decode(msgspec.msgpack.encode(content), DECODER, "node 'a'")
    assert str(caught.value).startswith("node 'a' sent a wrong control message: ")
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    "data", [b"", b"\xff", b"\x81", b"\x81\xa4kind\xa1\xff", b"\x91" * 100_000]
)
def test_bytes_that_are_no_messagepack_are_refused_with_their_sender(data: bytes) -> None:
    with pytest.raises(ControlError, match=r"node 'a' sent a wrong control message: ."):
        decode(data, DECODER, "node 'a'")


def test_text_of_another_protocol_is_refused_before_it_ends() -> None:
    link = ControlLink(Pieces(b"GET / HTTP/1.1"), control.TO_NODES, "it")  # type: ignore[arg-type]
    with pytest.raises(ControlError, match="it sent something that is not a control message: b'GE"):
        link.read()


def test_a_message_is_accepted_only_by_those_for_whom_it_is() -> None:
    with pytest.raises(ControlError, match="Invalid value 'stop'"):
        decode(to_bytes(control.Stop()), decoder_of(tuple(FROM_NODES)), "node 'a'")


def test_every_class_of_messages_has_a_sender() -> None:
    classes = [each for each in vars(control).values() if isinstance(each, type)]
    assert {each for each in classes if issubclass(each, Message)} == {Message, *MESSAGES}


def table(kinds: Any) -> str:
    """What the page shows of them."""
    rows = ["| kind | fields | meaning |", "| --- | --- | --- |"]
    for kind in kinds:
        names = ", ".join(f"`{each.name}`" for each in fields(kind))
        meaning = str(kind.__doc__).partition("\n\n")[0].replace("``", "`").replace("\n   ", "")
        rows.append(f"| `{kind.__struct_config__.tag}` | {names} | {meaning} |")
    return "\n".join(rows)


@pytest.mark.parametrize(
    ("title", "kinds"),
    [
        ("From a node process", FROM_NODES),
        ("To node processes", TO_NODES),
        ("From an observer", FROM_OBSERVERS),
        ("To observers", TO_OBSERVERS),
    ],
)
def test_the_page_shows_the_messages_as_they_are(title: str, kinds: Any) -> None:
    text = PAGE.read_text("utf-8")
    section = re.split(rf"^### {title}$", text, flags=re.MULTILINE)[1]
    assert section.split("\n### ")[0].split("\n## ")[0].strip() == table(kinds)


class Poll:
    """Stands for ``select.poll``: nothing is ever readable. It notes how long it may sleep."""

    def __init__(self) -> None:
        self.asked_ms: list[float | None] = []

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]:
        self.asked_ms.append(timeout_ms)
        return []


def test_waits_in_vain_sleep_at_once_more_and_more_often(monkeypatch: pytest.MonkeyPatch) -> None:
    poll = Poll()
    monkeypatch.setattr(link_module, "select", SimpleNamespace(poll=lambda: poll))
    arrivals, awake = Arrivals(), []
    for _ in range(1 + 1 + 1 + 3 + 1 + 7):
        assert arrivals.wait(5.0) == []
        awake.append(0 in poll.asked_ms)
        assert poll.asked_ms[-1] == 5.0
        poll.asked_ms.clear()
    assert awake == [True, False, True, *[False] * 3, True, *[False] * 7]


@pytest.mark.parametrize("vain", [0, 1, 2])
def test_what_is_readable_is_found_awake_or_asleep(vain: int) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        arrivals = Arrivals()
        arrivals.register(ours)
        for _ in range(vain):
            assert arrivals.wait(0.0) == []
        theirs.sendall(b"!")
        assert arrivals.wait(None) == [ours.fileno()]
        arrivals.unregister(ours)
        assert arrivals.wait(0.0) == []
