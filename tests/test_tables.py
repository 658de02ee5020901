"""Tables of text."""

from __future__ import annotations

import pytest
from tabulate import tabulate

from neuros.tables import table

HEADER = ("node", "sent\nin all", "remark")


def test_columns_are_as_wide_as_what_is_in_them() -> None:
    rows = [("a", 5, ""), ("a_long_name", None, "never reported")]
    assert table(HEADER, rows, right=[1]).split("\n") == [
        "node             sent  remark",
        "               in all",
        "-----------  --------  --------------",
        "a                   5",
        "a_long_name         ?  never reported",
    ]


@pytest.mark.parametrize("rows", [[], [("a", "10", "x")], [("a", "10", "x"), ("bcdefgh", "9", "")]])
def test_they_look_as_those_of_tabulate(rows: list[tuple[str, str, str]]) -> None:
    sides = ("left", "right", "left") if rows else None
    theirs = tabulate(rows, HEADER, disable_numparse=True, colalign=sides)
    right = [1] if rows else []
    assert table(HEADER, rows, right) == "\n".join(map(str.rstrip, theirs.split("\n")))
