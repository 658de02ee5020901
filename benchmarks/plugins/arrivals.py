"""What a receiver has seen: how long paced packets were under way, how many others came.

A sender marks each packet with text: ``paced <moment>`` for one that has the graph to itself, and
``flood <sender> <number>`` for one of those that are sent as fast as possible. Plugins and the
programs without NeuROS both count with this.
"""

import time

WARM_UP_S = 0.3


def paced():
    """The text of a packet that is sent now; all processes of a machine share this clock."""
    return f"paced {time.monotonic_ns()}"


def flood(sender, number):
    """The text of packet ``number`` of those that ``sender`` sends as fast as it can."""
    return f"flood {sender} {number}"


class Arrivals:
    """Counts for ``seconds``, from :data:`WARM_UP_S` after the first packet of the flood on."""

    def __init__(self, seconds):
        self._seconds = seconds
        self._latencies_us = []
        self._start_s = None
        self._first_s = self._last_s = 0.0
        self._count = 0
        self._numbers = {}  # of each sender: the first and the last that came

    def take(self, text):
        """Take note of a packet; returns whether all is measured."""
        now_s = time.monotonic()
        kind, *rest = text.split()
        if kind == "paced":
            self._latencies_us.append(now_s * 1e6 - int(rest[0]) / 1e3)
            return False
        if self._start_s is None:
            self._start_s = now_s + WARM_UP_S
        if now_s < self._start_s:
            return False
        self._count += 1
        self._first_s, self._last_s = self._first_s or now_s, now_s
        sender, number = rest[0], int(rest[1])
        first, _ = self._numbers.get(sender, (number, number))
        self._numbers[sender] = (first, number)
        return now_s > self._start_s + self._seconds

    def result(self):
        """Packets per second, the share of the sent ones that this is, median latency in us."""
        sent = sum(last - first + 1 for first, last in self._numbers.values())
        duration_s = self._last_s - self._first_s
        result = {
            "rate": (self._count - 1) / duration_s if duration_s else 0.0,
            "delivered": self._count / sent if sent else 0.0,
        }
        if self._latencies_us:
            result["latency"] = sorted(self._latencies_us)[len(self._latencies_us) // 2]
        return result
