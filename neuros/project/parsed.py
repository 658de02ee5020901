"""Parsed project: the JSON of its files, node files merged in, before validation."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from neuros.errors import Problem
from neuros.project.names import Names, names_from
from neuros.project.paths import PathError, Roots
from neuros.project.scanner import SourceError, display_name, read_file
from neuros.project.source import Element

ENDS = ("source_node", "source_output", "destination_node", "destination_input")
"""The keys of a connection that name its ends."""


@dataclass
class ParsedProject:
    """The elements of a project's files, with node files in the place of their paths.

    Attributes:
        root: the document of the project file.
        nodes: the objects that describe nodes, in order.
        entries: for each of them, the entry of the project file that it comes from.
        is_complete: whether every entry of ``nodes`` could be read; if not, the missing nodes
            are unknown.
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


def parse_project(file: Path, roots: Roots) -> ParsedProject:
    """Read a project file and its node files. Raises :class:`SourceError` for the first only."""
    root, duplicates = read_file(file)
    nodes = root.member("nodes")
    is_list = nodes is not None and isinstance(nodes.value, list)
    parsed = ParsedProject(root, roots, is_complete=is_list, problems=duplicates)
    for entry in root.items("nodes"):
        _expand(parsed, entry, (file,))
        parsed.entries += [entry] * (len(parsed.nodes) - len(parsed.entries))
    return parsed


def _expand(parsed: ParsedProject, entry: Element, chain: tuple[Path, ...]) -> None:
    """Add the node, or nodes, of an entry; ``chain`` is the files that lead to it."""
    if isinstance(entry.value, dict):
        parsed.nodes.append(entry)
    elif isinstance(entry.value, list) and len(chain) > 1:
        for item in entry.value:
            _expand(parsed, item, chain)
    elif isinstance(entry.value, str) and entry.value:
        _import(parsed, entry, chain)
    else:
        parsed.is_complete = False
        if len(chain) > 1:
            parsed.problems.append(
                entry.problem(
                    "a node file holds a node, the path of another node file, or a list of both"
                )
            )


def _import(parsed: ParsedProject, entry: Element, chain: tuple[Path, ...]) -> None:
    try:
        file = parsed.roots.find(entry.value, entry.source.folder)
        if file in chain:
            loop = " -> ".join(display_name(link) for link in (*chain[chain.index(file) :], file))
            raise PathError(f"node files import each other in a circle: {loop}")
        element, duplicates = read_file(file)
    except PathError as error:
        parsed.problems.append(entry.problem(error.text, error.hint))
        parsed.is_complete = False
    except SourceError as error:
        parsed.problems.append(error.problem)
        parsed.is_complete = False
    else:
        parsed.problems.extend(duplicates)
        _expand(parsed, element, (*chain, file))


def names_of(parsed: ParsedProject) -> Names:
    """The namespace and rules of a project; what has the wrong form is passed over."""
    namespace = parsed.root.string("namespace") or ""
    return names_from(namespace, rules_of(parsed.root.member("remap")))


def rules_of(remap: Element | None) -> dict[str, str]:
    """The rules of a project's ``"remap"`` that have the right form."""
    if remap is None or not isinstance(remap.value, dict):
        return {}
    return {old: new.value for old, new in remap.value.items() if isinstance(new.value, str)}
