"""A lossless stream over a bad network: what arrives, and how late."""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path

from cable import Cable
from launching import Running
from two_machines import TwoMachines

STREAM = Path(__file__).parent / "stream"
CONNECTION = "source.image -> sink.image"
FOUND_S = 60.0
PATIENCE_S = 300.0


@dataclass(frozen=True)
class Condition:
    """What a cable does to frames: see :class:`~cable.Cable`; ``out_s``: for so long it is out."""

    loss: float = 0.0
    doubled: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    out_s: float = 0.0


CONDITIONS = {
    "a good cable": Condition(),
    "10 % lost": Condition(loss=0.1),
    "30 % lost": Condition(loss=0.3),
    "50 ms late": Condition(delay_s=0.05),
    "0 to 40 ms late, out of order": Condition(jitter_s=0.04),
    "10 % twice": Condition(doubled=0.1),
    "10 % lost, 10 % twice, 0 to 40 ms late": Condition(loss=0.1, doubled=0.1, jitter_s=0.04),
    "out for 2 s": Condition(out_s=2.0),
}


@dataclass
class Stream:
    """What came of a stream.

    Attributes:
        arrived: packets, by number, as the sink took them.
        took_s: from the first to the last.
        ages_ms: from hook to hook.
        problems: what is not as it must be on a lossless connection.
    """

    arrived: list[int] = field(default_factory=list)
    took_s: float = 0.0
    ages_ms: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def age_ms(self, share: float) -> float:
        """Which age that share of the packets does not exceed."""
        return sorted(self.ages_ms)[int(share * (len(self.ages_ms) - 1))] if self.ages_ms else 0.0

    @property
    def median_ms(self) -> float:
        """The median age."""
        return statistics.median(self.ages_ms) if self.ages_ms else 0.0


def stream(
    machines: TwoMachines,
    cable: Cable,
    condition: Condition,
    folder: Path,
    *,
    count: int,
    size: int,
) -> Stream:
    """Send ``count`` images of ``size`` bytes from one machine to the other, at most 100 per s."""
    cable.loss, cable.doubled = condition.loss, condition.doubled
    cable.delay_s, cable.jitter_s = condition.delay_s, condition.jitter_s
    values = {"COUNT": count, "SIZE": size, "DRAIN_S": 60}
    sets = [x for k, v in values.items() for x in ("--set", f"nodes.source.environment.{k}={v}")]
    options = ("--network", "--backend", "process", *sets)
    try:
        with (
            machines.start("right", STREAM, "-n", "sink", *options, cwd=folder) as sink,
            machines.start("left", STREAM, "-n", "source", *options, cwd=folder) as source,
        ):
            if condition.out_s:
                _pull(cable, sink, condition.out_s)
            ended = [sink.finish(PATIENCE_S), source.finish()]
    finally:
        cable.mend()
    found = Stream()
    for finished in ended:
        if finished.exit_code:
            found.problems.append(f"exit code {finished.exit_code}: {finished.said('neuros')[-1:]}")
            return found
        books = finished.connection(CONNECTION)
        if (books["sent"], books["received"], books["lost"]) != (count, count, 0):
            found.problems.append(f"counters: {dict(books)}")
    assert ended[0].run_folder is not None
    told = json.loads((ended[0].run_folder / "sink" / "received.json").read_text())
    found.arrived, found.ages_ms = told["numbers"], [1e3 * s for s in told["ages_s"]]
    found.took_s = told["took_s"]
    if found.arrived != list(range(1, count + 1)):
        found.problems.append(f"{len(found.arrived)} of {count} arrived, or not in order")
    return found


def _pull(cable: Cable, sink: Running, out_s: float) -> None:
    """Once the stream flows, and the launchers know each other, pull the cable for so long."""
    sink.wait_for("the first image is here", FOUND_S)
    sink.wait_for("found elsewhere: source", FOUND_S)
    cable.is_out = True
    back_s = time.monotonic() + out_s
    while (left_s := back_s - time.monotonic()) > 0:
        sink.read(left_s)
    cable.is_out = False
