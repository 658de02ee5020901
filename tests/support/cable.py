"""A cable between two network namespaces that loses, delays, reorders and doubles frames.

Each end is a TAP device whose frames a thread of this process carries over: many kernels come
without ``tc netem``.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import selectors
import struct
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from machines import Machine, run

_TUNSETIFF = 0x400454CA  # linux/if_tun.h
_TAP_WITHOUT_HEADER = 0x0002 | 0x1000
_FRAME_BYTES = 1 << 16


@dataclass
class Cable:
    """What becomes of the frames on it, each way; may be changed at any time.

    Attributes:
        loss: this share of them is lost.
        doubled: this share of them arrives twice.
        delay_s: each arrives so much later,
        jitter_s: and up to so much on top, so that some overtake others.
        is_out: none arrives.
    """

    loss: float = 0.0
    doubled: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    is_out: bool = False
    seed: int = 1
    _ends: list[int] = field(default_factory=list)

    def lay(self, machines: Mapping[str, Machine], name: str) -> None:
        """Connect two machines, as the device ``name`` of each, and begin to carry frames."""
        for machine in machines.values():
            end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
            self._ends.append(end)
            asked = struct.pack("16sH22x", b"neuros-tap%d", _TAP_WITHOUT_HEADER)
            here = fcntl.ioctl(end, _TUNSETIFF, asked)[:16].rstrip(b"\0").decode()
            run("ip", "link", "set", here, "netns", str(machine.pid), "name", name)
        self._wake, self._woken = os.pipe()
        self._thread = threading.Thread(target=self._carry, name="cable")
        self._thread.start()

    def close(self) -> None:
        """Take it away; the devices go with it."""
        os.close(self._woken)
        self._thread.join()
        for end in (*self._ends, self._wake):
            os.close(end)

    def mend(self) -> None:
        """Let every frame arrive at once, and once."""
        self.loss = self.doubled = self.delay_s = self.jitter_s = 0.0
        self.is_out = False

    def _carry(self) -> None:
        drawn, due = random.Random(self.seed), list[tuple[float, int, int, bytes]]()
        count = 0
        with selectors.DefaultSelector() as selector:
            for fd in (*self._ends, self._wake):
                selector.register(fd, selectors.EVENT_READ)
            while True:
                wait_s = max(0.0, due[0][0] - time.monotonic()) if due else None
                for key, _ in selector.select(wait_s):
                    if key.fd == self._wake:
                        return
                    to = self._ends[1 - self._ends.index(key.fd)]
                    for at_s, frame in self._arrivals(key.fd, drawn):
                        heapq.heappush(due, (at_s, count := count + 1, to, frame))
                while due and due[0][0] <= time.monotonic():
                    _, _, to, frame = heapq.heappop(due)
                    _write(to, frame)

    def _arrivals(self, end: int, drawn: random.Random) -> list[tuple[float, bytes]]:
        """When the next frame of an end arrives at the other: never, once or twice."""
        try:
            frame = os.read(end, _FRAME_BYTES)
        except OSError:  # its device is down
            return []
        if self.is_out or drawn.random() < self.loss:
            return []
        copies = 2 if drawn.random() < self.doubled else 1
        now_s = time.monotonic() + self.delay_s
        return [(now_s + self.jitter_s * drawn.random(), frame) for _ in range(copies)]


def _write(end: int, frame: bytes) -> None:
    try:
        os.write(end, frame)
    except OSError:  # its device is down, or its queue full: lost, as on any cable
        return
