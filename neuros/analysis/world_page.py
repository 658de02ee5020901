"""Page of a recorded world: one HTML file with the 3-D view and a slider over simulated time."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from neuros.analysis.run_record import PastRun
from neuros.node.logs import WORLD_LOG

MOST_FRAMES = 6000
"""Of a page; of a longer recording, every k-th frame is shown."""

_STATIC = files("neuros") / "viewers" / "dashboard" / "static"
_PAGE = files("neuros") / "analysis" / "world_page.html"
_SCRIPTS = {"library": "vendor/three.iife.min.js", "scene": "scene.js"}


def world_pages(run: PastRun) -> dict[str, str]:
    """Pages by node, of those whose world was recorded."""
    found = {}
    for name in run.nodes:
        scenes = list(_scenes(run.folder / name / WORLD_LOG))
        if scenes:
            found[name] = _page(f"World of {name} in {run.name}", scenes)
    return found


def _scenes(file: Path) -> Iterator[dict[str, Any]]:
    """Each geometry, with the times and poses of its frames; what stood still is left out.

    Where the simulation was reset, time goes on.
    """
    scenes: list[tuple[str, list[tuple[float, str]]]] = []
    before_s, last_s = 0.0, -1.0
    for line in _lines(file):
        if "geometry" in line:
            scenes.append((line["geometry"], []))
        for _, sim_s, poses in line["frames"]:
            if before_s + sim_s < last_s:
                before_s = last_s
            if before_s + sim_s > last_s or not scenes[-1][1]:
                last_s = before_s + sim_s
                scenes[-1][1].append((last_s, poses))
    stride = -(-sum(len(frames) for _, frames in scenes) // MOST_FRAMES)
    for geometry, frames in scenes:
        if kept := frames[::stride]:
            poses = b"".join(base64.b64decode(poses) for _, poses in kept)
            yield {
                "geometry": json.loads(geometry),
                "times_s": [time_s for time_s, _ in kept],
                "poses": base64.b64encode(zlib.compress(poses)).decode(),
            }


def _lines(file: Path) -> Iterator[dict[str, Any]]:
    """Whole lines of the file; a node that was killed may have left half of one."""
    if file.is_file():
        for line in file.read_text("utf-8").splitlines():
            try:
                yield json.loads(line)
            except ValueError:
                return


def _page(title: str, scenes: list[dict[str, Any]]) -> str:
    data = json.dumps(scenes).replace("</", "<\\/")  # which would end the script that holds it
    scripts = {key: (_STATIC / name).read_text("utf-8") for key, name in _SCRIPTS.items()}
    page = Template(_PAGE.read_text("utf-8"))
    return page.substitute(scripts, title=escape(title), scenes=data)
