"""Parsed project: the JSON of its files, node files merged in, before validation.

``--set``, ``--namespace``, ``--remap`` and ``--time`` replace values in it. The form of ``--set``::

    nodes.NAME.KEY...=VALUE
    connections.SRC.OUT.DST.IN.KEY=VALUE
    budgets.KEY=VALUE                     budgets.lost_packets.SRC.OUT -> DST.IN=VALUE

``VALUE`` is JSON if it parses, and a text otherwise; in ``environment`` it is always a text. An
empty value removes the key. Inside of ``inputs`` and ``outputs`` a step is the name of a port, in
other lists an index.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from neuros.errors import Problem
from neuros.project.names import Names, names_from
from neuros.project.paths import PathError, Roots
from neuros.project.scanner import (
    Element,
    Source,
    SourceError,
    display_name,
    escape,
    half_character,
    parse,
    read_file,
)
from neuros.project.suggest import did_you_mean

ENDS = ("source_node", "source_output", "destination_node", "destination_input")
"""The keys of a connection that name its ends."""
_MOST_NODES = 10_000
_LONGEST_CHAIN = 50
_FORMS = {
    "nodes": "nodes.NAME.KEY=VALUE",
    "connections": "connections.SRC.OUT.DST.IN.KEY=VALUE",
    "budgets": "budgets.KEY=VALUE or budgets.lost_packets.SRC.OUT -> DST.IN=VALUE",
}
_REMAP_FORM = "write --remap FROM:=TO, as in --remap /scan:=/left/scan"
_SPECIAL_NAMES = {
    "__ns": "use --namespace",
    "__node": "a node keeps the name that the project gives it",
    "__name": "a node keeps the name that the project gives it",
}


@dataclass
class ParsedProject:
    """The elements of a project's files, with node files in the place of their paths.

    Attributes:
        root: the document of the project file.
        nodes: the objects that describe nodes, in order.
        entries: for each node, the entry of the project file that leads to it.
        is_complete: whether every entry of ``nodes`` could be read.
        problems: of reading.
        functions: of nodes in Python, in place of the file that their key ``plugin`` names.
    """

    root: Element
    roots: Roots
    nodes: list[Element] = field(default_factory=list)
    entries: list[Element] = field(default_factory=list)
    is_complete: bool = True
    problems: list[Problem] = field(default_factory=list)
    functions: list[tuple[Element, tuple[Callable[..., Any], ...]]] = field(default_factory=list)

    @property
    def connections(self) -> list[Element]:
        """The objects that describe connections, in order."""
        return [item for item in self.root.items("connections") if isinstance(item.value, dict)]


def parse_project(file: Path, roots: Roots) -> ParsedProject:
    """Read a project file and its node files.

    Raises :class:`SourceError` if the project file cannot be read, or has too many nodes.
    """
    root, duplicates = read_file(file)
    nodes = root.member("nodes")
    is_list = nodes is not None and isinstance(nodes.value, list)
    parsed = ParsedProject(root, roots, is_complete=is_list, problems=duplicates)
    read = cache(read_file)
    seen = 0
    for entry in root.items("nodes"):
        waiting: list[tuple[Element, _Chain]] = [(entry, (file,))]
        while waiting:
            # A few files that import each other many times make billions of nodes.
            if (seen := seen + 1) > _MOST_NODES:
                text = f"the project has more than {_MOST_NODES} nodes and node files"
                raise SourceError(entry.problem(text, "do files import each other many times?"))
            waiting += _expand(parsed, *waiting.pop(), read)[::-1]
        parsed.entries += [entry] * (len(parsed.nodes) - len(parsed.entries))
    return parsed


_Chain: TypeAlias = "tuple[Path, ...]"
_Read: TypeAlias = "Callable[[Path], tuple[Element, list[Problem]]]"


def _expand(
    parsed: ParsedProject, entry: Element, chain: _Chain, read: _Read
) -> list[tuple[Element, _Chain]]:
    """Add the node of an entry, or return its further entries; ``chain``: files that lead to it."""
    if isinstance(entry.value, dict):
        parsed.nodes.append(entry)
    elif isinstance(entry.value, list) and len(chain) > 1:
        return [(item, chain) for item in entry.value]
    elif isinstance(entry.value, str) and entry.value:
        return _import(parsed, entry, chain, read)
    else:
        parsed.is_complete = False
        if len(chain) > 1:
            parsed.problems.append(
                entry.problem(
                    "a node file holds a node, the path of another node file, or a list of both"
                )
            )
    return []


def _import(
    parsed: ParsedProject, entry: Element, chain: _Chain, read: _Read
) -> list[tuple[Element, _Chain]]:
    try:
        file = parsed.roots.find(entry.value, entry.source.folder)
        if file in chain:
            loop = " -> ".join(display_name(link) for link in (*chain[chain.index(file) :], file))
            raise PathError(f"node files import each other in a circle: {loop}")
        if len(chain) > _LONGEST_CHAIN:
            raise PathError(f"more than {_LONGEST_CHAIN} node files import one another in a row")
        element, duplicates = read(file)
    except PathError as error:
        parsed.problems.append(entry.problem(error.text, error.hint))
        parsed.is_complete = False
    except SourceError as error:
        parsed.problems.append(error.problem)
        parsed.is_complete = False
    else:
        parsed.problems.extend(duplicates)
        return [(element, (*chain, file))]
    return []


def names_of(parsed: ParsedProject) -> Names:
    """The namespace and rules of a project; those of the wrong form are left out."""
    namespace = parsed.root.string("namespace") or ""
    return names_from(namespace, rules_of(parsed))


def rules_of(parsed: ParsedProject) -> dict[str, str]:
    """The rules of a project's ``"remap"``; those of the wrong form are left out."""
    rules = parsed.root.members("remap").items()
    return {old: new.value for old, new in rules if isinstance(new.value, str)}


# ---- overrides


def apply_override(parsed: ParsedProject, text: str) -> list[Problem]:
    """Apply one ``--set`` to a parsed project; returns problems of the text itself."""
    source = Source(f"--set {text}", parsed.roots.project, text)
    target, equals, value = text.partition("=")
    kind, *steps = target.split(".")
    if half := half_character(text):
        return [source.problem(0, "", half, "arguments are UTF-8")]
    if kind not in _FORMS:
        hint = did_you_mean(kind, _FORMS)
        text = "must begin with 'nodes.', 'connections.' or 'budgets.'"
        return [source.problem(0, "", text, hint)]
    ends = {"nodes": ("name",), "connections": ENDS, "budgets": ()}[kind]
    names = len(ends)
    needed = steps if kind == "budgets" else steps[: names + 1]
    if not equals or len(steps) <= names or not all(needed):
        return [source.problem(len(target), f"/{kind}", "is not of the form", _FORMS[kind])]
    name, parent = ".".join(steps[:names]), parsed.root
    if kind != "budgets":
        elements = parsed.nodes if kind == "nodes" else parsed.connections
        known = [".".join(each.string(end) or "" for end in ends) for each in elements]
        if name not in known:
            text, hint = f"there is no {kind[:-1]} '{name}'", did_you_mean(name, known)
            problem = source.problem(len(kind) + 1, f"/{kind}/{escape(name)}", text, hint)
            return [problem] if parsed.is_complete else []
        parent = elements[known.index(name)]
    keys = [kind, *steps] if kind == "budgets" else steps[names:]
    # Names of connections and of variables may contain dots.
    single = 2 if kind == "budgets" else 1 if keys[0] == "environment" else len(keys)
    keys = [*keys[:single], *([".".join(keys[single:])] if keys[single:] else [])]
    try:
        return _set(parent, keys, source, len(target) + 1, removes=not value)
    except SourceError as error:
        return [error.problem]


def _set(
    parent: Element, keys: list[str], source: Source, start: int, *, removes: bool
) -> list[Problem]:
    """Set or remove the value at the end of ``keys``; ``start``: its position in the source."""
    end, is_text = len(source.text), keys[0] == "environment" and len(keys) > 1
    for step in keys[:-1]:
        key = _key(parent, step, source)
        if key == step and parent.member(step) is None:
            if removes:
                return []
            pointer = f"{parent.pointer}/{escape(step)}"
            parent.value[step] = Element({}, source, start, end, pointer)
        parent = parent.value[key]
    key = _key(parent, keys[-1], source)
    if removes:
        if isinstance(key, int) or key in parent.value:
            del parent.value[key]
        return []
    pointer = f"{parent.pointer}/{escape(str(key))}"
    problems: list[Problem] = []
    element = Element(source.text[start:], source, start, end, pointer)
    if not is_text:
        with contextlib.suppress(SourceError):
            element, problems = parse(source, start, pointer)
            element.key_start = start
    parent.value[key] = element
    return problems


def _key(parent: Element, step: str, source: Source) -> str | int:
    """The key or index behind a step; a key need not exist yet. Raises :class:`SourceError`."""
    if isinstance(parent.value, dict):
        return step
    text, hint = f"'{step}' cannot be set: there is no object around it", ""
    if isinstance(parent.value, list):
        names = [item.string("name") or "" for item in parent.value]
        if step in names:
            return names.index(step)
        if step.isascii() and step.isdigit() and int(step) < len(names):
            return int(step)
        text, hint = f"there is no '{step}' in {parent.pointer}", did_you_mean(step, names)
    start = source.text.index(f".{step}") + 1  # it is one of the target's steps
    raise SourceError(source.problem(start, f"{parent.pointer}/{escape(step)}", text, hint))


def apply_option(parsed: ParsedProject, key: str, text: str | None) -> None:
    """Replace a key of a parsed project by the text of the option of that name, if it is given."""
    if text is not None and isinstance(parsed.root.value, dict):
        source = Source(f"--{key} {text}", parsed.roots.project, text)
        parsed.root.value[key] = Element(text, source, 0, len(text), f"/{key}")


def connection_name(connection: Element) -> str:
    """The name of a connection, as messages show it; empty if an end is missing."""
    ends = [connection.string(end) for end in ENDS]
    return "" if None in ends else "{}.{} -> {}.{}".format(*ends)


def apply_remaps(parsed: ParsedProject, texts: Sequence[str]) -> list[Problem]:
    """Put the rules of ``--remap`` before those of a parsed project."""
    problems: list[Problem] = []
    rules: dict[str, Element] = {}
    for text in texts:
        source = Source(f"--remap {text}", parsed.roots.project, text)
        old, sign, new = text.partition(":=")
        if not (sign and old and new):
            problems.append(source.problem(0, "/remap", "is not a rule", _REMAP_FORM))
        elif old.rpartition(":")[2] in _SPECIAL_NAMES:
            hint = _SPECIAL_NAMES[old.rpartition(":")[2]]
            problems.append(source.problem(0, "/remap", f"'{old}' is not remapped", hint))
        else:
            start = len(old) + len(sign)
            pointer = f"/remap/{escape(old)}"
            rule = Element(new, source, start, len(text), pointer, key_start=0)
            rules.setdefault(old, rule)  # the first one counts
    if rules and isinstance(parsed.root.value, dict):
        remap = parsed.root.member("remap")
        if remap is None:
            source = next(iter(rules.values())).source
            parsed.root.value["remap"] = Element(rules, source, 0, len(source.text), "/remap")
        elif isinstance(remap.value, dict):
            remap.value = {**rules, **{k: v for k, v in remap.value.items() if k not in rules}}
    return problems
