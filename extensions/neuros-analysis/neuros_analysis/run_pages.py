"""HTML pages of a run, one file each: its report, and panels and worlds with a slider over time.

The report has tables and figures, and no scripts. Panels are spike rasters and heat maps; a world
is a 3-D view over simulated time. None of them needs a network.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import shlex
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from neuros.bag import Bag, RecordedTopic, open_bag
from neuros.errors import UsageError
from neuros.node.logs import WORLD_LOG
from neuros.ordinary_files import open_ordinary
from neuros.project.dashboard import ARRAYS, SPIKES
from neuros.project.timing import VIRTUAL
from neuros.recording.columns import has_simulated_time
from neuros.registry import back_end_of
from neuros_analysis import charts
from neuros_analysis.findings import Findings
from neuros_analysis.review import ReviewedRun

MOST_SPIKES = 2_000_000
"""Of one output; further ones are left out."""
MOST_ARRAYS = 3000
"""Packets of one output; of more, every k-th is drawn."""
LONGEST_ARRAY = 4096
MOST_FRAMES = 6000
"""Frames of a world; of more, every k-th is drawn."""

_SCRIPTS = files("neuros") / "javascript"
_WORLD_SCRIPTS = {"library": "vendor/three.iife.min.js", "scene": "scene.js"}
_PANELS_SCRIPTS = ("format.js", "plane.js", "spikes.js", "raster.js", "activity.js")
_IMPORT = re.compile(r"^import .*$", re.MULTILINE)


def picture(figure: Any, kind: str = "png") -> bytes:
    """A figure as a file's content."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind)
    return buffer.getvalue()


def report_page(
    run: ReviewedRun, findings: Findings, figures: Mapping[str, tuple[str, bytes]]
) -> str:
    """The page of a run.

    Args:
        figures: by title, a sentence about the figure, and its PNG.
    """
    record = run.record
    facts = [str(record.get("reason") or "ended normally")]
    if record.get("sim_s") is not None:
        facts.append(f"{record['sim_s']:.2f} s of simulated time")
    if record.get("virtual_s") is not None:
        facts.append(f"{record['virtual_s']:.2f} s of virtual time")
    if record.get("wall_s") is not None:
        facts.append(f"{record['wall_s']:.2f} s of wall time")
    if record.get("real_time_factor"):
        facts.append(f"real-time factor {record['real_time_factor']:.2f}")
    facts += [f"broken budget: {each}" for each in record.get("broken_budgets", ())]
    parts = [f"<p>{escape('; '.join(facts))}.</p>", bottleneck_part(findings)]
    if run.missing:
        items = "".join(f"<li>{escape(each)}</li>" for each in run.missing)
        text = f"<p>What this page lacks:</p><ul>{items}</ul>"
        parts.append(f'<div class="missing">{text}</div>')
    parts += [figure_part(title, text, data) for title, (text, data) in figures.items()]
    parts += [_connections(run), *_declared_times(run), _provenance(run)]
    return page(f"Run of {run.name}", parts)


def page(title: str, parts: Sequence[str]) -> str:
    return _filled("report_page.html", title, body="\n".join(parts))


def _filled(template: str, title: str, **values: str) -> str:
    """A page of one of the HTML files beside this module."""
    text = (files("neuros_analysis") / template).read_text("utf-8")
    return Template(text).substitute(values, title=escape(title))


def bottleneck_part(findings: Findings, title: str = "The bottleneck") -> str:
    lines = [f"<p>{escape(findings.headline)}</p>"]
    if findings.reasons:
        items = "".join(f"<li>{escape(reason)}</li>" for reason in findings.reasons)
        lines.append(f"<ul>{items}</ul>")
    lines += [f"<p>{escape(gain)}</p>" for gain in findings.gains]
    if findings.trial:
        lines.append(f"<p>To test it: <code>{escape(findings.trial)}</code></p>")
    return f'<h2>{escape(title)}</h2>\n<div class="main">{"".join(lines)}</div>'


def table_part(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "numbers"
) -> str:
    """A table under a heading; aligned for its ``kind``, ``numbers`` or ``text``."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return (
        f'<h2>{escape(title)}</h2>\n<div class="table {kind}"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def figure_part(title: str, text: str, data: bytes) -> str:
    """A figure under a heading, in the page itself."""
    uri = f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f'<h2>{escape(title)}</h2>\n<p>{escape(text)}</p>\n<img alt="{escape(title)}" src="{uri}">'
    )


def _connections(run: ReviewedRun) -> str:
    header = ["connection", "sent", "received", "consumed", "discarded", "lost",
              "longest discard", "rate / Hz", "median / ms", "99 % / ms", "max / ms"]  # fmt: skip
    counts = ("sent", "received", "consumed", "discarded", "lost", "longest_discard")
    rows = []
    for name, figures in run.connections.items():
        latency = figures.get("latency_ms") or {}
        rows.append(
            [
                name,
                *("?" if figures.get(key) is None else f"{figures[key]:,}" for key in counts),
                _number(figures.get("rate_hz"), 1),
                *(_number(latency.get(key), 2) for key in ("p50", "p99", "max")),
            ]
        )
    return table_part("Packets and latencies", header, rows)


def _number(value: float | None, digits: int) -> str:
    return "?" if value is None else f"{value:,.{digits}f}"


def _declared_times(run: ReviewedRun) -> list[str]:
    """What moved the clock of a run in virtual time: a table, if anything was declared."""
    project = run.record.get("expanded_project") or {}
    if project.get("time") != VIRTUAL:
        return []
    rows = [
        [f"{node['name']}.{hook}", "duration of the hook", json.dumps(value)]
        for node in project.get("nodes", ())
        for hook, value in node.get("durations", {}).items()
    ]
    for each in project.get("connections", ()):
        source = f"{each['source_node']}.{each['source_output']}"
        name = f"{source} -> {each['destination_node']}.{each['destination_input']}"
        rows += [[name, key, json.dumps(each[key])] for key in ("delay", "loss") if key in each]
    title, header = "Declared times, in s of virtual time", ["hook or connection", "what", "value"]
    return [table_part(title, header, rows, "text")] if rows else []


def _provenance(run: ReviewedRun) -> str:
    record = run.record
    machine, versions = record.get("machine") or {}, record.get("versions") or {}
    git = record.get("git") or {}
    back_end = back_end_of(record)
    memory = f"{machine['memory_bytes'] / 1e9:.1f} GB" if "memory_bytes" in machine else None
    cores = f"{machine['cores']} cores" if "cores" in machine else None
    hardware = [machine.get("processor"), cores, memory, machine.get("system")]
    started = record.get("started")
    when = datetime.fromtimestamp(started, timezone.utc) if started else None
    cells = {
        "folder": run.folder,
        "project": record.get("file"),
        "started": when and when.strftime("%Y-%m-%d %H:%M:%S UTC"),
        "back end": record.get("backend"),
        "machine": ", ".join(str(part) for part in hardware if part),
        "NeuROS, Python": versions and f"{versions.get('neuros')}, {versions.get('python')}",
        "git": git and f"{git.get('commit')}{' (changed)' if git.get('is_dirty') else ''}",
        **(back_end.provenance(record) if back_end else {}),
        "seeds": ", ".join(
            f"{node}: {name} {value}"
            for node, found in (record.get("seeds") or {}).items()
            for name, value in found.items()
        ),
        "command": shlex.join(record.get("command", ())),
    }
    rows = [[key, str(value)] for key, value in cells.items() if value]
    return table_part("Where it comes from", ["", ""], rows, "text")


_FIGURES: tuple[tuple[str, str, str, Callable[[ReviewedRun], Any]], ...] = (
    (
        "graph",
        "Nodes and connections",
        "Each node with its busiest hook and how it spent its time; each connection with its"
        " guarantee, what it carried and lost, and how long a packet waited for a hook (median).",
        charts.graph_figure,
    ),
    (
        "time_shares",
        "Where the time went",
        "Shares of each node's time, without the start and the end of the run; what is missing to"
        " 100 % is scheduling: a hook whose turn has not come.",
        charts.time_budget_figure,
    ),
    (
        "swim_lanes",
        "Who waits for whom",
        "Hooks as bars, packets from their sender to the start of a hook on them, and"
        " acknowledgements back.",
        charts.timeline_figure,
    ),
    (
        "real_time",
        "Simulated against real time",
        "One point per simulated second; wall time from the first hook on.",
        charts.time_figure,
    ),
    (
        "packets",
        "Packets",
        "What became of the packets of each connection.",
        charts.counts_figure,
    ),
    (
        "latency",
        "Latency",
        "The share of packets on which a hook had started within a time after they were sent.",
        charts.latency_figure,
    ),
    (
        "ticks",
        "Regularity of timed hooks",
        "Intervals between the starts of a hook with a period.",
        charts.ticks_figure,
    ),
    (
        "system_load",
        "Processor and memory",
        "Of each node's processes, once per second from the command on; 100 % is one core.",
        charts.load_figure,
    ),
)


def figures_of(run: ReviewedRun) -> dict[str, tuple[str, str, bytes]]:
    """Title, sentence and PNG of each figure with content, by file name without ending."""
    found = {}
    for name, title, text, draw in _FIGURES:
        figure = draw(run)
        if figure is not None:
            found[name] = (title, text, picture(figure))
    return found


def panels_page(run: ReviewedRun) -> str | None:
    """The page of panels, ``None`` if the bag of the run has no data for one.

    Raises:
        EnvironmentFault: if the bag is damaged.
    """
    try:
        bag = open_bag(run.folder)
    except UsageError:  # it was not recorded
        return None
    with bag:
        return panels_of(bag, run.name)


def panels_of(bag: Bag, name: str) -> str | None:
    """As :func:`panels_page`, of a bag; ``name``: for the heading."""
    panels: list[dict[str, Any]] = []
    labels = [t.connection or t.name for t in bag.topics.values()]
    for output in dict.fromkeys(label.partition(" -> ")[0] for label in labels):
        panels += _panels(output, bag[output], bag.start_ns)
    if not panels:
        return None
    scripts = (_IMPORT.sub("", (_SCRIPTS / name).read_text("utf-8")) for name in _PANELS_SCRIPTS)
    title = f"Activity in {name}"
    return _filled("panels_page.html", title, scripts="\n".join(scripts), panels=_in_script(panels))


def _in_script(content: Any) -> str:
    """JSON for an HTML script: it cannot contain the script's end tag."""
    return json.dumps(content).replace("</", "<\\/")


def _panels(name: str, topic: RecordedTopic, start_ns: int) -> Iterator[dict[str, Any]]:
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
        is_run_time = topic.is_virtual or has_simulated_time(columns)
        clock = "publish_time_ns" if is_run_time else "log_time_ns"
        begin_ns = 0 if is_run_time else start_ns
        stride = -(-topic.count // MOST_ARRAYS)
        arrays = columns[ARRAYS[topic.type]][::stride]
        rows = [np.asarray(row, "<f4")[:LONGEST_ARRAY] for row in arrays]
        times = (columns[clock][::stride] - begin_ns) / 1e9
        if rows and rows[0].size and all(row.shape == rows[0].shape for row in rows):
            yield {
                "output": name,
                "kind": "array",
                "field": ARRAYS[topic.type],
                "clock": "simulated" if has_simulated_time(columns) else "wall clock",
                "size": rows[0].size,
                "span": [float(times.min()), float(times.max())],
                "times": _packed(times.astype("<f8")),
                "values": _packed(np.stack(rows)),
            }


def _packed(numbers: npt.NDArray[Any]) -> str:
    return _compressed(numbers.tobytes())


def _compressed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data)).decode()


def world_pages(
    run: ReviewedRun, complain: Callable[[str], object] = lambda _: None
) -> dict[str, str]:
    """Pages of recorded worlds, by node.

    Args:
        complain: called with a sentence about each damaged file; its world ends at the damage.
    """
    scripts = {key: (_SCRIPTS / name).read_text("utf-8") for key, name in _WORLD_SCRIPTS.items()}
    found = {}
    for name in run.nodes:
        scenes = list(_scenes(run.folder / name / WORLD_LOG, complain))
        if scenes:
            title = f"World of {name} in {run.name}"
            content = _in_script(scenes)
            found[name] = _filled("world_page.html", title, **scripts, scenes=content)
    return found


def _scenes(file: Path, complain: Callable[[str], object]) -> Iterator[dict[str, Any]]:
    """Each geometry that has frames, with their times and poses."""
    world = _World()
    try:
        with open_ordinary(file) as lines:
            for line in lines:
                world.add(line)
    except FileNotFoundError:
        return
    except (OSError, *_DAMAGE):
        complain(f"the rest of {file}: the file is damaged")
    stride = -(-sum(len(frames) for _, frames in world.scenes) // MOST_FRAMES)
    for geometry, frames in world.scenes:
        if frames:
            kept = frames[::stride]
            yield {
                "geometry": geometry,
                "times_s": [time_s for time_s, _ in kept],
                "poses": _compressed(b"".join(poses for _, poses in kept)),
            }


# Errors of lines that no node writes.
_DAMAGE = (ValueError, TypeError, LookupError, OverflowError, RecursionError)


class _World:
    """A recorded world.

    Attributes:
        scenes: each geometry, with the times in seconds and poses of its frames. Times go on rising
            where the simulation was reset.
    """

    def __init__(self) -> None:
        self.scenes: list[tuple[dict[str, Any], list[tuple[float, bytes]]]] = []
        self._before_s, self._last_s = 0.0, -1.0

    def add(self, line: bytes) -> None:
        """Add a line of the file. Raises one of ``_DAMAGE`` for a line that no node writes."""
        content = json.loads(line)
        if "geometry" in content:
            geometry = json.loads(content["geometry"])
            # The page could not hold other values, or JavaScript not read them (NaN).
            json.dumps([[[geometry]]], allow_nan=False)
            if not isinstance(geometry, dict):
                raise TypeError("a geometry is an object")
            self.scenes.append((geometry, []))
        for _, sim_s, poses in content["frames"]:
            poses = base64.b64decode(poses, validate=True)
            frames = self.scenes[-1][1]
            if len(poses) % 4 or (frames and len(poses) != len(frames[0][1])):
                raise ValueError("poses are 32-bit numbers, of the same bodies in all frames")
            if self._before_s + sim_s < self._last_s:
                self._before_s = self._last_s
            time_s = self._before_s + sim_s
            if not math.isfinite(time_s):
                raise ValueError("times are finite")
            if time_s > self._last_s or not frames:
                self._last_s = time_s
                frames.append((time_s, poses))
