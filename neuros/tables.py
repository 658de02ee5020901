"""Tables of text, for people: of a run, a sweep, and what commands list.

Every launch ends with one, and the images of nodes have nothing else to make it with.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import zip_longest


def table(
    header: Sequence[str], rows: Sequence[Sequence[object]], right: Collection[int] = ()
) -> str:
    """Lines without blanks at their ends: the header, a rule, and the rows.

    Args:
        header: one text per column; it may have several lines.
        rows: of cells, one per column; ``None`` is shown as ``?``.
        right: places of the columns whose cells end in line, from 0.
    """
    heads = [*zip_longest(*(text.split("\n") for text in header), fillvalue="")]
    cells = [["?" if cell is None else str(cell) for cell in row] for row in rows]
    titles = [max(map(len, column)) + 2 for column in zip(*heads, strict=True)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)] if cells else titles
    widths = [max(pair) for pair in zip(titles, widths, strict=True)]
    lines = [*heads, ["-" * width for width in widths], *cells]
    return "\n".join(_line(line, widths, right) for line in lines)


def _line(cells: Sequence[str], widths: Sequence[int], right: Collection[int]) -> str:
    sized = zip(cells, widths, strict=True)
    aligned = (c.rjust(w) if place in right else c.ljust(w) for place, (c, w) in enumerate(sized))
    return "  ".join(aligned).rstrip()
