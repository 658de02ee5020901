"""Page of a recorded run: spike rasters and heat maps with a slider over time, in one HTML file."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from neuros.analysis.run_record import PastRun
from neuros.errors import UsageError
from neuros.project.dashboard import ARRAYS, SPIKES
from neuros.recording.bag_reader import RecordedTopic, open_bag
from neuros.recording.labelled import has_simulated_time

MOST_SPIKES = 2_000_000
"""Of one output; later ones are left out."""
MOST_ARRAYS = 3000
"""Packets of one output; of more, every k-th is shown."""
LONGEST_ARRAY = 4096

_STATIC = files("neuros") / "viewers" / "dashboard" / "static"
_PAGE = files("neuros") / "analysis" / "panels_page.html"
_SCRIPTS = ("format.js", "plane.js", "spikes.js", "raster.js", "activity.js")
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
    scripts = (_IMPORT.sub("", (_STATIC / name).read_text("utf-8")) for name in _SCRIPTS)
    page = Template(_PAGE.read_text("utf-8"))
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
