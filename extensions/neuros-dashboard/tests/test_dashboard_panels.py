"""Panels of the dashboard and their layout, in a real browser."""

from __future__ import annotations

import json
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from browser import browser_page
from launching import start
from needs import COMPILER
from visitor import Visitor, address

from neuros.cli.main import main
from neuros.project.load import load_project

RING = Path(__file__).with_name("ring")
NEURONS, IN_BUMP, STEP_S = 60, 11, 0.01  # of spiking_ring.py
SHOWN = """() => [...document.querySelectorAll('main > section')]
    .filter((section) => section.checkVisibility()).map((section) => section.dataset.panel)"""
PEAK = "() => document.querySelector('[data-panel=activity] canvas')?.dataset.peak"
BACK = """(slider) => {
    slider.value = Number(slider.value) - 1.0;
    slider.dispatchEvent(new Event('input'));
}"""
COLOURS = """() => {
    const canvas = document.querySelector('[data-panel=activity] canvas');
    const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    return new Set(new Uint32Array(data.buffer)).size;
}"""


def in_panel(kind: str, rest: str = "") -> str:
    return f"[data-panel={kind}] {rest}"


def written(page: Any) -> Any:
    """The layout that the page tells the user to put into the project file."""
    return json.loads("{" + page.input_value("#layout-text") + "}")


with_reports = pytest.mark.skipif(
    find_spec("neuros_analysis") is None, reason="the report of the run is neuros-analysis's"
)


@with_reports
def test_a_bump_is_seen_moving_in_the_layout_of_the_project_which_a_user_changes(
    tmp_path: Path,
) -> None:
    with (
        start(RING, "--dashboard", "--record", "--backend", "in-process", cwd=tmp_path) as running,
        browser_page() as page,
    ):
        url = address(running)
        page.goto(url)

        # The project's panels, in its order, and a heat map whose peak goes round.
        page.wait_for_function(f"() => ({PEAK})() !== undefined")
        assert page.evaluate(SHOWN) == ["activity", "graph", "details", "connections"]
        first = page.evaluate(PEAK)
        page.wait_for_function(f"(first) => ({PEAK})() !== first", arg=first)
        page.wait_for_function(f"() => ({COLOURS})() > 50")
        assert re.search(r"peak at \d+ of 60", page.inner_text(in_panel("activity", "h2")))
        box = page.locator(in_panel("activity", "canvas")).bounding_box()
        assert box["height"] == 240

        # The user hides, moves, widens and adds panels.
        page.click("#layout")
        assert written(page) == {
            "dashboard": json.loads((RING / "project.json").read_text())["dashboard"]
        }
        page.click(in_panel("details", "button[title='hide this panel']"))
        page.click(in_panel("connections", "button[title='earlier']"))
        page.select_option(in_panel("graph", ".tools select"), "full")
        page.select_option("#layout-panel", "log")
        page.click("#layout-add")
        changed = ["activity", "connections", "graph", "log"]
        assert page.evaluate(SHOWN) == changed
        told = written(page)
        assert [each["panel"] for each in told["dashboard"]["panels"]] == changed
        assert told["dashboard"]["panels"][2] == {"panel": "graph", "width": "full"}

        # An array that the user clicks among the fields becomes a heat map, too.
        page.select_option("#layout-panel", "details")
        page.click("#layout-add")
        page.click('#connections tr[data-name="ring.rates -> eyes.rates"]')
        page.click('#details tr[data-name="data.length"] button:text("heat map")')
        page.wait_for_function(
            "() => document.querySelectorAll('[data-panel=activity] canvas[data-peak]').length == 2"
        )

        # The browser keeps it, and so does the project file that has the text.
        told = written(page)
        page.reload()
        page.wait_for_function(f"() => ({SHOWN})().length == 6")
        assert page.evaluate(SHOWN) == [*changed, "details", "activity"]
        page.click("#layout")
        assert written(page) == told
        with page.expect_download() as download:
            page.click("#layout-save")
        saved = json.loads(Path(download.value.path()).read_text())
        assert saved == told
        project = json.loads((RING / "project.json").read_text()) | saved
        for name in ("ring.py", "eyes.py"):
            (tmp_path / name).write_text((RING / name).read_text())
        (tmp_path / "project.json").write_text(json.dumps(project))
        assert load_project(tmp_path, workspace=tmp_path).project.dashboard == told["dashboard"]
        page.click("#layout-reset")
        assert page.evaluate(SHOWN) == ["activity", "graph", "details", "connections"]

        assert Visitor(url).post("/do/stop") == 204
        page.wait_for_selector("#phase.ended")
        finished = running.finish()
        assert finished.exit_code == 0

        # The recorded run is one file with a slider, which needs no server.
        assert main(["report", str(finished.run_folder)]) == 0
        page.goto(f"file://{finished.run_folder}/report/panels.html")
        page.wait_for_selector("canvas[data-peak]")
        last = page.get_attribute("canvas", "data-peak")
        page.locator("#time").evaluate(BACK)
        page.wait_for_function(
            "(last) => document.querySelector('canvas').dataset.peak !== last", arg=last
        )


@pytest.mark.needs(*COMPILER)
@with_reports
def test_spikes_are_shown_as_a_raster_with_the_rate_of_the_population(tmp_path: Path) -> None:
    with (
        start(RING / "spiking.json", "--dashboard", "--record", cwd=tmp_path) as running,
        browser_page() as page,
    ):
        url = address(running)
        page.goto(url)
        page.wait_for_function(
            "() => document.querySelector('[data-panel=raster] canvas')?.dataset.spikes > 2000"
        )
        rate_hz = page.evaluate(
            "() => Number(document.querySelector('[data-panel=raster] canvas').dataset.rate)"
        )
        assert rate_hz == pytest.approx(IN_BUMP / NEURONS / STEP_S, rel=0.05)
        assert "60 neurons" in page.inner_text(in_panel("raster", "h2"))
        assert "raster" in page.evaluate(SHOWN)

        # The same spikes as a heat map: the bump has a peak.
        page.click("#layout")
        page.select_option("#layout-panel", "activity ring.spikes")
        page.click("#layout-add")
        page.wait_for_function(f"() => ({PEAK})() !== undefined")

        assert Visitor(url).post("/do/stop") == 204
        page.wait_for_selector("#phase.ended")
        finished = running.finish()
        assert finished.exit_code == 0

        # The page of the recorded run has the same rate.
        assert main(["report", str(finished.run_folder)]) == 0
        page.goto(f"file://{finished.run_folder}/report/panels.html")
        page.wait_for_selector("canvas[data-peak]")
        assert float(page.get_attribute("canvas[data-rate]", "data-rate")) == pytest.approx(
            IN_BUMP / NEURONS / STEP_S, rel=0.05
        )
