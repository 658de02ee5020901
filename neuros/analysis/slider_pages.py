"""Pages of a recorded run with a slider over time, each one HTML file.

Panels are spike rasters and heat maps; a world is a 3-D view over simulated time.
"""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from neuros.analysis.run_record import PastRun
from neuros.errors import UsageError
from neuros.node.logs import WORLD_LOG
from neuros.project.dashboard import ARRAYS, SPIKES
from neuros.recording.bag_reader import RecordedTopic, open_bag
from neuros.recording.labelled import has_simulated_time

MOST_SPIKES = 2_000_000
"""Of one output; later ones are left out."""
MOST_ARRAYS = 3000
"""Packets of one output; of more, every k-th is shown."""
LONGEST_ARRAY = 4096

_STATIC = files("neuros") / "viewers" / "dashboard" / "static"
_PANELS_PAGE = files("neuros") / "analysis" / "panels_page.html"
_PANELS_SCRIPTS = ("format.js", "plane.js", "spikes.js", "raster.js", "activity.js")
_IMPORT = re.compile(r"^import .*$", re.MULTILINE)


def panels_page(run: PastRun) -> str | None:
    """The page, ``None`` if the bag of the run has nothing that a panel draws.

    Raises:
        EnvironmentFault: if the bag is damaged.
    """
    try:
        bag = open_bag(run.folder)
    except UsageError:  # it was not recorded
        return None
    with bag:
        labels = [t.connection or t.name for t in bag.topics.values()]
        outputs = dict.fromkeys(label.partition(" -> ")[0] for label in labels)
        panels = [p for name in outputs for p in _panels(name, bag[name], bag.start_ns)]
    if not panels:
        return None
    data = json.dumps(panels).replace("</", "<\\/")  # which would end the script that holds it
    scripts = (_IMPORT.sub("", (_STATIC / name).read_text("utf-8")) for name in _PANELS_SCRIPTS)
    page = Template(_PANELS_PAGE.read_text("utf-8"))
    return page.substitute(
        title=escape(f"Activity in {run.name}"), scripts="\n".join(scripts), panels=data
    )


def _panels(name: str, topic: RecordedTopic, start_ns: int) -> Iterator[dict[str, Any]]:
    """What the page draws of an output."""
    if not topic.count:
        return
    if topic.type == SPIKES:
        columns = topic.columns()
        times = np.concatenate([*columns["times"]])[:MOST_SPIKES].astype("<f8")
        senders = np.concatenate([*columns["senders"]])[:MOST_SPIKES].astype("<u4")
        if len(times):
            order = np.argsort(times, kind="stable")
            data = {"times": _packed(times[order]), "senders": _packed(senders[order])}
            size = max(int(columns["size"].max()), int(senders.max()) + 1)
            span = [float(times.min()), float(times.max())]
            yield {"output": name, "kind": "spikes", "size": size, "span": span, **data}
    elif topic.type in ARRAYS:
        columns = topic.columns()
        clock = "publish_time_ns" if has_simulated_time(columns) else "log_time_ns"
        begin_ns = 0 if has_simulated_time(columns) else start_ns
        stride = -(-topic.count // MOST_ARRAYS)
        rows = [np.asarray(row, "<f4")[:LONGEST_ARRAY] for row in columns[ARRAYS[topic.type]]]
        rows = rows[::stride]
        times = (columns[clock][::stride] - begin_ns) / 1e9
        if rows and rows[0].size and all(row.shape == rows[0].shape for row in rows):
            yield {
                "output": name,
                "kind": "array",
                "field": ARRAYS[topic.type],
                "size": rows[0].size,
                "span": [float(times.min()), float(times.max())],
                "times": _packed(times.astype("<f8")),
                "values": _packed(np.stack(rows)),
            }


def _packed(numbers: npt.NDArray[Any]) -> str:
    return base64.b64encode(zlib.compress(numbers.tobytes())).decode()


MOST_FRAMES = 6000
"""Of a page; of a longer recording, every k-th frame is shown."""

_WORLD_PAGE = files("neuros") / "analysis" / "world_page.html"
_WORLD_SCRIPTS = {"library": "vendor/three.iife.min.js", "scene": "scene.js"}


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
    scripts = {key: (_STATIC / name).read_text("utf-8") for key, name in _WORLD_SCRIPTS.items()}
    page = Template(_WORLD_PAGE.read_text("utf-8"))
    return page.substitute(scripts, title=escape(title), scenes=data)
