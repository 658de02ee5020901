"""Numbered packets whose content is checked where they arrive."""

import os
import random
import struct
import time
from array import array

import xxhash

COUNT = int(os.environ["COUNT"])
"""So many packets of each sender are in its chain of hashes."""

_LARGEST = int(os.environ["LARGEST"])
# The first of so many packets has this size; all others have 8 bytes.
_SIZES = ((10_000, _LARGEST), (1_000, 1 << 20), (100, 1 << 16), (10, 1 << 10))
_SMALL = 8
_SAMPLES = 20_000
_STRIDE = COUNT // _SAMPLES + 1


def _size_of(number):
    return next((min(s, _LARGEST) for every, s in _SIZES if number % every == 1), _SMALL)


def _linked(chain, number, digest):
    return xxhash.xxh3_64_intdigest(struct.pack("QQQ", chain, number, digest))


class Sender:
    """Fills packets, and keeps the chain of their hashes."""

    def __init__(self):
        self.count = self.chain = 0
        self._bytes = memoryview(random.Random(os.getpid()).randbytes(_LARGEST + 1000))

    def fill(self, node, image):
        self.count += 1
        start = self.count % 997
        image.data = array("B", self._bytes[start : start + _size_of(self.count)])
        digest = xxhash.xxh3_64_intdigest(image.data)
        if self.count <= COUNT:
            self.chain = _linked(self.chain, self.count, digest)
        image.header.frame_id = f"{node.name} {self.count} {digest}"
        image.header.stamp.sec, image.header.stamp.nanosec = divmod(time.monotonic_ns(), 10**9)
        return image

    def told(self):
        return {"count": self.count, "chain": self.chain}


class Receiver:
    """Checks packets: content, number; keeps the chain of their hashes, and the ages of some.

    Raises:
        ValueError: for a packet that is not as it was sent, comes twice or out of order.
    """

    def __init__(self):
        self.by_source = {}
        self._ages_ms = []
        self._small = 0

    def take(self, image):
        stamp = image.header.stamp
        age_s = time.monotonic() - stamp.sec - stamp.nanosec * 1e-9
        source, number, digest = image.header.frame_id.split()
        number, digest = int(number), int(digest)
        if xxhash.xxh3_64_intdigest(image.data) != digest or len(image.data) != _size_of(number):
            raise ValueError(f"packet {number} of {source} is not as it was sent")
        seen = self.by_source.setdefault(source, {"last": 0, "count": 0, "chain": 0, "skipped": 0})
        if number <= seen["last"]:
            raise ValueError(f"packet {number} of {source} came after {seen['last']}")
        seen["skipped"] = max(seen["skipped"], number - seen["last"] - 1)
        seen["last"] = number
        seen["count"] += 1
        if seen["count"] <= COUNT:
            seen["chain"] = _linked(seen["chain"], number, digest)
        if len(image.data) == _SMALL:
            self._small += 1
            if self._small % _STRIDE == 0:
                self._ages_ms.append(1e3 * age_s)

    def told(self):
        return {"sources": self.by_source, "ages_ms": self._ages_ms}
