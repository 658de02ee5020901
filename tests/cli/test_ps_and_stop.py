"""`neuros ps` and `neuros stop`: whose runs they show and stop, and what dead ones have left."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import pytest

from neuros.backends.sessions import RunOnThisMachine
from neuros.cli import live
from neuros.cli.main import main

NOBODY = 65534


def test_what_killed_runs_have_left_is_removed_and_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live, "sessions", list)
    monkeypatch.setattr(live, "remove_dead_runs", lambda: ("neuros_12", "neuros_34_image"))
    assert main(["stop"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "nothing is running",
        "removed neuros_12 from shared memory: its run was killed, and its guardian, too",
        "removed neuros_34_image from shared memory: its run was killed, and its guardian, too",
    ]


class Machine:
    """Runs that can be interrupted, and are then gone."""

    def __init__(self) -> None:
        self.there: list[RunOnThisMachine] = []
        self.stopped: list[str] = []

    def add(self, run: str, project: str, user: int) -> None:
        machine = self

        class Run(RunOnThisMachine):
            def interrupt(self) -> None:
                machine.stopped.append(self.run)
                machine.there.remove(self)

        self.there.append(
            Run(run, project, "process", ("a",), f"/runs/{run}", 0.0, (1, 1), user=user)
        )


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    """A run of one's own, and two of another user, as root sees them."""
    machine = Machine()
    machine.add("a" * 16, "demo", os.getuid())
    machine.add("b" * 16, "demo", NOBODY)
    machine.add("c" * 16, "other", NOBODY)
    monkeypatch.setattr(live, "sessions", lambda: list(machine.there))
    monkeypatch.setattr(live, "remove_dead_runs", tuple)
    return machine


def test_runs_of_others_are_shown_with_their_user(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ps"]) == 0
    header, _, *rows = capsys.readouterr().out.splitlines()
    assert header.split()[:3] == ["run", "user", "project"]
    assert [row.split()[:3] for row in rows[1:]] == [
        ["b" * 8, "nobody", "demo"],
        ["c" * 8, "nobody", "other"],
    ]
    del machine.there[1:]
    main(["ps"])
    assert "user" not in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [(), ("--all",), ("demo",), ("a",)])
def test_what_is_not_named_by_its_id_is_stopped_only_if_it_is_ones_own(
    machine: Machine, arguments: Sequence[str]
) -> None:
    assert main(["stop", *arguments]) == 0
    assert machine.stopped == ["a" * 16]


def test_a_run_of_another_user_is_stopped_by_its_id(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stop", "other"]) == 2
    assert "you have no run called 'other'; yours are: aaaaaaaa (demo)" in capsys.readouterr().err
    assert main(["stop", "bbbb"]) == 0
    assert machine.stopped == ["b" * 16]


def test_a_run_that_saves_something_is_waited_for_and_interrupted_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second interrupt would kill it."""
    interrupts: list[str] = []

    class Saves(RunOnThisMachine):
        def interrupt(self) -> None:
            interrupts.append(self.run)

    run = Saves("a" * 16, "demo", "process", ("a",), "/runs/a", 0.0, (1, 1), user=os.getuid())
    looks = iter(range(20))
    monkeypatch.setattr(live, "sessions", lambda: [run] if next(looks, None) is not None else [])
    monkeypatch.setattr(live, "remove_dead_runs", tuple)
    monkeypatch.setattr(live, "_REMARK_S", 0.2)
    assert main(["stop"]) == 0
    assert interrupts == [run.run]
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "still ending: aaaaaaaa; `neuros stop aaaaaaaa` once more kills"


def test_where_others_have_runs_only_there_is_nothing_of_ones_own_to_stop(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    del machine.there[0]
    assert main(["stop"]) == 0
    assert capsys.readouterr().out == "you have no run in progress\n"
    assert machine.stopped == []
