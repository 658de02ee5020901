"""Mermaid blocks, which GitHub draws by itself, drawn by the vendored Mermaid in the browser.

Classic scripts, not modules: browsers load no modules for pages that are opened as files.
"""

from __future__ import annotations

from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

_CLASS = "mermaid"


class Mermaid(Directive):
    """A diagram; what it says can still be read where no JavaScript runs."""

    has_content = True
    option_spec: ClassVar[dict[str, Any]] = {}

    def run(self) -> list[nodes.Node]:
        """The text of the diagram, for ``diagrams.js``."""
        text = nodes.Text("\n".join(self.content))
        escaped = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
        html = f'<pre class="{_CLASS}">{escaped}</pre>'
        return [nodes.raw("", html, format="html", classes=[_CLASS])]


def add_scripts(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None
) -> None:
    """Load Mermaid (3.5 MB) on pages that have a diagram, and on no other."""
    if doctree and any(_CLASS in node["classes"] for node in doctree.findall(nodes.raw)):
        app.add_js_file("mermaid.min.js")
        app.add_js_file("diagrams.js")
