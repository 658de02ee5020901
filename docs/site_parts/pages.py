"""Writes the generated pages into ``docs/reference`` before Sphinx reads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx

from site_parts import catalogue, code, command_line, schema


def _pages(root: Path) -> Iterator[tuple[str, str]]:
    """``(name, Markdown)`` of all generated pages."""
    yield "command_line_options", command_line.page()
    yield "project_schema", schema.page(root, "project")
    yield "node_schema", schema.page(root, "node")
    yield "errors", catalogue.page(root)
    yield from code.pages(root)


def write(app: Sphinx) -> None:
    """Write those that have changed, and remove those that are no more."""
    root, folder = Path(app.srcdir), Path(app.srcdir) / "docs" / "reference"
    wanted = {folder / f"{name}.md": text for name, text in _pages(root)}
    for file in set(folder.rglob("*.md")) - set(wanted):
        file.unlink()
    for file, text in wanted.items():
        if not file.exists() or file.read_text("utf-8") != text:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, "utf-8")
