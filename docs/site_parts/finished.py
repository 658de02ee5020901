"""A look at the finished site: every link and picture in it leads somewhere, without a network."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import unescape
from os.path import normpath
from pathlib import Path
from urllib.parse import unquote

# Sphinx writes whole tags, with every value in double quotes.
_TAG = re.compile(r"<(a|img|script|link)\s[^>]*?\b(href|src)=\"([^\"]+)\"")
_ANCHOR = re.compile(r"<[^>]*\sid=\"([^\"]+)\"")
_LINKS = {("a", "href"), ("img", "src"), ("script", "src"), ("link", "href")}
_LOADED = {"img", "script", "link"}
_ELSEWHERE = ("http:", "https:", "mailto:")


class _Page:
    """What a page links to, by tag, and what can be linked to on it."""

    def __init__(self, file: Path) -> None:
        text = file.read_text("utf-8")
        found = set(_TAG.findall(text))
        self.links = {(tag, unescape(link)) for tag, name, link in found if (tag, name) in _LINKS}
        self.anchors = {"", *map(unescape, _ANCHOR.findall(text))}


def dead_links(site: Path) -> Iterator[str]:
    """``page: link`` for each that leads nowhere, and for each part that comes from elsewhere."""
    pages = {file: _Page(file) for file in sorted(site.rglob("*.html"))}
    for file, page in pages.items():
        for tag, link in sorted(page.links):
            if link.startswith(_ELSEWHERE):
                is_dead = tag in _LOADED
            else:
                is_dead = not link.startswith("data:") and not _leads_somewhere(pages, file, link)
            if is_dead:
                yield f"{file.relative_to(site)}: {link}"


def _leads_somewhere(pages: dict[Path, _Page], file: Path, link: str) -> bool:
    path, _, anchor = link.partition("#")
    target = Path(normpath(file.parent / unquote(path.partition("?")[0]))) if path else file
    if target in pages:
        return unquote(anchor) in pages[target].anchors
    return target.exists()
