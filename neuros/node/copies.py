"""A seed for each copy of a node: many worlds behind one hook."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable

from neuros.errors import NodeError
from neuros.project.model import SEEDS


def copy_seeds(node: str, declared: Iterable[str], copies: int) -> list[int]:
    """The seeds of the copies of a node, by its environment of now.

    Args:
        node: its name.
        declared: names of the variables that it declares.
        copies: their number.

    Raises:
        NodeError: if no seed can be had.
    """
    if given := os.environ.get(SEEDS):
        found: list[int] = json.loads(given)
        return found
    names = [name for name in declared if "SEED" in name.upper()]
    if len(names) != 1:
        has = f"several: {', '.join(names)}" if names else "none"
        raise NodeError(
            f"seeds: node '{node}' needs one variable with SEED in its name in its environment, and"
            f" has {has}"
        )
    text = os.environ.get(names[0], "")
    if not (text.isascii() and text.isdigit()):
        raise NodeError(f"seeds: {names[0]}={text!r} is no whole number from 0 on")
    from numpy.random import SeedSequence

    sequences = (SeedSequence(int(text), spawn_key=(index,)) for index in range(copies))
    return [int(each.generate_state(1, "uint64")[0]) for each in sequences]
