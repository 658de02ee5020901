"""Nodes that cannot follow what they are sent: fresh and fair on every back end (Arrivals first).

The project ``overload`` is run once per back end and executor. Its nodes note when each packet was
sent and when a hook started on it. The bounds are those of the rules, and a second besides for
machines that are busy with other things; a node that works on a backlog is behind by more.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from launching import Finished, launch

from containers import require_containers
from neuros.transport.ros_loop import EXECUTOR_VARIABLE

PROJECT = Path(__file__).parent / "overload"
DURATION_S = 6
SLACK_S = 0.8
TIMER_S = 0.25
VARIANTS = (
    "process",
    "in-process",
    # In containers nodes run as in processes; the loop on a wait set: test_executors.py.
    pytest.param("process on a wait set", marks=pytest.mark.acceptance),
    pytest.param("docker", marks=pytest.mark.acceptance),
)


class Take(NamedTuple):
    """A hook or callback that has started on a packet."""

    hook: str
    number: int
    sent_s: float
    start_s: float
    end_s: float

    @property
    def age_s(self) -> float:
        return self.start_s - self.sent_s

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


class Run:
    """What the nodes of a run have noted."""

    def __init__(self, finished: Finished, *, is_in_process: bool) -> None:
        assert finished.exit_code == 0, finished.output
        assert finished.run_folder is not None
        self._folder = finished.run_folder
        self.record = finished.record
        self.is_in_process = is_in_process

    def takes(self, node: str, *hooks: str) -> list[Take]:
        text = (self._folder / node / "taken.txt").read_text()
        takes = [
            Take(hook, int(number), *(int(ns) / 1e9 for ns in times_ns))
            for hook, number, *times_ns in map(str.split, text.splitlines())
        ]
        return [take for take in takes if not hooks or take.hook in hooks]

    def sent(self, output: str) -> list[tuple[int, float]]:
        """Number and time of every packet of an output of the source."""
        text = (self._folder / "source" / f"sent_{output}.txt").read_text()
        return [(int(number), int(ns) / 1e9) for number, ns in map(str.split, text.splitlines())]

    def round_s(self, node: str) -> float:
        """One execution of each hook and callback that a packet may have to wait for."""
        nodes = ("brain", "eyes", "slow", "simulator", "listener")
        longest: dict[tuple[str, str], float] = {}
        for each in nodes if self.is_in_process else (node,):
            for take in self.takes(each):
                key = (each, take.hook)
                longest[key] = max(longest.get(key, 0.0), take.duration_s)
        return sum(longest.values()) + SLACK_S


@pytest.fixture(scope="module")
def run_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Run]:
    @cache
    def run(variant: str) -> Run:
        back_end, _, executor = variant.partition(" on a ")
        with pytest.MonkeyPatch.context() as patch:
            if executor:
                patch.setenv(EXECUTOR_VARIABLE, executor.replace(" ", "_"))
            finished = launch(
                PROJECT,
                *("--backend", back_end, "--duration", str(DURATION_S)),
                cwd=tmp_path_factory.mktemp("overload"),
                timeout_s=60.0,
            )
        return Run(finished, is_in_process=back_end == "in-process")

    return run


@pytest.fixture(params=VARIANTS)
def run(request: pytest.FixtureRequest, run_once: Callable[[str], Run]) -> Run:
    if request.param == "docker":
        require_containers()
    return run_once(request.param)


@pytest.mark.parametrize(
    ("node", "hook", "output", "queue_size"),
    [
        ("brain", "look", "image", 1),
        ("eyes", "left", "left", 1),
        ("eyes", "right", "right", 4),
        ("slow", "work", "limited", 1),
    ],
)
def test_a_hook_that_may_lose_packets_starts_on_the_newest_and_never_on_a_backlog(
    node: str, hook: str, output: str, queue_size: int, run: Run
) -> None:
    sent, round_s = run.sent(output), run.round_s(node)
    takes = run.takes(node, hook)
    assert takes
    for take in takes:
        newest = max((n for n, sent_s in sent if sent_s < take.start_s - round_s), default=0)
        assert take.number > newest - queue_size, take


def test_a_limit_is_no_longer_queue(run: Run) -> None:
    books = {each["connection"]: each for each in run.record["connections"]}
    limited = books["source.limited -> slow.limited"]
    assert limited["sent"] == limited["received"]
    assert limited["longest_discard"] <= 3
    if not run.is_in_process:  # where no tick is due while another node works
        assert limited["discarded"] > limited["consumed"]


@pytest.mark.parametrize(
    ("node", "hooks"), [("eyes", ("left", "right")), ("listener", ("hear", "callback"))]
)
def test_no_input_starves_another_however_fast_it_is(
    node: str, hooks: tuple[str, str], run: Run
) -> None:
    one, other = (len(run.takes(node, hook)) for hook in hooks)
    assert min(one, other) > 0
    assert abs(one - other) <= 0.25 * max(one, other) + 2


@pytest.mark.parametrize(("node", "hook"), [("brain", "obey"), ("simulator", "step")])
def test_a_packet_waits_for_one_execution_of_each_hook_at_most(
    node: str, hook: str, run: Run
) -> None:
    executions = run.takes(node, hook)
    takes = [take for take in executions if take.number]
    assert [take.number for take in takes] == [*range(1, len(takes) + 1)]
    assert takes[-1].number >= len(run.sent("command")) - 1
    # What had been sent before the node had begun has waited for that.
    begin_s = executions[0].start_s
    waits_s = [take.start_s - max(take.sent_s, begin_s) for take in takes]
    assert max(waits_s) <= run.round_s(node)


def test_timers_and_subscriptions_of_a_plugin_are_served_between_hooks(run: Run) -> None:
    starts_s = [take.start_s for take in run.takes("listener", "timer")]
    pauses_s = [after - before for before, after in itertools.pairwise(starts_s)]
    assert max(pauses_s) <= TIMER_S + run.round_s("listener")
    heard = run.takes("listener", "hear", "callback")
    # What had been sent before the node had begun has waited for that.
    late = [take for take in heard if take.sent_s > heard[0].start_s]
    assert max(take.age_s for take in late) <= run.round_s("listener")


def test_every_lossless_packet_arrives(run: Run) -> None:
    for books in run.record["connections"]:
        if books["discard_limit"] == 0:
            assert books["sent"] == books["received"] > 0, books
