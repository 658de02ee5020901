"""The site's navigation, from the tables of ``docs/index.md`` and the headings of the gallery.

The sidebar calls a page what the table calls it.
"""

from __future__ import annotations

import posixpath
import re
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

_INDEX, _GALLERY = "docs/index", "examples/README"
# Not written by hand, so GitHub has no page to link to; they stand below the pages of that section.
_GENERATED = tuple(
    f"/docs/reference/{name}"
    for name in (
        "command_line_options",
        "project_schema",
        "node_schema",
        "errors",
        "code",
        "diagrams",
    )
)
_GENERATED_IN = "Reference"
_SECTION = re.compile(r"^## (.+)$", re.MULTILINE)
_ROW = re.compile(r"^\| \[([^\]]+)\]\(([^)#]+\.md)\)", re.MULTILINE)
_EXAMPLE = re.compile(r"^## \[([^\]]+)\]\(([^)#]+\.md)\)", re.MULTILINE)


def add_toctrees(app: Sphinx, page: str, source: list[str]) -> None:
    """Give the front page a table of contents per section: the pages that its table links to."""
    if page == _INDEX:
        parts = _SECTION.split(source[0])
        for title, text in zip(parts[1::2], parts[2::2], strict=True):
            entries = [_entry("docs", *row) for row in _ROW.findall(text)]
            source[0] += _toctree(
                title, entries + list(_GENERATED if title == _GENERATED_IN else ())
            )
    elif page == _GALLERY:
        examples = _EXAMPLE.findall(source[0])
        source[0] += _toctree("", [_entry("examples", *example) for example in examples])


def leave_out_of_source(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None
) -> None:
    """No navigation beside source code: 350 pages of it, each with all of it, take a minute."""
    if page.startswith("_modules/"):
        context["toctree"] = lambda **_: ""


def _toctree(title: str, entries: list[str]) -> str:
    listed = "\n".join(entries)
    caption = f":caption: {title}\n" if title else ""
    return f"\n```{{toctree}}\n:hidden:\n{caption}\n{listed}\n```\n"


def _entry(folder: str, title: str, link: str) -> str:
    """A line of a toctree: the title that the table gives, and the page from the root."""
    page = posixpath.normpath(posixpath.join(folder, link)).removesuffix(".md")
    return f"{title} </{page}>"
