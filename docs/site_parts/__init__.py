"""What Sphinx is taught for this site: generated pages, links, diagrams, and the order of pages."""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx

from site_parts import code, command_line, contents, diagrams, links, pages, wrapping


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_domain(links.Python, override=True)
    app.connect("builder-inited", pages.write)
    app.connect("source-read", contents.add_toctrees)
    app.connect("source-read", command_line.add_option_tables)
    app.connect("autodoc-process-docstring", code.leave_out_aliases)
    app.connect("doctree-read", links.lead_to_pages)
    app.connect("doctree-read", wrapping.keep_words_whole)
    app.add_directive("mermaid", diagrams.Mermaid)
    app.connect("html-page-context", diagrams.add_scripts)
    app.connect("html-page-context", contents.leave_out_of_source, priority=400)  # before the theme
    return {"parallel_read_safe": True, "parallel_write_safe": True}
