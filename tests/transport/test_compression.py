"""Compressed packets arrive as they were, padding behind them or not; broken ones are refused."""

from __future__ import annotations

import os
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.errors import EnvironmentFault, ProtocolError
from neuros.transport import envelope
from neuros.transport.codecs import COMPRESSED_MARK
from neuros.transport.envelope import Compressor, Traffic, compressing, decompressing

HEADER = b"\0\1\0\0"
IMAGE = HEADER + bytes(100_000)


def received(data: bytes) -> bytes:
    got: list[bytes] = []
    decompressing(got.append)(data)
    return got[0]


@given(st.binary(max_size=100) | st.binary(max_size=9).map(lambda each: each * 1000))
def test_what_was_sent_is_received(body: bytes) -> None:
    sent = Compressor().compress(HEADER + body)
    assert len(sent) <= len(HEADER + body)
    padding = bytes(-len(sent) % 4) if sent[2:4] == COMPRESSED_MARK else b""
    assert received(sent + padding) == HEADER + body


def test_what_would_become_larger_goes_as_it_is() -> None:
    noise = HEADER + os.urandom(1000)
    assert Compressor().compress(noise) is noise


def test_the_connections_of_an_output_share_what_is_compressed() -> None:
    compressor = Compressor()
    assert compressor.compress(IMAGE) is compressor.compress(IMAGE)
    assert len(compressor.compress(IMAGE)) < 100


def test_bytes_are_counted_before_and_after() -> None:
    sent: list[bytes] = []
    traffic = Traffic()
    publish = compressing(Compressor(), traffic, lambda: 1, sent.append)
    publish(IMAGE)
    publish(IMAGE)
    assert traffic == Traffic(2 * len(IMAGE), 2 * len(sent[0]))


def test_what_others_read_too_goes_as_it_is() -> None:
    sent: list[bytes] = []
    traffic = Traffic()
    compressing(Compressor(), traffic, lambda: 2, sent.append)(IMAGE)
    assert sent == [IMAGE]
    assert traffic == Traffic(len(IMAGE), len(IMAGE))


@pytest.mark.parametrize(
    "broken",
    [
        Compressor().compress(IMAGE)[:12],
        Compressor().compress(IMAGE)[:-1],
        HEADER[:2] + COMPRESSED_MARK,
        HEADER[:2] + COMPRESSED_MARK + b"no frame of Zstandard, and no message either",
        # A frame whose header claims 2^40 bytes.
        HEADER[:2] + COMPRESSED_MARK + b"\x28\xb5\x2f\xfd\xe0" + (1 << 40).to_bytes(8, "little"),
    ],
)
def test_a_broken_packet_is_refused(broken: bytes) -> None:
    with pytest.raises(ProtocolError, match="a compressed packet cannot be read"):
        received(broken)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("backports", "compression"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(EnvironmentFault, match=r"pip install backports\.zstd"):
        envelope._library.__wrapped__()
