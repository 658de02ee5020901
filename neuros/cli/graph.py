"""``neuros graph``: a project as text or as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from neuros.cli.projects import load
from neuros.errors import UsageError
from neuros.project.graph import graph_mermaid, graph_text
from neuros.project.graph_svg import graph_svg

_MAKERS = {"text": graph_text, "mermaid": graph_mermaid, "svg": graph_svg}
_SUFFIXES = {".svg": "svg", ".mmd": "mermaid", ".mermaid": "mermaid"}


def write_graph(options: argparse.Namespace) -> int:
    """Write the graph of a project to the terminal, or to a file.

    Raises:
        UsageError: if the file cannot be written.
    """
    kind = options.format or _SUFFIXES.get(Path(options.output or "").suffix, "text")
    text = _MAKERS[kind](load(options, reads_plugins=False))
    if options.output is None:
        print(text)
        return 0
    try:
        Path(options.output).write_text(text, "utf-8")
    except OSError as error:
        raise UsageError(f"-o {options.output}: cannot be written ({error.strerror})") from error
    return 0
