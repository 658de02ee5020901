#!/usr/bin/env python3
"""Makes the pictures of pages in the documentation, from real runs, in a headless Chromium.

::

    .venv/bin/python docs/screenshots.py [--weights RUN/trainer/weights.npz]

With the weights of a run of WhiskEye's ``training.json`` it makes the picture of the corrected
ring, too. It needs ``install.py --dev --extras rerun``, Chromium, and what the examples need. Look
at what it has made.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from neuros_dashboard.web import await_server
from playwright.sync_api import sync_playwright
from tutorial_files import files_of, steps

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures"
DEADLINE_MS = 120_000
RERUN_DRAWS_MS = 40_000  # on a canvas that says nothing of what it shows, without a graphics card
WHISKEYE = ROOT / "examples" / "4_neurorobotics" / "whiskeye" / "strict.json"
RING = ROOT / "extensions" / "neuros-dashboard" / "tests" / "ring" / "spiking.json"
SIZE: Any = {"width": 1300, "height": 1000}

LONG = ("--set", "nodes.robot.environment.DURATION=1000")


@contextlib.contextmanager
def page_of(project: Path, name: str, *arguments: str) -> Iterator[str]:
    """Run a project; yields the address that is printed behind this name."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "neuros.cli", "launch", str(project)]
        process = subprocess.Popen(
            [*command, "--backend", "process", *arguments],
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
        )
        assert process.stdout is not None
        with process.stdout as lines:
            try:
                yield next(m[1] for line in lines if (m := re.search(rf"{name}: (http\S+)", line)))
            finally:
                process.send_signal(signal.SIGINT)
                for _ in lines:
                    pass
                process.wait()


def shoot_dashboard(page: Any) -> None:
    """WhiskEye, with a connection selected."""
    with page_of(WHISKEYE, "dashboard", "--dashboard", *LONG) as url:
        page.set_viewport_size({**SIZE, "height": 1240})  # all panels
        page.goto(url)
        page.click('#connections tr[data-name="robot.imu -> snn.imu"]')
        page.wait_for_selector('#details tr[data-name="angular_velocity.z"]', timeout=DEADLINE_MS)
        page.wait_for_function(
            "() => document.querySelector('#world').dataset.drawn > 3", timeout=DEADLINE_MS
        )
        page.screenshot(path=FIGURES / "dashboard.png")
        page.set_viewport_size(SIZE)


def shoot_panels(page: Any) -> None:
    """The spikes of a ring as a raster and as a heat map."""
    with page_of(RING, "dashboard", "--dashboard") as url:
        page.goto(url)
        page.wait_for_function("() => window.neuros?.layout")
        panels = [
            {"panel": kind, "output": "ring.spikes", "width": "full"}
            for kind in ("raster", "activity")
        ]
        page.evaluate("(panels) => window.neuros.layout.use(panels)", panels)
        page.wait_for_function(
            "() => document.querySelector('[data-panel=activity] canvas')?.dataset.columns >= 99",
            timeout=DEADLINE_MS,
        )
        page.locator("main").screenshot(path=FIGURES / "dashboard_panels.png")


def shoot_world(page: Any) -> None:
    """The vehicle of the tutorial, and WhiskEye, in 3-D."""
    with tempfile.TemporaryDirectory() as folder:
        for step in steps():
            for name, text in files_of(step).items():
                Path(folder, name).parent.mkdir(exist_ok=True)
                Path(folder, name).write_text(text, "utf-8")
        world_of(page, Path(folder, "vehicle"), FIGURES / "world_view.png", 3)
    world_of(page, WHISKEYE, FIGURES / "world_view_whiskeye.jpg", 1, *LONG)


def world_of(page: Any, project: Path, file: Path, sim_s: float, *arguments: str) -> None:
    """The 3-D view of a project, after so many simulated seconds."""
    with page_of(project, "dashboard", "--dashboard", *arguments) as url:
        page.goto(url)
        page.wait_for_function(
            "(sim_s) => document.querySelector('#world').dataset.drawn > 3 &&"
            " Number(document.querySelector('#times').textContent.split(' ')[1]) > sim_s",
            arg=sim_s,
            timeout=DEADLINE_MS,
        )
        page.locator("#world-section").screenshot(path=file)


def shoot_correction(page: Any, weights: Path) -> None:
    """WhiskEye, corrected by what its eyes see, under a bias of the gyroscope."""
    arguments = [f"--restore=pcn.weights={weights}", "--set=nodes.snn.environment.GYRO_BIAS=0.1"]
    project = WHISKEYE.with_name("prediction.json")
    with page_of(project, "dashboard", "--dashboard", *arguments, *LONG) as url:
        page.goto(url)
        page.wait_for_function(
            "() => document.querySelector('#world').dataset.drawn > 3"
            " && document.querySelector('[data-panel=activity] canvas')?.dataset.columns >= 99",
            timeout=DEADLINE_MS,
        )
        page.screenshot(path=FIGURES / "whiskeye_dashboard.png")


def shoot_rerun(page: Any) -> None:
    """WhiskEye as ``--visualisations`` shows it where there is no RViz."""
    with page_of(WHISKEYE, "visualisations", "-z", *LONG) as url:
        await_server(url)
        page.goto(url)
        page.wait_for_timeout(RERUN_DRAWS_MS)
        page.screenshot(path=FIGURES / "rerun.png")


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--weights", type=lambda text: Path(text).resolve(), metavar="FILE")
    weights = parser.parse_args().weights
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport=SIZE)
        shoot_dashboard(page)
        shoot_panels(page)
        shoot_world(page)
        if weights is not None:
            shoot_correction(page, weights)
        shoot_rerun(page)
        browser.close()


if __name__ == "__main__":
    main()
