"""What nodes note of each packet: its number, when it was sent, and when a hook started on it."""

import time
from pathlib import Path
from typing import Any


def send(node: Any, output: str, payload: bytes = b"") -> Any:
    """The next packet of an output: its number, counted from 1, and the time now in ns."""
    counts = node.get_user_data() or {}
    node.set_user_data(counts)
    counts[output] = counts.get(output, 0) + 1
    packet = node.make_packet(output)
    packet.data = [counts[output], time.monotonic_ns()]
    _write(node.run_dir / f"sent_{output}.txt", *packet.data)
    return packet


def take(node: Any, hook: str, packet: Any, seconds: float = 0.0) -> None:
    """Note that a hook has started on a packet (``None``: without one), and let it take a time."""
    start_ns = time.monotonic_ns()
    time.sleep(seconds)
    number, sent_ns = (0, 0) if packet is None else packet.data
    _write(node.run_dir / "taken.txt", hook, number, sent_ns, start_ns, time.monotonic_ns())


def _write(path: Path, *fields: Any) -> None:
    with path.open("a") as file:
        print(*fields, file=file)
