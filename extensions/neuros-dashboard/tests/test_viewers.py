"""Which viewers are taken for what a user asks for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import pytest
from neuros_dashboard import viewer
from neuros_dashboard.viewer import Shown, Viewer, Views

from neuros.errors import EnvironmentFault
from neuros.ports import BackEnd, Guardian
from neuros.project.load import load_project
from neuros.registry import BACK_ENDS

PROCESS = BACK_ENDS.load("process")
CLOCK = Path(__file__).parents[3] / "examples/1_tick/clock"


class Screen(Viewer):
    """Stands for a viewer: it shows nothing, and notes what is asked of it."""

    def __init__(self, name: str, ranks: Mapping[str, int], why_not: str = "") -> None:
        self.name, self.place, self.ranks = name, f"the {name}", ranks
        self.why_not = why_not
        self.asked: list[tuple[Any, ...]] = []

    def prepare(self, back_end: BackEnd, subject: str | None, port: int | None) -> Screen:
        self.asked.append((subject, port))
        if self.why_not:
            raise EnvironmentFault(self.why_not)
        return self

    def start(self, run: Shown, guardian: Guardian) -> str:
        return f"{self.name}: open on {run.project.name}"

    def finish(self) -> None:
        self.asked.append(("finish",))


class Screens(dict[str, Screen]):
    """Stands for the registry."""

    load = dict.__getitem__


@pytest.fixture
def screens(monkeypatch: pytest.MonkeyPatch) -> Screens:
    every = [
        Screen("page", {"graph": 0}),
        Screen("window", {"graph": 2}),
        Screen("best", {"graph": 3, "packets": 1}, why_not="best needs a display"),
    ]
    screens = Screens({each.name: each for each in every})
    monkeypatch.setattr(viewer, "VIEWERS", screens)
    return screens


def started(views: Views) -> list[str]:
    """What the user is told."""
    lines: list[str] = []
    run = Shown("id", CLOCK, {}, {}, load_project(CLOCK, workspace=CLOCK).project, ["clock"], False)
    views.start(run, cast("Guardian", None), lambda _, line: lines.append(line))
    return lines


def test_a_subject_is_shown_by_the_best_viewer_that_can_be_used(screens: Screens) -> None:
    views = Views(PROCESS, [], {"--node-graph": "graph"})
    assert started(views) == [
        "--node-graph: in the window, since best needs a display",
        "window: open on clock",
    ]
    assert screens["window"].asked == [("graph", None)]
    assert not screens["page"].asked


def test_what_no_viewer_can_show_is_refused_with_every_reason(screens: Screens) -> None:
    screens["window"].why_not = "window is shut"
    screens["page"].why_not = "page is torn"
    with pytest.raises(EnvironmentFault) as refused:
        Views(PROCESS, [], {"--node-graph": "graph"})
    assert str(refused.value) == (
        "--node-graph: best needs a display, and window is shut, and page is torn"
    )


def test_a_viewer_is_taken_by_its_name_with_the_port(screens: Screens) -> None:
    views = Views(PROCESS, ["page"], {}, port=8080)
    assert started(views) == ["page: open on clock"]
    views.finish()
    assert screens["page"].asked == [(None, 8080), ("finish",)]


def test_a_viewer_that_is_asked_for_twice_is_opened_once(screens: Screens) -> None:
    views = Views(PROCESS, ["window", "window"], {"--node-graph": "graph"})
    assert started(views)[1:] == ["window: open on clock"]
    assert screens["window"].asked == [("graph", None)]


def test_a_viewer_that_cannot_be_used_is_refused_by_its_name(screens: Screens) -> None:
    with pytest.raises(EnvironmentFault, match=r"^viewer best: best needs a display$"):
        Views(PROCESS, ["best"], {})
