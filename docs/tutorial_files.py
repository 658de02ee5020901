"""The files that the tutorial has its reader write: for its test, and for its pictures."""

from __future__ import annotations

import re
from pathlib import Path

_BLOCK = re.compile(r"^```(json|xml|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def steps() -> list[str]:
    """The text of each step."""
    page = Path(__file__).with_name("tutorial.md").read_text("utf-8")
    return re.split(r"^## (?=\d)", page.partition("## Where to go")[0], flags=re.MULTILINE)[1:]


def files_of(step: str) -> dict[str, str]:
    """Text by path. A plugin begins with its path; the sentence before other files names theirs."""
    files = {}
    for block in _BLOCK.finditer(step):
        language, text = block.groups()
        places = (
            (text, r"\A# (\S+)\n")
            if language == "python"
            else (
                step[: block.start()],
                rf"`(\w+/\w+\.{language})`",
            )
        )
        files[re.findall(places[1], places[0])[-1]] = text
    return files
