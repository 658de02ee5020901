"""Messages of the control channel: what goes in comes out, and what does not fit is refused."""

from __future__ import annotations

import re
import socket
import struct
from dataclasses import MISSING, fields
from itertools import accumulate, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros import control
from neuros.control import (
    FROM_NODES,
    FROM_OBSERVERS,
    TO_NODES,
    TO_OBSERVERS,
    Ended,
    Finalising,
    HookDeclaration,
    Hooks,
    LiveCounters,
    Message,
    NodeStatus,
    Probed,
    Report,
)
from neuros.control import steps as step_module
from neuros.control.link import ControlLink, decode, encode, kind_of
from neuros.control.steps import Advance, Advanced, Arrivals, StepLink
from neuros.errors import ControlError
from neuros.hooks import HookKind, InputSpec
from neuros.stacks import Stack

PAGE = Path(__file__).resolve().parents[1] / "docs" / "control_channel.md"
MESSAGES = dict.fromkeys([*FROM_NODES, *TO_NODES, *FROM_OBSERVERS, *TO_OBSERVERS])
ACCEPTED = {kind_of(each): each for each in MESSAGES}
METRICS: Any = {"state": {"state": "idle", "cause": ""}, "executing": None, "hooks": {}}
METRICS |= {"outgoing": {"a.o -> b.x": {"sent": 1}}, "incoming": {}, "accounting": {}}
REPORT = Report(
    node="a",
    waiting_for=("a.o -> b.x",),
    sim_time=1,
    timeline=((0.0, 1.5),),
    metrics=METRICS,
    stack=Stack("a", "step", "  line"),
)
VALUES = {
    "int": 3,
    "float": 0.5,
    "str": "text",
    "bool": True,
    "tuple[str, ...]": ("a", "b"),
    "Mapping[str, tuple[int, ...]]": {"a": (0, 2)},
    "Mapping[str, Mapping[str, Any]]": {"a": {"x": {"fields": ["y"]}}},
    "Metrics": METRICS,
}
RICH = [
    REPORT,
    Hooks("a", (HookDeclaration(HookKind.TICK, (InputSpec("x", True),), ("o",)),), ("end",)),
    NodeStatus("a", 1, 2.0, LiveCounters(1.0, METRICS, {"c": (2, (7, 8))}, {"c": (1, 9)}), {}),
    Ended(0, "why", {"a": REPORT}, 2.0, 0.5, True),
    Finalising("a", None),
]


def plain(kind: type[Message]) -> Message:
    """A message with a value in each field that needs one."""
    values = {}
    for each in fields(kind):  # type: ignore[arg-type]
        declared = str(each.type)
        if each.default is MISSING and each.default_factory is MISSING:
            empty: Any = {} if declared.startswith("Mapping") else ()
            values[each.name] = None if "None" in declared else VALUES.get(declared, empty)
    return kind(**values)


@pytest.mark.parametrize("message", [*map(plain, MESSAGES), *RICH], ids=lambda m: type(m).__name__)
def test_a_message_comes_out_as_it_went_in(message: Message) -> None:
    line = encode(message)
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert decode(line, ACCEPTED, "node 'a'") == message


class Pieces:
    """A stream that gives bytes piece by piece."""

    def __init__(self, *pieces: bytes) -> None:
        self._pieces = list(pieces)

    def recv(self, size: int) -> bytes:
        return self._pieces.pop(0)


def test_messages_come_out_wherever_the_stream_was_cut() -> None:
    stop, long = encode(control.Stop()), encode(control.Say("x" * 10_000))
    data = stop + long + stop + long
    for size in (1, 7, 4096, len(stop), len(data)):
        pieces = [data[begin : begin + size] for begin in range(0, len(data), size)]
        link = ControlLink(Pieces(*pieces), control.TO_NODES, "it")  # type: ignore[arg-type]
        found = [message for _ in pieces for message in link.receive() or ()]
        assert found == [control.Stop(), control.Say("x" * 10_000)] * 2


def test_half_a_character_arrives_as_its_escape() -> None:
    line = encode(control.Failed("a", "file '\udc80'"))
    assert decode(line, ACCEPTED, "a") == control.Failed("a", r"file '\udc80'")


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        (b"GET / HTTP/1.1", "sent something that is not a control message: b'GET / HTTP/1.1'"),
        (b"[1]", "sent something that is not a control message"),
        (b"7", "sent something that is not a control message"),
        (b'{"node": "a"}', "sent something that is not a control message"),
        (b'{"kind": "applaud"}', "sent a control message of the unknown kind 'applaud'"),
        (b'{"kind": ["stop"]}', "sent a control message of the unknown kind ['stop']"),
        (b'{"kind": "probe"}', "sent a wrong control message 'probe': field number is missing"),
        (b'{"kind": "stop", "now": 1}', "wrong control message 'stop': field now is unknown"),
        (b'{"kind": "probe", "number": true}', "'probe': field number is True, and must be int"),
        (b'{"kind": "probe", "number": 1.5}', "'probe': field number is 1.5, and must be int"),
        (b'{"kind": "say", "text": null}', "'say': field text is None, and must be str"),
        (b'{"kind": "hello", "nodes": "ab"}', "'hello': field nodes is 'ab', and must be a list"),
        (b'{"kind": "hello", "nodes": ["a", 2]}', "nodes[1] is 2, and must be str"),
        (
            b'{"kind": "report", "node": "a", "timeline": [[1]]}',
            "timeline[0] is [1], and must be a list of 2",
        ),
        (b'{"kind": "report", "node": "a", "metrics": 3}', "metrics is 3, and must be an object"),
        (
            b'{"kind": "hooks", "node": "a", "hooks": [{"kind": "tock"}], "finalise": []}',
            "hooks[0].kind is 'tock', and must be one of initialise, tick, function, reset,"
            " finalise",
        ),
        (
            b'{"kind": "drain", "last_round": {"a": [0, "1"]}}',
            "last_round['a'][1] is '1', and must be int",
        ),
        (
            b'{"kind": "ended", "exit_code": 0, "reason": "", "reports": {"a": {}},'
            b' "running_s": null, "real_time_factor": null}',
            "field reports['a'].node is missing",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_its_sender_kind_and_field(
    line: bytes, complaint: str
) -> None:
    with pytest.raises(ControlError) as caught:
        decode(line, ACCEPTED, "node 'a'")
    assert str(caught.value).startswith("node 'a' sent ")
    assert complaint in str(caught.value)


def test_a_message_is_accepted_only_by_those_for_whom_it_is() -> None:
    with pytest.raises(ControlError, match="unknown kind 'stop'"):
        decode(encode(control.Stop()), {kind_of(each): each for each in FROM_NODES}, "node 'a'")


def test_a_probe_is_a_report() -> None:
    probed = plain(Probed)
    assert isinstance(probed, Report)
    assert not isinstance(REPORT, Probed)


def test_every_class_of_messages_has_a_sender() -> None:
    classes = [each for each in vars(control).values() if isinstance(each, type)]
    assert {each for each in classes if issubclass(each, Message)} == {Message, *MESSAGES}


def table(kinds: Any) -> str:
    """What the page shows of them."""
    rows = ["| kind | fields | meaning |", "| --- | --- | --- |"]
    for kind in kinds:
        names = ", ".join(f"`{each.name}`" for each in fields(kind))
        meaning = str(kind.__doc__).partition("\n\n")[0].replace("``", "`").replace("\n   ", "")
        rows.append(f"| `{kind_of(kind)}` | {names} | {meaning} |")
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


STEPS = [
    Advance(1, 1, {}, []),
    Advance(7, 2, {"robot.imu": 3}, [("robot", "wheels", b"abcd"), ("robot", "arm", b"")]),
    Advanced(7, {"robot": 0.25}, {"robot.imu": (4, b"12345678"), "robot.eye": (1, bytes(200_000))}),
    Advanced(8, {}, {}),
]


def read_in_pieces(data: bytes, kind: Any, sizes: list[int]) -> list[Any]:
    """The messages in these bytes, of which reads bring so many each."""
    pieces = [data[end - size : end] for size, end in zip(sizes, accumulate(sizes), strict=True)]
    stream: Any = SimpleNamespace(recv=lambda _: pieces.pop(0))
    link: StepLink[Any] = StepLink(stream, kind, "the session")
    return [message for _ in sizes for message in link.receive() or ()]


@given(st.lists(st.sampled_from(STEPS), max_size=4), st.data())
def test_a_step_comes_out_as_it_went_in_however_its_bytes_arrive(
    steps: list[Any], data: st.DataObject
) -> None:
    for kind in (Advance, Advanced):
        sent = [each for each in steps if type(each) is kind]
        stream = b"".join(each.to_frame() for each in sent)
        cuts = data.draw(st.sets(st.integers(0, len(stream))))
        sizes = [end - start for start, end in pairwise(sorted({0, *cuts, len(stream)}))]
        assert read_in_pieces(stream, kind, sizes) == sent


@pytest.mark.parametrize(
    ("head", "body"),
    [
        (b"nothing", b""),
        (b"[1, 1, {}]", b""),
        (b"[1, 1, {}, [], 5]", b""),
        (b'["1", 1, {}, []]', b""),
        (b"[1, true, {}, []]", b""),
        (b'[1, 1, {"a.x": "new"}, []]', b""),
        (b'[1, 1, {}, [["a", "x", 3]]]', b"1234"),
        (b'[1, 1, {}, [["a", "x", -4], ["a", "y", 8]]]', b"1234"),
        (b'[1, 1, {}, [["a", 5, 4]]]', b"1234"),
        (b'[1, 1, {}, [["a", 4]]]', b"1234"),
        (b"[" * 100_000, b""),
        (b"\xff", b""),
    ],
)
def test_a_frame_that_is_no_step_is_refused_by_the_name_of_its_sender(
    head: bytes, body: bytes
) -> None:
    frame = struct.pack("<II", len(head), len(body)) + head + body
    with pytest.raises(ControlError, match=r"the session sent a frame that is no step: ."):
        read_in_pieces(frame, Advance, [len(frame)])


class Poll:
    """Stands for ``select.poll``: nothing is ever readable. It notes how long it may sleep."""

    def __init__(self) -> None:
        self.asked_ms: list[float | None] = []

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]:
        self.asked_ms.append(timeout_ms)
        return []


def test_waits_in_vain_sleep_at_once_more_and_more_often(monkeypatch: pytest.MonkeyPatch) -> None:
    poll = Poll()
    monkeypatch.setattr(step_module, "select", SimpleNamespace(poll=lambda: poll))
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
