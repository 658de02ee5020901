"""The report of a bag of another program: how often its topics came, and what they hold."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from neuros.bag import Bag
from neuros.recording.run_file import RUN_FILE
from neuros.recording.stored import METADATA_NAME, bag_files
from neuros_analysis.charts import colour, new_figure, plain
from neuros_analysis.run_pages import figure_part, page, picture, table_part

HEADER = ("topic", "type", "packets", "rate / Hz", "median / ms", "longest / ms", "bytes")
_MOST_MARKS = 2000
"""Packets of a topic that are drawn; of more, every k-th."""
_ROW_IN = 0.3


class TopicTimes(NamedTuple):
    """When packets of a topic were recorded, in seconds from the first of the bag, and their size.

    Attributes:
        remark: why the topic cannot be decoded; empty if it can.
    """

    name: str
    type: str
    times_s: npt.NDArray[np.float64]
    mean_bytes: float
    remark: str

    @property
    def row(self) -> list[str]:
        """A row below :data:`HEADER`; times are between two packets."""
        gaps_s = np.diff(self.times_s)
        count = len(self.times_s)
        figures = ["", "", ""]
        if len(gaps_s):
            rate_hz = len(gaps_s) / np.sum(gaps_s) if np.sum(gaps_s) > 0 else np.inf
            median_ms, longest_ms = 1e3 * np.median(gaps_s), 1e3 * np.max(gaps_s)
            figures = [f"{rate_hz:.4g}", f"{median_ms:.4g}", f"{longest_ms:.4g}"]
        size = f"{self.mean_bytes:.0f}" if count else ""
        return [self.name, self.type, str(count), *figures, size]


def is_foreign_bag(path: Path) -> bool:
    """Whether a path is a bag, and no run folder."""
    if path.is_file():
        return True
    is_run = any((path / name).exists() for name in (RUN_FILE, "project.json"))
    has_bag = (path / METADATA_NAME).is_file() or (path.is_dir() and bool(bag_files(path)))
    return has_bag and not is_run


def times_of(bag: Bag) -> list[TopicTimes]:
    """The times of every topic. Raises ``EnvironmentFault`` if the bag is damaged."""
    reasons = bag.undecodable()
    found = []
    for topic in bag.topics.values():
        packets = topic.raw()
        times_s = np.array([each.log_time_ns - bag.start_ns for each in packets], np.int64) / 1e9
        size = sum(len(packet.data) for packet in packets) / max(1, len(packets))
        remark = reasons.get(topic.name, "")
        found.append(TopicTimes(topic.name, topic.type, times_s, size, remark))
        bag.close()  # the packets of one topic at a time
    return found


def bag_page(bag: Bag, topics: list[TopicTimes]) -> str:
    told = [f"{bag.duration_s:.2f} s", f"{sum(len(t.times_s) for t in topics)} packets"]
    told += [f"ROS {bag.distribution.capitalize()}"] if bag.distribution else []
    parts = [f"<p>{escape('; '.join(told))}.</p>"]
    remarks = [*bag.notes, *(topic.remark for topic in topics if topic.remark)]
    if remarks:
        items = "".join(f"<li>{escape(each)}</li>" for each in remarks)
        parts.append(f'<div class="missing"><p>Notes:</p><ul>{items}</ul></div>')
    parts.append(table_part("Topics", HEADER, [topic.row for topic in topics]))
    drawn = [topic for topic in topics if len(topic.times_s)]
    if drawn:
        text = "A mark for each packet; where they are dense, for some of them."
        parts.append(figure_part("Packets over time", text, picture(times_figure(drawn))))
    return page(f"Bag {bag.folder.name}", parts)


def times_figure(topics: list[TopicTimes]) -> Any:
    figure = new_figure(1.2 + _ROW_IN * len(topics))
    axes = plain(figure.add_subplot())
    marks = [t.times_s[:: -(-len(t.times_s) // _MOST_MARKS)] for t in topics]
    colours = [colour(place) for place in range(len(topics))]
    axes.eventplot(marks, colors=colours, linelengths=0.7, linewidths=0.8)
    axes.set_yticks(range(len(topics)), [topic.name for topic in topics], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("time / s")
    return figure
