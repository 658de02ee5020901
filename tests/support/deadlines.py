"""Conditions that come true within a generous time, however loaded the machine is."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_until(condition: Callable[[], object], within_s: float = 30.0) -> float:
    """Until it holds; returns how long that took, in seconds, and fails after the deadline."""
    start_s = time.monotonic()
    while not condition():
        assert time.monotonic() - start_s < within_s, f"not within {within_s:g} s"
        time.sleep(0.02)
    return time.monotonic() - start_s
