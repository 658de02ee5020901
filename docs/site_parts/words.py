"""Plain text inside Markdown."""

from __future__ import annotations

import re

_SIGN = re.compile(r"([\\*_<>\[\]{}$#~])")


def as_text(text: str) -> str:
    """Text in which nothing means anything to Markdown, but for code in backquotes."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    return "".join(p if p.startswith("`") else _SIGN.sub(r"\\\1", p) for p in parts)


def cell(text: str) -> str:
    """Text for a cell of a table."""
    return text.replace("|", r"\|").replace("\n", " ")
