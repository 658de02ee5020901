"""``index.md`` and ``index.html``: sections of text, a table and a figure each."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tabulate import tabulate

from benchmarks.reproduce.tables import Table

_STYLE = """\
body { font: 15px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; font-size: 90%; }
td, th { padding: .2em .8em; border-bottom: 1px solid #ddd; text-align: right; }
td:first-child, th:first-child { text-align: left; }
img { max-width: 100%; }
"""


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

    def html(self) -> str:
        """One file, with figures in it."""
        title = html.escape(self.title)
        parts = [f"<h1>{title}</h1>"]
        for section in self.sections:
            name = html.escape(section.title)
            parts += [f"<h2>{name}</h2>"] if name else []
            parts += [f"<p>{html.escape(text)}</p>" for text in section.text]
            parts += [_table(section.table, "html")] if section.table else []
            for figure in section.figures:
                data = base64.b64encode(figure.read_bytes()).decode()
                parts.append(f'<p><img alt="{name}" src="data:image/png;base64,{data}"></p>')
        head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        return (
            f"<!DOCTYPE html>\n<html><head>{head}</head>\n<body>\n"
            + "\n".join(parts)
            + "\n</body></html>\n"
        )


def markdown_table(table: Table) -> str:
    """The table for Markdown."""
    return _table(table, "pipe")


def _table(table: Table, form: str) -> str:
    numbers = ("right",) * (len(table.headers) - 1)
    return str(
        tabulate(
            table.rows,
            headers=table.headers,
            tablefmt=form,
            disable_numparse=True,
            colalign=("left", *numbers) if table.rows else None,
        )
    )
