"""The options for watching a run."""

from __future__ import annotations

import argparse


def add_observation(launch: argparse.ArgumentParser) -> None:
    """Add the options of ``neuros launch``."""
    launch.add_argument(
        "-m",
        "--monitor-system-load",
        action="store_true",
        help="write processor, memory, network and threads, of the machine and by node, to"
        " system_load.csv in the run folder, once per second",
    )

    launch.add_argument(
        "--digests",
        action="store_true",
        help="also in process, keep a digest of every packet for `neuros verify`; each packet is"
        " serialised for it there (on the other back ends digests are always kept, in process"
        " where all connections are lossless and it costs under 2 %% of the processor time)",
    )
