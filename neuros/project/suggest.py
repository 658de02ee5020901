"""Words of messages: hints for misspelt names, lists, numbers of things."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MOST_WORDS = 1000  # a comparison with more takes seconds


def did_you_mean(found: str, allowed: Iterable[str]) -> str:
    """``did you mean 'x'?`` for the closest of the allowed words, empty if none is close."""
    words = {word.lower(): word for word in sorted(allowed, reverse=True)[-_MOST_WORDS:]}
    close = difflib.get_close_matches(found.lower(), words, n=1, cutoff=0.6)
    return f"did you mean '{words[close[0]]}'?" if close else ""


def listed(words: Iterable[str]) -> str:
    """``'a', 'b' or 'c'``."""
    quoted = [f"'{word}'" for word in words]
    return " or ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)


def counted(number: int, noun: str) -> str:
    """``1 node`` or ``2 nodes``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
