"""What an agent sends of its nodes, while its launcher takes less than they write."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from neuros.cli.agent import Agent
from neuros.control import Message
from neuros.control.machines import Chunk, Finished, NodeEnded


@dataclass
class Process:
    """A node that runs, or has ended so."""

    how: int | None = None

    def poll(self) -> int | None:
        return self.how


class Writing:
    """Each file has as much more, whenever it is looked at."""

    def grown(self, node: str) -> Iterator[Chunk]:
        return self._chunks(f"{node}/node.log")

    def rest(self) -> Iterator[Chunk]:
        return self._chunks("recording.mcap")

    def _chunks(self, path: str) -> Iterator[Chunk]:
        data = b64encode(bytes(1 << 16)).decode()
        yield from (Chunk(path, number << 16, data) for number in range(100))


@dataclass
class Sent:
    """What a pump would have sent."""

    messages: list[Message] = field(default_factory=list)

    def send(self, message: Message) -> None:
        self.messages.append(message)

    send_last = send

    def end(self) -> None: ...
    def join(self) -> None: ...

    @property
    def paths(self) -> list[str]:
        return [each.path for each in self.messages if isinstance(each, Chunk)]


@pytest.fixture
def agent() -> Agent:
    """One without a launcher and processes of its own."""
    agent = Agent.__new__(Agent)
    agent._pump, agent._follower = Sent(), Writing()  # type: ignore[assignment]
    agent._monitor, agent._in_flight_bytes, agent._is_lost = None, 0, False
    agent._processes = {"loud": Process(), "ended": Process(3), "other": Process()}  # type: ignore[dict-item]
    return agent


def sent(agent: Agent) -> Sent:
    assert isinstance(agent._pump, Sent)
    return agent._pump


def test_that_a_node_has_ended_is_told_whatever_another_writes(agent: Agent) -> None:
    agent._look()
    assert NodeEnded("ended", 3) in sent(agent).messages
    assert sent(agent).paths.count("ended/node.log") == 100  # its last words are not cut off


def test_nodes_take_turns(agent: Agent) -> None:
    del agent._processes["ended"]
    assert agent._look()
    assert {*sent(agent).paths} == {"loud/node.log"}
    assert not agent._look()
    agent._in_flight_bytes = 0
    assert agent._look()
    assert "other/node.log" in sent(agent).paths


def test_where_nobody_takes_it_the_rest_is_not_queued(agent: Agent) -> None:
    agent._is_lost = True
    agent._finish()
    assert sent(agent).messages == [Finished(None, ())]
