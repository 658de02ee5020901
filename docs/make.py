#!/usr/bin/env python3
"""Builds the documentation into docs/build/html/index.html: docs/make.py [BUILDER]

It needs `./install.py --docs`, and no network. A warning is an error, and so is a link to
a page, module, class or function that leads nowhere. `docs/make.py linkcheck` looks at links into
the world, too, and does need a network.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def main(arguments: list[str]) -> int:
    """Run Sphinx; returns its exit code."""
    from sphinx.cmd.build import main as sphinx

    builder, *further = arguments or ["html"]
    if "--fresh-env" in further:
        shutil.rmtree(DOCS / "build", ignore_errors=True)  # Sphinx leaves pages of what is no more
    folders = ["-c", str(DOCS), "-d", str(DOCS / "build" / "doctrees"), str(ROOT)]
    strict = ["--fail-on-warning", "--quiet", "--jobs", "auto"]
    code = sphinx(["-b", builder, *strict, *further, *folders, str(DOCS / "build" / builder)])
    if code or builder != "html":
        return code
    from site_parts.finished import dead_links

    site = DOCS / "build" / "html"
    dead = list(dead_links(site))
    print(
        "\n".join([f"dead link: {link}" for link in dead] or [f"documentation: {site}/index.html"])
    )
    return 1 if dead else 0


if __name__ == "__main__":
    venv = ROOT / ".venv"
    python = venv / "bin" / "python"
    if Path(sys.prefix).resolve() != venv.resolve() and python.exists():
        os.execv(python, [str(python), *sys.argv])
    sys.exit(main(sys.argv[1:]))
