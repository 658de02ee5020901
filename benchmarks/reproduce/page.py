"""``index.md``: sections of text, a table and a figure each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tabulate import tabulate

from benchmarks.reproduce.tables import Table


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes:
        text: paragraphs of plain text.
        figures: PNG files.
    """

    title: str
    text: Sequence[str] = ()
    table: Table | None = None
    figures: Sequence[Path] = ()


@dataclass(frozen=True)
class Page:
    """A title and sections."""

    title: str
    sections: Sequence[Section]

    def markdown(self, folder: Path) -> str:
        """For a file in ``folder``; figures are linked."""
        parts = [f"# {self.title}"]
        for section in self.sections:
            parts += [f"## {section.title}"] if section.title else []
            parts += section.text
            parts += [markdown_table(section.table)] if section.table else []
            parts += [
                f"![{section.title}]({figure.relative_to(folder).as_posix()})"
                for figure in section.figures
            ]
        return "\n\n".join(parts) + "\n"


def markdown_table(table: Table) -> str:
    """The table for Markdown."""
    numbers = ("right",) * (len(table.headers) - 1)
    return str(
        tabulate(
            table.rows,
            headers=table.headers,
            tablefmt="pipe",
            disable_numparse=True,
            colalign=("left", *numbers) if table.rows else None,
        )
    )
