"""Values that a plugin keeps: what they may be, and that each comes back as it was."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from neuros.errors import NodeError
from neuros.node.keeping import Keeping, decoded, encoded

ARRAYS = arrays.arrays(
    arrays.scalar_dtypes() | arrays.array_dtypes(), arrays.array_shapes(min_dims=0, min_side=0)
)
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
VALUES = st.recursive(
    PLAIN | ARRAYS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=8
)


def is_same(a: Any, b: Any) -> bool:
    """Whether types and contents are the same, NaN included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, dict):
        return [*a] == [*b] and all(is_same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(is_same, a, b))
    return bool(a == b) or (isinstance(a, float) and math.isnan(a) and math.isnan(b))


@given(VALUES)
def test_a_value_comes_back_as_it_was_and_equal_values_make_equal_files(value: Any) -> None:
    data = encoded(value)
    assert is_same(decoded(data), value)
    assert encoded(decoded(data)) == data


def test_numpy_shows_the_arrays_of_a_file_by_their_place(tmp_path: Path) -> None:
    file = tmp_path / "weights.npz"
    file.write_bytes(encoded({"hidden": [np.ones(3), np.zeros(2)], "rate": 0.5}))
    with np.load(file) as seen:
        assert seen["hidden/0"].tolist() == [1, 1, 1]
        assert seen["hidden/1"].tolist() == [0, 0]


def test_places_that_look_alike_are_kept_apart() -> None:
    value = {"a/b": np.ones(1), "a": {"b": np.zeros(1)}, "../x": np.full(1, 2.0), "": np.arange(2)}
    assert is_same(decoded(encoded(value)), value)


def test_a_file_by_savez_is_a_dict_of_its_arrays() -> None:
    file = io.BytesIO()
    np.savez(file, weights=np.eye(2), bias=np.ones(2))
    assert is_same(decoded(file.getvalue()), {"weights": np.eye(2), "bias": np.ones(2)})


def test_numbers_of_numpy_come_back_as_those_of_python() -> None:
    assert decoded(encoded([np.float32(0.5), np.int64(3), np.bool_(True)])) == [0.5, 3, True]


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ((1, 2), "'w' is a tuple, which cannot be kept"),
        ({"layers": [np.ones(2), {1, 2}]}, "'w'['layers']['1'] is a set"),
        ({1: "key"}, "'w' is a dict, which cannot be kept"),
        (np.array([None]), "'w' is a numpy.ndarray of objects"),
        (np.ma.masked_array([1.0]), "'w' is a numpy.ma.MaskedArray"),
        (1j, "'w' is a complex"),
        (Path("x"), "'w' is a pathlib.PosixPath"),
    ],
)
def test_what_cannot_be_kept_is_refused_by_its_place(
    tmp_path: Path, value: object, said: str
) -> None:
    keeping = Keeping("brain", tmp_path, ())
    keeping.register("w", lambda: value, lambda _: None)
    with pytest.raises(NodeError, match=said.replace("[", r"\[") + ".*give a NumPy array"):
        keeping.save("w")
    assert not [*tmp_path.glob("kept/*")]


def test_a_value_within_itself_is_refused(tmp_path: Path) -> None:
    value: list[Any] = []
    value.append(value)
    keeping = Keeping("brain", tmp_path, ())
    keeping.register("w", lambda: value, lambda _: None)
    with pytest.raises(NodeError, match=r"'w'.*recursion"):
        keeping.save("w")


def pickled() -> bytes:
    file = io.BytesIO()
    np.savez(file, weights=np.array([Path()], dtype=object))
    return file.getvalue()


def of(structure: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("structure.json", structure)
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        *(
            b"",
            b"text",
            pickled(),
            encoded([1])[:-4],
            of("{"),
            of("[]"),
            of("{}"),
            of('{"list": 3}'),
        ),
        *(of('{"array": "gone"}'), of('{"nonsense": "gone"}'), of('{"dict": {"a": 1}}')),
    ],
)
def test_a_file_that_holds_no_value_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="it is no value that was kept"):
        decoded(data)


@pytest.mark.parametrize("name", ["", "a b", "../up", "1st", "a.b", 3])
def test_a_name_is_a_word(tmp_path: Path, name: str) -> None:
    with pytest.raises(NodeError, match="is no name: it may have letters, digits and '_'"):
        Keeping("brain", tmp_path, ()).register(name, list, list)


def test_a_name_is_given_once_and_with_two_functions(tmp_path: Path) -> None:
    keeping = Keeping("brain", tmp_path, ())
    with pytest.raises(NodeError, match="'w': give a function that returns the value, and one"):
        keeping.register("w", list, [])  # type: ignore[arg-type]
    keeping.register("w", list, list)
    with pytest.raises(NodeError, match="'w' is kept already"):
        keeping.register("w", list, list)
