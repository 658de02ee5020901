"""Recorded spikes for Neo, and as files of Neurodata Without Borders.

Times are seconds of simulated time. Spans without spikes belong to the recording: trains begin at
the latest with the span of the first packet, and end with the stamp of the last packet.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from neuros.bag import RecordedTopic
from neuros.errors import UsageError
from neuros.project.dashboard import SPIKES
from neuros.recording.columns import library

Floats = npt.NDArray[np.float64]


def segment(topic: RecordedTopic) -> Any:
    """The result of :meth:`RecordedTopic.neo`."""
    neo = library("neo", "array()")
    trains = trains_of(topic)
    made = neo.Segment(name=topic.name, topic=topic.name, connection=topic.connection or "")
    span = {"t_start": trains.start_s, "t_stop": trains.end_s}
    made.spiketrains = [
        neo.SpikeTrain(times_s, units="s", neuron=neuron, **span)
        for neuron, times_s in enumerate(trains.times_s)
    ]
    return made


def write_nwb(
    topic: RecordedTopic, file: str | os.PathLike[str], run_id: str, began: datetime
) -> None:
    """The work of :meth:`RecordedTopic.nwb`."""
    pynwb = library("pynwb", "neo()")
    trains = trains_of(topic)
    content = pynwb.NWBFile(f"simulated spikes of {topic.name}", run_id, began)
    span = [(trains.start_s, trains.end_s)]
    for neuron, times_s in enumerate(trains.times_s):
        content.add_unit(id=neuron, spike_times=times_s, obs_intervals=span)
    with pynwb.NWBHDF5IO(os.fspath(file), "w") as writer:
        writer.write(content)


@dataclass(frozen=True)
class SpikeTrains:
    """The spikes of a recorded population.

    Attributes:
        times_s: rising spike times of each neuron.
        start_s, end_s: the recorded span.
    """

    times_s: list[Floats]
    start_s: float
    end_s: float


def trains_of(topic: RecordedTopic) -> SpikeTrains:
    """The spikes of a topic.

    Raises:
        UsageError: the topic has another type or no packet, the size of the population changes,
            or a packet has a neuron outside of it or not one time for each sender.
    """
    if topic.type != SPIKES:
        raise UsageError(f"{topic.name} has packets of {topic.type}: spike trains need {SPIKES}")
    columns = topic.columns()
    sizes = columns["size"]
    if not len(sizes):
        raise UsageError(f"{topic.name} has no packet, so the size of its population is unknown")
    size = int(sizes[0])
    # A column has a row per packet, or an object where packets differ in length.
    senders, times = (
        np.concatenate([np.asarray(each, np.float64).ravel() for each in columns[name]])
        for name in ("senders", "times")
    )
    if np.any(sizes != size):
        raise UsageError(f"{topic.name}: the population has {size} neurons, then {sizes.max()}")
    if len(senders) != len(times):
        raise UsageError(f"{topic.name}: {len(senders)} senders, but {len(times)} times")
    if np.any(senders >= size):
        raise UsageError(f"{topic.name}: a spike of neuron {senders.max():g} among {size}")
    stamps_s = columns["header.stamp.sec"] + columns["header.stamp.nanosec"] * 1e-9
    start_s = min(0.0, *times[:1], *stamps_s[:1])
    end_s = max(float(times.max(initial=start_s)), float(stamps_s.max()))
    order = np.lexsort((times, senders))
    places = np.searchsorted(senders[order], np.arange(1, size))
    return SpikeTrains(np.split(times[order], places), start_s, end_s)
