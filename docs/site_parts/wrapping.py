"""Where code in a sentence, or in the cell of a table, may be broken into two lines."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx

_LONGEST = 24
"""Characters of a word that fits into any column: longer ones, such as paths, may be broken."""


def keep_words_whole(app: Sphinx, document: nodes.document) -> None:
    """Mark code of short words: browsers break lines behind each hyphen, as in ``--node``."""
    for literal in document.findall(nodes.literal):
        if all(len(word) <= _LONGEST for word in literal.astext().split()):
            literal["classes"].append("whole")
