"""Many messages of one type as columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from neuros.observe.bag.layout import (
    LITTLE_ENDIAN,
    Irregular,
    Layout,
    field_names,
    layout_of,
)

Column = npt.NDArray[Any]

_MOST_LAYOUTS = 64


class TypeStore(Protocol):
    """What is needed of ``rosbags.typesys.store.Typestore``."""

    @property
    def fielddefs(self) -> Mapping[str, Any]: ...
    def deserialize_cdr(self, rawdata: bytes, typename: str) -> Any: ...


def columns_of(packets: Sequence[bytes], type_name: str, store: TypeStore) -> dict[str, Column]:
    """One column for each field, with one row for each message.

    Fields of messages within the message have names with dots, ``header.stamp.sec``. Arrays of
    numbers have a column with more than one dimension; so have sequences, where all are of the same
    length. Strings are ``str``. What is left (sequences of different length, or of messages) is in
    a column of objects.
    """
    if not packets:
        return _of_none(type_name, store)
    found: dict[str, list[tuple[npt.NDArray[np.intp], Column]]] = {}
    for rows, columns in _parts(packets, type_name, store):
        for name, column in columns.items():
            found.setdefault(name, []).append((rows, column))
    return {name: _join(parts, len(packets)) for name, parts in found.items()}


def _of_none(type_name: str, store: TypeStore) -> dict[str, Column]:
    """The columns of no message: those of one whose strings and sequences are empty."""
    try:
        layout = layout_of(LITTLE_ENDIAN, type_name, store.fielddefs)
    except Irregular:
        return {name: np.empty(0, object) for name in field_names(type_name, store.fielddefs)}
    numbers = {name: np.zeros((0, *kind.shape), kind.base) for name, kind, _ in layout.numbers}
    return numbers | {name: np.zeros(0, "U1") for name, _, _ in layout.texts}


def _parts(
    packets: Sequence[bytes], type_name: str, store: TypeStore
) -> Iterator[tuple[npt.NDArray[np.intp], dict[str, Column]]]:
    """Groups of messages with the same layout, and those without one in the end."""
    sizes = np.fromiter(map(len, packets), dtype=np.intp, count=len(packets))
    rest: list[npt.NDArray[np.intp]] = []
    layouts = 0
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        table = np.frombuffer(b"".join(packets[row] for row in rows.tolist()), np.uint8)
        table = table.reshape(len(rows), size)
        while len(rows):
            try:
                if layouts == _MOST_LAYOUTS:
                    raise Irregular
                layout = layout_of(table[0].tobytes(), type_name, store.fielddefs)
            except (Irregular, IndexError):
                rest.append(rows)
                break
            layouts += 1
            fits = _fits(table, layout)
            yield rows[fits], _take(np.ascontiguousarray(table[fits]), layout)
            rows, table = rows[~fits], table[~fits]
    if rest:
        rows = np.concatenate(rest)
        yield rows, _one_by_one([packets[row] for row in rows.tolist()], type_name, store)


def _fits(table: Column, layout: Layout) -> npt.NDArray[np.bool_]:
    fits = np.ones(len(table), np.bool_)
    for place in layout.lengths:
        fits &= (table[:, place : place + 4] == table[0, place : place + 4]).all(axis=1)
    fits &= (table[:, :4] == table[0, :4]).all(axis=1)
    return fits


def _take(table: Column, layout: Layout) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    size = table.shape[1]
    for name, kind, place in layout.numbers:
        view = np.dtype({"names": ["x"], "formats": [kind], "offsets": [place], "itemsize": size})
        columns[name] = table.view(view)["x"][:, 0] if kind.itemsize else _empty(len(table), kind)
    for name, place, length in layout.texts:
        if length:
            raw = np.ascontiguousarray(table[:, place : place + length]).view(f"S{length}")[:, 0]
            columns[name] = np.char.decode(raw, "utf-8", "replace")
        else:
            columns[name] = np.zeros(len(table), "U1")
    return columns


def _empty(count: int, kind: np.dtype[Any]) -> Column:
    return np.zeros((count, 0), kind.base)


def _one_by_one(packets: Sequence[bytes], type_name: str, store: TypeStore) -> dict[str, Column]:
    columns: dict[str, list[Any]] = {}
    for data in packets:
        for name, value in _flat(store.deserialize_cdr(data, type_name), ""):
            columns.setdefault(name, []).append(value)
    return {name: _objects_or_numbers(values) for name, values in columns.items()}


def _flat(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in message.__dataclass_fields__:
        if name == "__msgtype__":
            continue
        value = getattr(message, name)
        if hasattr(value, "__dataclass_fields__"):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _objects_or_numbers(values: Sequence[Any]) -> Column:
    if isinstance(values[0], (bool, int, float, str, np.generic)):
        return np.array(values)
    column = np.empty(len(values), object)
    for place, value in enumerate(values):
        column[place] = value
    return column


def _join(parts: Sequence[tuple[npt.NDArray[np.intp], Column]], count: int) -> Column:
    shapes = {column.shape[1:] for _, column in parts}
    if len(shapes) == 1 and all(column.dtype != object for _, column in parts):
        if len(parts) == 1 and len(parts[0][0]) == count:
            joined = np.empty_like(parts[0][1])
        else:
            kind = np.result_type(*(column.dtype for _, column in parts))
            joined = np.empty((count, *shapes.pop()), kind)
        for rows, column in parts:
            joined[rows] = column
        return joined
    objects = np.empty(count, object)
    for rows, column in parts:
        for row, value in zip(rows, column, strict=True):
            objects[row] = value
    return objects
