"""A project as its files say it: read, put together, and not judged yet."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from neuros.errors import Problem
from neuros.project.paths import PathError, Roots
from neuros.project.scanner import SourceError, display_name, read_file
from neuros.project.source import Element


@dataclass
class Draft:
    """The elements of a project's files, with node files in the place of their paths.

    Attributes:
        root: the document of the project file.
        nodes: the objects that describe nodes, in order.
        entries: for each of them, the entry of the project file that it comes from.
        is_complete: whether every entry of ``nodes`` could be read; where it could not, nobody
            knows which nodes are missing.
        problems: what was wrong while reading.
    """

    root: Element
    roots: Roots
    nodes: list[Element] = field(default_factory=list)
    entries: list[Element] = field(default_factory=list)
    is_complete: bool = True
    problems: list[Problem] = field(default_factory=list)

    @property
    def connections(self) -> list[Element]:
        """The objects that describe connections, in order."""
        return [item for item in self.root.items("connections") if isinstance(item.value, dict)]


def read_draft(file: Path, roots: Roots) -> Draft:
    """Read a project file and its node files. Raises :class:`SourceError` for the first only."""
    root, duplicates = read_file(file)
    nodes = root.member("nodes")
    is_list = nodes is not None and isinstance(nodes.value, list)
    draft = Draft(root, roots, is_complete=is_list, problems=duplicates)
    for entry in root.items("nodes"):
        _expand(draft, entry, (file,))
        draft.entries += [entry] * (len(draft.nodes) - len(draft.entries))
    return draft


def _expand(draft: Draft, entry: Element, chain: tuple[Path, ...]) -> None:
    """Add the node, or nodes, of an entry; ``chain`` is the files that lead to it."""
    if isinstance(entry.value, dict):
        draft.nodes.append(entry)
    elif isinstance(entry.value, list) and len(chain) > 1:
        for item in entry.value:
            _expand(draft, item, chain)
    elif isinstance(entry.value, str) and entry.value:
        _import(draft, entry, chain)
    else:
        draft.is_complete = False
        if len(chain) > 1:
            draft.problems.append(
                entry.problem(
                    "a node file holds a node, the path of another node file, or a list of both"
                )
            )


def _import(draft: Draft, entry: Element, chain: tuple[Path, ...]) -> None:
    try:
        file = draft.roots.find(entry.value, entry.source.folder)
        if file in chain:
            loop = " -> ".join(display_name(link) for link in (*chain[chain.index(file) :], file))
            raise PathError(f"node files import each other in a circle: {loop}")
        element, duplicates = read_file(file)
    except PathError as error:
        draft.problems.append(entry.problem(error.text, error.hint))
        draft.is_complete = False
    except SourceError as error:
        draft.problems.append(error.problem)
        draft.is_complete = False
    else:
        draft.problems.extend(duplicates)
        _expand(draft, element, (*chain, file))
