"""The 3-D view of the dashboard, in a real browser: what is looked at are drawn pixels."""

from __future__ import annotations

import io
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import browser_page
from deadlines import wait_until
from launching import start
from PIL import Image
from visitor import Visitor, address

from neuros.cli.main import main

PROJECT = Path(__file__).with_name("turning")
DEADLINE_S = 120  # a browser draws slowly where there is neither a graphics card nor a free core
OPTIONS = ("--dashboard", "--record", "--backend", "in-process")
SLIDE = """(slider) => {
    slider.value = Number(slider.value) + slider.max / 9;
    slider.dispatchEvent(new Event('input'));
}"""
IS_DRAWN = "() => Number(document.querySelector('#world').dataset.drawn ?? 0) > 2"


def picture(page: Any) -> Any:
    """The pixels of the view: rows, columns, and red, green and blue as signed numbers."""
    png = page.locator("#world canvas").screenshot()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def where(pixels: Any, colour: int) -> Any:
    """Rows and columns of the pixels in which this channel is by far the strongest."""
    others = np.delete(pixels, colour, axis=2).max(axis=2)
    return np.argwhere(pixels[:, :, colour] > others + 60)


with_reports = pytest.mark.skipif(
    find_spec("neuros_analysis") is None, reason="the report of the run is neuros-analysis's"
)


@with_reports
def test_a_robot_is_seen_turning_in_a_browser(tmp_path: Path) -> None:
    with (
        start(PROJECT, *OPTIONS, cwd=tmp_path) as running,
        browser_page(500, 700) as page,
    ):
        url = address(running)
        visitor = Visitor(url)
        assert visitor.get("/world/robot", "") == 403
        assert visitor.get("/world/nobody") == 404
        page.set_default_timeout(1000 * DEADLINE_S)
        page.goto(url)
        page.wait_for_function(IS_DRAWN)

        # The model's own camera looks down on a red arm, which turns about a green ball.
        page.select_option("#world-camera", "camera above")
        wait_until(lambda: len(where(picture(page), 1)) > 50, DEADLINE_S)
        ball = where(picture(page), 1).mean(axis=0)
        middle = np.array(picture(page).shape[:2]) / 2
        assert ball == pytest.approx(middle, abs=15)  # the arm covers a part
        sides: set[bool] = set()

        def has_been_left_and_right() -> bool:
            arm = where(picture(page), 0)
            if len(arm) > 50:
                sides.add(bool(arm[:, 1].mean() > ball[1]))
            return len(sides) == 2

        wait_until(has_been_left_and_right, DEADLINE_S)

        # It stands still with the run.
        page.click("#pause")
        page.wait_for_selector("#phase.paused")
        wait_until(lambda: np.array_equal(picture(page), picture(page)), DEADLINE_S)
        still = picture(page)

        # The user turns the free camera with the mouse, also then.
        page.select_option("#world-camera", "follow arm")
        wait_until(lambda: not np.array_equal(picture(page), still), DEADLINE_S)
        before = picture(page)
        page.locator("#world canvas").drag_to(
            page.locator("#world canvas"),
            source_position={"x": 150, "y": 200},
            target_position={"x": 350, "y": 250},
        )
        wait_until(lambda: not np.array_equal(picture(page), before), DEADLINE_S)
        assert len(where(picture(page), 0)) > 50

        assert visitor.post("/do/stop") == 204
        page.wait_for_selector("#phase.ended")
        finished = running.finish()
        assert finished.exit_code == 0

        # The recorded run is one file, which needs no server.
        assert main(["report", str(finished.run_folder)]) == 0
        page.goto(f"file://{finished.run_folder}/report/world_robot.html")
        page.wait_for_function(IS_DRAWN.replace("> 2", "> 0"))
        page.select_option("#camera", "camera above")
        wait_until(lambda: len(where(picture(page), 0)) > 50, DEADLINE_S)
        begin = picture(page)

        def is_elsewhere_after_a_slide() -> bool:
            page.locator("#time").evaluate(SLIDE)
            return bool(np.abs(picture(page) - begin).max() > 60)

        wait_until(is_elsewhere_after_a_slide, DEADLINE_S)
        time_s = page.input_value("#time")
        page.click("#play")
        page.wait_for_function("(t) => document.querySelector('#time').value !== t", arg=time_s)
