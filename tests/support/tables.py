"""Tables that a command writes into a page of the documentation."""

from __future__ import annotations

from pathlib import Path

BEGIN, END = "<!-- generated: begin -->\n", "<!-- generated: end -->"


def write_table(file: Path, text: str) -> None:
    """Write a table into a file, between the marks of what is generated if it has them."""
    whole = file.read_text("utf-8") if file.exists() else ""
    before, begin, rest = whole.partition(BEGIN)
    _, end, after = rest.partition(END)
    file.write_text(f"{before}{begin}\n{text}\n{end}{after}" if end else text, "utf-8")


def update_rows(file: Path, head: str, row: str, keys: int) -> None:
    """Put a row into a table in a page; one whose first ``keys`` cells are equal gives way."""
    text = file.read_text("utf-8") if file.exists() else ""
    inside = text.partition(BEGIN)[2].partition(END)[0] if BEGIN in text else text
    found = {_key(line, keys): line for line in inside.splitlines() if line.startswith("|")}
    rule = "|" + " --- |" * (head.count("|") - 1)
    rows = {_key(line, keys): line for line in (head, rule)} | found | {_key(row, keys): row}
    write_table(file, "\n".join([head, rule, *[r for r in rows.values() if r not in (head, rule)]]))


def _key(row: str, cells: int) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in row.split("|")[1 : cells + 1])
