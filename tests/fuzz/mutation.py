"""Changed inputs: bytes, JSON and XML that are nearly right.

Every function takes a ``random.Random``, which hypothesis or a seed stands behind.
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

Mutate = Callable[[bytes, random.Random], bytes]

_NUMBERS = (0, 1, 255, 1 << 16, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, (1 << 63) - 1, (1 << 64) - 1)
_BIG = 10**30
_WORDS = (
    *("", "a", "b.x", "/", "..", "../../etc/passwd", "#", "@", "##", "\0", "é", "\ud800", "nan"),
    *("-1", "1e400", "x" * 300, "x" * 5000, "a/" * 2500, "a.out -> b.in", "std_msgs/msg/String"),
)


class _Written(str):
    """JSON as it is to be written."""


def _deep(levels: int) -> _Written:
    return _Written("[" * levels + "]" * levels)


_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 0.5, _BIG, -_BIG, 1 << 63, 1e308, 5e-324, [], {}, [[]], [{}]),
    *(_Written("NaN"), _Written("Infinity"), _Written("-Infinity"), _Written("1e400")),
    *(_Written('{"a": 1, "a": 2}'), _Written("9" * 5000), _deep(99), _deep(5000)),
    *_WORDS,
)


def change_bytes(data: bytes, chance: random.Random) -> bytes:
    """Flip, cut, insert, repeat or overwrite some bytes."""
    found = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at = chance.randint(0, len(found))
        length = chance.choice((1, 2, 4, 8, 64))
        match chance.randrange(7):
            case 0 if found:
                found[min(at, len(found) - 1)] ^= 1 << chance.randrange(8)
            case 1:
                del found[at : at + length]
            case 2:
                found[at:at] = chance.randbytes(length)
            case 3:
                found[at:at] = found[at : at + length] * chance.randint(1, 20)
            case 4:
                del found[at:]
            case 5:
                size = chance.choice((1, 2, 4, 8))
                number = chance.choice(_NUMBERS) & ((1 << 8 * size) - 1)
                found[at : at + size] = number.to_bytes(size, chance.choice(("little", "big")))
            case _:
                found[at : at + length] = bytes(length)
    return bytes(found)


def change_text(data: bytes, chance: random.Random) -> bytes:
    """Move, repeat, leave out or replace lines and words."""
    parts = re.split(rb"(\s+)", data) if chance.random() < 0.5 else data.splitlines(keepends=True)
    for _ in range(chance.randint(1, 3)):
        if not parts:
            break
        at = chance.randrange(len(parts))
        match chance.randrange(4):
            case 0:
                del parts[at]
            case 1:
                parts.insert(at, chance.choice(parts))
            case 2:
                parts[at] = chance.choice(_WORDS).encode("utf-8", "surrogatepass")
            case _:
                parts[at] = (parts[at] * chance.choice((2, 100)))[:_MOST_BYTES]
    return b"".join(parts)


def change_json(data: bytes, chance: random.Random) -> bytes:
    """Replace, leave out, repeat or rename values in JSON.

    What is none is changed as bytes, and so is what would be nested too deeply to be written.
    """
    try:
        return _encoded(_changed_json([json.loads(data)], chance))
    except (ValueError, RecursionError, MemoryError):
        return change_bytes(data, chance)


def each_change_of_json(data: bytes) -> Iterator[bytes]:
    """Each value of JSON in turn, replaced by each other one, left out and renamed."""
    root = [json.loads(data)]
    for holder in _holders(root):
        for key in [*holder] if isinstance(holder, dict) else range(len(holder)):
            found = holder[key]
            for value in _VALUES:
                holder[key] = value
                yield _encoded(root)
            holder[key] = found
            if isinstance(holder, dict):
                del holder[key]
                yield _encoded(root)
                holder["#"] = found
                yield _encoded(root)
                del holder["#"]
                holder[key] = found


def _encoded(root: list[Any]) -> bytes:
    return _text(root[0]).encode("utf-8", "surrogatepass")


def _changed_json(root: list[Any], chance: random.Random) -> list[Any]:
    for _ in range(chance.randint(1, 3)):
        holders = [each for each in _holders(root) if each]
        holder = chance.choice(holders)
        key = chance.choice([*holder] if isinstance(holder, dict) else range(len(holder)))
        match chance.randrange(6):
            case 0 if holder is not root:
                del holder[key]
            case 1 if isinstance(holder, dict):
                holder[chance.choice((*holder, *_WORDS))] = holder.pop(key)
            case 2 if isinstance(holder, list) and len(holder) < 1000:
                holder *= chance.choice((2, 50))
            case 3:
                other = chance.choice(holders)
                at = chance.choice([*other] if isinstance(other, dict) else range(len(other)))
                holder[key] = json.loads(_text(other[at])) if _is_plain(other[at]) else None
            case _:
                holder[key] = chance.choice(_VALUES)
    return root


def _holders(value: Any) -> list[Any]:
    inner = value.values() if isinstance(value, dict) else value
    if not isinstance(value, dict | list):
        return []
    return [value, *(holder for each in inner for holder in _holders(each))]


def _is_plain(value: Any) -> bool:
    try:
        json.loads(_text(value))
    except (ValueError, RecursionError):
        return False
    return True


def _text(value: Any) -> str:
    if isinstance(value, _Written):
        return str(value)
    if isinstance(value, dict):
        members = (f"{json.dumps(key)}: {_text(each)}" for key, each in value.items())
        return "{" + ", ".join(members) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_text, value)) + "]"
    return json.dumps(value)


_TAG = re.compile(rb"<(/?)([\w:]+)([^<>]*?)(/?)>")
_ATTRIBUTE = re.compile(rb'([\w:]+)="([^"]*)"')
_XML_VALUES = (
    *(b"", b"nan", b"inf", b"-1", b"0", b"1e400", b"1e300", b"-0.0", b"1e-320", b"0 0 0", b"x"),
    *(b"x" * 5000, b"a" * 300, b"a::b", b"__model__", b"world", b"..", b"file:///etc/passwd"),
    *(b"model://missing", b"package://missing/x.stl", b"9" * 5000, b"true", b"&amp;", b"&lol;"),
    *(b"\xc3\xa9", b"\xff", "²".encode()),
)
_XML_PARTS = (
    b'<!DOCTYPE a [<!ENTITY lol "lol"><!ENTITY b "&lol;&lol;&lol;">]>',
    b'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
    b'<?xml version="1.0" encoding="rot13"?>',
    b"<!-- -->",
    b"<![CDATA[x]]>",
    b"<a>" * 996 + b"</a>" * 996,
    b"<model name='m'>" * 60 + b"</model>" * 60,
)


def change_xml(data: bytes, chance: random.Random) -> bytes:
    """Replace, leave out, repeat or rename elements and attributes, by their text."""
    for _ in range(chance.randint(1, 4)):
        tags = [*_TAG.finditer(data)]
        attributes = [*_ATTRIBUTE.finditer(data)]
        match chance.randrange(8):
            case 0 | 1 | 2 if attributes:
                data = _replaced(data, chance.choice(attributes), 2, chance.choice(_XML_VALUES))
            case 3 if attributes:
                name = chance.choice(attributes)[1]
                data = _replaced(data, chance.choice(attributes), 1, name)
            case 4 if tags:
                data = _replaced(data, chance.choice(tags), 2, chance.choice(tags)[2])
            case 5 if len(tags) > 1:
                place = chance.randrange(len(tags) - 1)
                start, end = tags[place].start(), tags[chance.randrange(place, len(tags))].end()
                data = data[:start] + data[start:end] * chance.choice((0, 2, 3)) + data[end:]
            case 6 if tags:
                start, end = chance.choice(tags).end(), chance.choice(tags).start()
                end = data.find(b"<", start) if end < start else start
                data = data[:start] + chance.choice(_XML_VALUES) + data[max(end, start) :]
            case _:
                at = chance.choice([0, *(tag.end() for tag in tags)])
                data = data[:at] + chance.choice(_XML_PARTS) + data[at:]
        if len(data) > _MOST_BYTES:
            break
    return data


_MOST_BYTES = 1 << 18


def _replaced(data: bytes, match: re.Match[bytes], group: int, text: bytes) -> bytes:
    return data[: match.start(group)] + text + data[match.end(group) :]


def mixed(*ways: Mutate) -> Mutate:
    """Change an input in the first of some ways mostly, and sometimes in another."""

    def change(data: bytes, chance: random.Random) -> bytes:
        found = ways[0] if chance.random() < 0.7 else chance.choice(ways)
        return found(data, chance)[:_MOST_BYTES]

    return change


def changed(seeds: Sequence[bytes], mutate: Mutate, chance: random.Random) -> bytes:
    """One of the seeds, or a changed one."""
    data = chance.choice(seeds)
    return data if chance.random() < 0.02 else mutate(data, chance)
