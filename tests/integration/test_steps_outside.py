"""A step of a paused run, while other programs go on publishing on external topics."""

from __future__ import annotations

import contextlib
import json
import select
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from launching import BACKENDS
from ros_program import RosProgram

import neuros
from neuros.api.live import LiveRun
from neuros.backends.control_sockets import connect
from neuros.backends.domain import choose_domain
from neuros.control import (
    TO_OBSERVERS,
    GetStatus,
    Message,
    NodeStatus,
    Pause,
    Resume,
    Step,
    Watch,
)
from neuros.control.link import ControlLink
from neuros.transport.messages import message_class

STRING = "std_msgs/msg/String"
LIMIT_S = 60.0
BEATS = """
from neuros.hooks import neuros_tick
@neuros_tick(seconds=0.02)
def beat(node):
    pass
"""
HEARS = """
from neuros.hooks import neuros_function
@neuros_function(inputs="x")
def hear(node, x):
    with (node.run_dir / "heard").open("a") as file:
        file.write(x.data + "\\n")
"""


def project(folder: Path) -> Path:
    (folder / "drum.py").write_text(BEATS)
    (folder / "ear.py").write_text(HEARS)
    node = {"container": "neuros_python"}
    x = {"name": "x", "type": STRING, "external_topic": "/said"}
    ear = {**node, "name": "ear", "plugin": "ear.py", "inputs": [x]}
    nodes = [{**node, "name": "drum", "plugin": "drum.py"}, ear]
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": []}))
    return file


class Speaker:
    """Publishes all the time, and observes the run meanwhile."""

    def __init__(self, program: RosProgram, live: LiveRun, heard: Path) -> None:
        self._publisher = program.node.create_publisher(message_class(STRING), "/said", 10)
        self._link = observing(live)
        self._heard = heard
        self.beats = self.heard = self.arrived = self._said = 0
        self.is_paused = False

    def wish(self, message: Message) -> None:
        self._link.send(message)

    def close(self) -> None:
        self._link.close()

    def speak_until(self, condition: Callable[[], bool]) -> None:
        """Publish, and look at the run, until a condition holds."""
        deadline_s = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < deadline_s, f"not within {LIMIT_S:g} s"
            self._said += 1
            self._publisher.publish(message_class(STRING)(data=str(self._said)))
            self._look()

    def speak_for(self, packets: int) -> None:
        """Publish, and look at the run, until so many more packets have arrived."""
        arrived = self.arrived + packets
        self.speak_until(lambda: self.arrived >= arrived)

    def heard_since(self, count: int) -> list[int]:
        """The numbers of the packets that its hook has taken after the first ``count``."""
        return [int(line) for line in self._heard.read_text().split()[count:]]

    def _look(self) -> None:
        self._link.send(GetStatus({}))
        while select.select([self._link], [], [], 0.02)[0]:
            for message in self._link.receive() or ():
                if isinstance(message, NodeStatus) and message.counters is not None:
                    metrics = message.counters.metrics
                    if message.node == "drum":
                        self.beats = metrics["hooks"]["beat"]["executions"]
                    else:
                        self.heard = metrics["hooks"]["hear"]["executions"]
                        self.arrived = sum(c["received"] for c in metrics["incoming"].values())
                        self.is_paused = metrics["state"]["state"] == "paused"


def observing(live: LiveRun) -> ControlLink:
    """An observer of a run, as soon as that lets it in."""
    while True:
        with contextlib.suppress(OSError):
            link = ControlLink(connect(live.control_address), TO_OBSERVERS, "the supervisor")
            link.send(Watch())
            return link


@pytest.fixture(params=BACKENDS)
def speaker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Speaker]:
    with (
        choose_domain(None, {}, False) as domain,
        RosProgram(domain_id=domain.id) as program,
        neuros.Project.from_file(project(tmp_path)).start(
            backend=request.param, domain_id=domain.id, output=tmp_path / "run"
        ) as live,
    ):
        speaker = Speaker(program, live, tmp_path / "run/ear/heard")
        yield speaker
        speaker.close()


def test_a_step_takes_what_had_come_before_it_and_then_the_run_is_paused_again(
    speaker: Speaker,
) -> None:
    speaker.speak_until(lambda: speaker.heard > 0 and speaker.beats > 0)
    speaker.wish(Pause())
    speaker.speak_until(lambda: speaker.is_paused)
    for _ in range(2):
        beats, heard = speaker.beats, speaker.heard
        speaker.speak_for(20)
        assert (speaker.beats, speaker.heard) == (beats, heard)
        speaker.wish(Step(1))
        speaker.speak_until(
            lambda beats=beats, heard=heard: speaker.beats > beats and speaker.heard > heard
        )
        speaker.speak_for(20)  # by then it has taken each packet of the step
        assert speaker.beats == beats + 1
        # Its queue holds ten; one that comes while they are taken drives the oldest out.
        taken = speaker.heard_since(heard)
        assert len(taken) == speaker.heard - heard
        assert 0 < len(taken) <= 10
        assert taken == [*range(taken[0], taken[0] + len(taken))]
    beats, heard = speaker.beats, speaker.heard
    speaker.speak_for(20)
    assert (speaker.beats, speaker.heard) == (beats, heard)
    speaker.wish(Resume())
    speaker.speak_until(lambda: speaker.beats > beats + 3 and speaker.heard > heard + 20)
