"""``--network`` and ``--peers``: how far the nodes of a run look for others."""

from __future__ import annotations

import argparse


def add_network(launch: argparse.ArgumentParser) -> None:
    """The options of ``launch``."""
    launch.add_argument(
        "--network",
        action="store_true",
        help="let the nodes find, and be found by, those on other machines of the network"
        " (default: this machine only); everybody there can then read and send packets",
    )
    launch.add_argument(
        "--peers",
        metavar="HOST,...",
        help="the other machines, by address or name, where multicast does not reach them;"
        " implies --network",
    )
